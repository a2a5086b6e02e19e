"""Options that several commands share, and the types of their values."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import click

from pcbench.cli.completion import method_names
from pcbench.cli.help import option
from pcbench.errors import InputError
from pcbench.options import (
    CLASSES_HELP,
    CROP_HELP,
    MAX_AXIS_HELP,
    MIN_OPACITY_HELP,
    REGIONS,
    REGISTER_HELP,
    RETURNS_HELP,
    SHAPES_HELP,
    VERTICES_HELP,
    OptionGroup,
    Values,
    parse_numbers,
)

_Command = TypeVar("_Command", bound=Callable[..., Any])


FILE = click.Path(path_type=Path, readable=False)  # their readers say what is wrong, and go on with other files


class FiniteRange(click.FloatRange):
    """A finite number in a range; click alone would accept nan."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Return the number, or fail if it is not finite or outside the range."""
        number = float(super().convert(value, param, ctx))
        if not math.isfinite(number):
            self.fail(f"{value} is not a finite number", param, ctx)
        return number


POSITIVE = FiniteRange(min=0, min_open=True)

_CLOUD_CROP_HELP = (
    f"Region to keep: {SHAPES_HELP}, or quantile:0.99 (the sphere around the centroid with this share of the points)."
)


def register_option(
    default: str = "icp", help: str = REGISTER_HELP, group: OptionGroup | None = None, values: Values = method_names
) -> Callable[[_Command], _Command]:
    """Return the option for the registration method."""
    return option(
        "--register", default=default, show_default=True, metavar="HOW", help=help, group=group, values=values
    )


crop_option = option("--crop", default="none", show_default=True, metavar="REGION", help=CROP_HELP, values=REGIONS)
required_crop_option = option("--crop", required=True, metavar="REGION", help=_CLOUD_CROP_HELP, values=REGIONS)


def seed_option(help: str = "Random seed.", group: OptionGroup | None = None) -> Callable[[_Command], _Command]:
    """Return the option for the random seed."""
    return option("--seed", default=0, show_default=True, type=click.IntRange(min=0), help=help, group=group)


def las_options(command: _Command) -> _Command:
    """Add the options that filter LAS files."""
    command = option("--returns", metavar="WHICH", help=RETURNS_HELP, group=OptionGroup.INPUT)(command)
    return option("--classes", metavar="N,N,...", help=CLASSES_HELP, group=OptionGroup.INPUT)(command)


color_depth_option = option(
    "--color-depth",
    type=click.Choice(["8", "16"]),
    callback=lambda context, option, value: None if value is None else int(value),
    help="Bits of the colours in LAS files.  [default: 16 if a value exceeds 255, else 8]",
    group=OptionGroup.OUTPUT,
)


def splat_options(command: _Command) -> _Command:
    """Add the options that filter Gaussian splats."""
    command = option("--max-axis", type=POSITIVE, metavar="LENGTH", help=MAX_AXIS_HELP, group=OptionGroup.INPUT)(
        command
    )
    opacity = FiniteRange(min=0, max=1)
    return option("--min-opacity", type=opacity, metavar="OPACITY", help=MIN_OPACITY_HELP, group=OptionGroup.INPUT)(
        command
    )


def cameras_option(
    help: str = "Cameras: auto (found in the folder of the scene), none, or a file or folder.",
    group: OptionGroup = OptionGroup.INPUT,
) -> Callable[[_Command], _Command]:
    """Return the option for the cameras of a scene."""
    return option(
        "--cameras", default="auto", show_default=True, metavar="WHICH", help=help, group=group, values=("auto", "none")
    )


def scene_options(command: _Command) -> _Command:
    """Add the options for a scene whose cameras select the views of pictures."""
    scene = "Photographs whose cameras select the views, in the coordinates of the cloud."
    cameras = "Cameras of --scene: auto, or a file or folder."
    return option("--scene", type=FILE, metavar="FOLDER", help=scene, group=OptionGroup.OUTPUT)(
        cameras_option(cameras, OptionGroup.OUTPUT)(command)
    )


vertices_option = option("--vertices", is_flag=True, help=VERTICES_HELP, group=OptionGroup.INPUT)


def scene_folder(context: click.Context, scene: Path | None, cameras: str) -> Any:
    """Return the `SceneFolder` that the options of `scene_options` name, if any.

    Raises:
        UsageError: cameras are given without a scene.
    """
    from pcbench.report.viewing import SceneFolder

    if scene is None:
        if is_given(context, "cameras"):
            raise click.UsageError("--cameras needs --scene, the folder of the photographs")
        return None
    return SceneFolder(scene, cameras)


masks_option = option(
    "--masks",
    type=FILE,
    metavar="FOLDER",
    help="Folder of masks; black pixels are excluded.  [default: masks/]",
    group=OptionGroup.INPUT,
)
image_scale_option = option(
    "--image-scale",
    default=1.0,
    show_default=True,
    type=float,
    help="Scale of the images, at most 1: 0.5 halves width and height.",
    group=OptionGroup.INPUT,
)
write_cameras_option = option(
    "--write-cameras",
    type=FILE,
    metavar="OUT",
    help="Write the cameras to a file OUT.json (transforms.json), or to a folder OUT as a COLMAP model.",
    group=OptionGroup.OUTPUT,
)


def accuracy_option(target: str) -> Callable[[_Command], _Command]:
    """Return the option for the accuracy of a transformation between coordinate systems.

    Args:
        target: the option that names the new system.
    """
    help = f"With {target}: accept a transformation this accurate if the grid of the best one is not installed."
    return option("--accuracy", type=POSITIVE, metavar="METRES", help=help, group=OptionGroup.COORDINATES)


def wgs84_option(what: str) -> Callable[[_Command], _Command]:
    """Return the option that converts metres of Earth Studio's sphere to metres of WGS84."""
    help = f"Convert {what} from metres of Earth Studio's sphere to metres of WGS84."
    return option("--wgs84", is_flag=True, help=help, group=OptionGroup.COORDINATES)


def size_option(default: str) -> Callable[[_Command], _Command]:
    """Return the option for the size of rendered images."""
    return option("--size", default=default, show_default=True, metavar="WxH", help="Image size in pixels.")


def no_figures_option(what: str = "pictures") -> Callable[[_Command], _Command]:
    """Return the option that omits the pictures."""
    return option("--no-figures", is_flag=True, help=f"Draw no {what}.", group=OptionGroup.OUTPUT)


format_option = option(
    "--format",
    "figure_format",
    metavar="KIND",
    help="Format of pictures: png, svg or pdf.  [default: png]",
    values=("png", "svg", "pdf"),
    group=OptionGroup.OUTPUT,
)
background_option = option(
    "--background",
    metavar="COLOUR",
    help="Background of pictures: dark, white, black or #rrggbb.  [default: dark; white for charts]",
    values=("dark", "white", "black"),
    group=OptionGroup.OUTPUT,
)


def figure_options(command: _Command) -> _Command:
    """Add the options for the appearance of pictures, the fields of `pcbench.report.Figures`."""
    command = option(
        "--range",
        "color_range",
        type=POSITIVE,
        metavar="LENGTH",
        help="Largest distance of the colour range.",
        group=OptionGroup.OUTPUT,
    )(format_option(command))
    return background_option(command)


quiet_option = option(
    "--quiet", "-q", is_flag=True, help="Print only errors, including failed pictures.", group=OptionGroup.OUTPUT
)


def is_given(context: click.Context, name: str) -> bool:
    """Return whether the user set an option, even to its default."""
    return context.get_parameter_source(name) is not click.core.ParameterSource.DEFAULT


def triple(option: str, text: str) -> tuple[float, float, float]:
    """Parse three numbers x,y,z.

    Raises:
        InputError: the text is not three finite numbers.
    """
    values = parse_numbers(option, text, float)
    if len(values) != 3 or not all(map(math.isfinite, values)):
        raise InputError(f"expected {option} as three numbers x,y,z, got {text!r}")
    return values[0], values[1], values[2]


def image_size(text: str) -> tuple[int, int]:
    """Parse WIDTHxHEIGHT in pixels.

    Raises:
        InputError: the text has another form, or a side is less than one pixel.
    """
    pixels = parse_numbers("--size", text.lower().replace("x", ","), int)
    if len(pixels) != 2:
        raise InputError(f"expected --size as WIDTHxHEIGHT, such as 960x540, got {text!r}")
    if min(pixels) < 1:
        raise InputError(f"expected an image of at least one pixel, got {text!r}")
    return pixels[0], pixels[1]


def key_value(text: str) -> tuple[str, str]:
    """Parse KEY=VALUE.

    Raises:
        InputError: the text has another form.
    """
    key, equals, value = text.partition("=")
    if not equals or not key:
        raise InputError(f"expected --set KEY=VALUE, got {text!r}")
    return key.strip(), value.strip()
