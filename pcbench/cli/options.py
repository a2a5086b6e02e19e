"""Options that several commands share, the types of their values, and parsers of their texts."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import click

from pcbench.errors import InputError

_Number = TypeVar("_Number", int, float)
_Command = TypeVar("_Command", bound=Callable[..., Any])

_POINTS = re.compile(r"(\d+(?:\.\d*)?(?:e\d{1,2})?)([kMG]?)", re.IGNORECASE)
_POINT_FACTORS = {"": 1, "k": 1e3, "m": 1e6, "g": 1e9}
_CLUSTER = re.compile(r"(tcp|tls|ws|wss|ucx)://[^\s/]+:\d+")

FILE = click.Path(path_type=Path)


class FiniteRange(click.FloatRange):
    """A finite number in a range; click alone would accept nan."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Return the number, or fail if it is not finite or outside the range."""
        number = float(super().convert(value, param, ctx))
        if not math.isfinite(number):
            self.fail(f"{value} is not a finite number", param, ctx)
        return number


POSITIVE = FiniteRange(min=0, min_open=True)

_REGISTER_HELP = (
    "Registration method: icp (point to plane), icp-point (point to point), similarity (icp with scale), global or"
    " global-similarity (icp or similarity from any initial pose), points:FILE (control points), matrix:FILE (a known"
    " pose) or none. ICP removes a motion of the whole cloud, and the answer states it; use none to"
    " measure the given coordinates."
)
_SHAPES_HELP = "box:x0,y0,z0,x1,y1,z1, sphere:x,y,z,r, polygon:FILE"
_CROP_HELP = (
    f"Region to measure: none, {_SHAPES_HELP}, reference (its bounding box) or quantile:0.99 (the sphere around its"
    " centroid with this share of its points)."
)
_CLOUD_CROP_HELP = (
    f"Region to keep: {_SHAPES_HELP}, or quantile:0.99 (the sphere around the centroid with this share of the points)."
)


def register_option(default: str = "icp", help: str = _REGISTER_HELP) -> Callable[[_Command], _Command]:
    """Return the option for the registration method."""
    return click.option("--register", default=default, show_default=True, metavar="HOW", help=help)


crop_option = click.option("--crop", default="none", show_default=True, metavar="REGION", help=_CROP_HELP)
required_crop_option = click.option("--crop", required=True, metavar="REGION", help=_CLOUD_CROP_HELP)


def seed_option(help: str = "Random seed.") -> Callable[[_Command], _Command]:
    """Return the option for the random seed."""
    return click.option("--seed", default=0, show_default=True, type=click.IntRange(min=0), help=help)


def las_options(files: str) -> Callable[[_Command], _Command]:
    """Return the options that filter LAS files; `files` names these in the help text."""

    def add(command: _Command) -> _Command:
        returns = f"Use only these returns of {files}: first, last or numbers such as 1,2."
        command = click.option("--returns", metavar="WHICH", help=returns)(command)
        return click.option("--classes", metavar="N,N,...", help=f"Use only these classes of {files}, such as 2,6.")(
            command
        )

    return add


color_depth_option = click.option(
    "--color-depth",
    type=click.Choice(["8", "16"]),
    callback=lambda context, option, value: None if value is None else int(value),
    help="Bits of the colours in LAS files.  [default: 16 if a value exceeds 255, else 8]",
)


def splat_options(command: _Command) -> _Command:
    """Add the options that filter Gaussian splats."""
    axis = "Use only Gaussian splats whose largest axis (standard deviation) is at most this length."
    command = click.option("--max-axis", type=POSITIVE, metavar="LENGTH", help=axis)(command)
    opacity = FiniteRange(min=0, max=1)
    return click.option(
        "--min-opacity", type=opacity, metavar="OPACITY", help="Use only Gaussian splats with at least this opacity."
    )(command)


def cameras_option(
    help: str = "Cameras: auto (found in the folder of the scene), none, or a file or folder.",
) -> Callable[[_Command], _Command]:
    """Return the option for the cameras of a scene."""
    return click.option("--cameras", default="auto", show_default=True, metavar="WHICH", help=help)


def scene_options(command: _Command) -> _Command:
    """Add the options for a scene whose cameras select the views of pictures."""
    scene = "Scene with cameras in the coordinates of the cloud; they show which way is up and select the views."
    cameras = "Cameras of --scene: auto (found in its folder), or a file or folder."
    return click.option("--scene", type=FILE, metavar="FOLDER", help=scene)(cameras_option(cameras)(command))


vertices_option = click.option(
    "--vertices",
    is_flag=True,
    help="Measure a candidate mesh at its vertices rather than at points sampled on its faces.",
)


def scene_folder(context: click.Context, scene: Path | None, cameras: str) -> Any:
    """Return the `SceneFolder` that the options of `scene_options` name, if any.

    Raises:
        UsageError: cameras are given without a scene.
    """
    from pcbench.report.inputs import SceneFolder

    if scene is None:
        if is_given(context, "cameras"):
            raise click.UsageError("--cameras needs --scene, the folder of the photographs")
        return None
    return SceneFolder(scene, cameras)


masks_option = click.option(
    "--masks", type=FILE, metavar="FOLDER", help="Folder of masks; black pixels are excluded.  [default: masks/]"
)
image_scale_option = click.option(
    "--image-scale",
    default=1.0,
    show_default=True,
    type=float,
    help="Scale of the images, at most 1: 0.5 halves width and height.",
)
write_cameras_option = click.option(
    "--write-cameras",
    type=FILE,
    metavar="OUT",
    help="Write the cameras to a file OUT.json (transforms.json), or to a folder OUT as a COLMAP model.",
)


def wgs84_option(what: str) -> Callable[[_Command], _Command]:
    """Return the option that converts metres of Earth Studio's sphere to metres of WGS84."""
    help = f"Convert {what} from metres of Earth Studio's sphere to metres of WGS84."
    return click.option("--wgs84", is_flag=True, help=help)


def size_option(default: str) -> Callable[[_Command], _Command]:
    """Return the option for the size of rendered images."""
    return click.option("--size", default=default, show_default=True, metavar="WxH", help="Image size in pixels.")


def no_figures_option(what: str = "pictures") -> Callable[[_Command], _Command]:
    """Return the option that omits the pictures."""
    return click.option("--no-figures", is_flag=True, help=f"Draw no {what}.")


format_option = click.option(
    "--format", "figure_format", metavar="KIND", help="Format of the pictures: png, svg or pdf.  [default: png]"
)
background_option = click.option(
    "--background",
    metavar="COLOUR",
    help="Background of the pictures: dark, white, black or #rrggbb.  [default: dark for clouds, white for charts]",
)


def figure_options(command: _Command) -> _Command:
    """Add the options for the appearance of pictures, the fields of `pcbench.report.Figures`."""
    command = click.option(
        "--range",
        "color_range",
        type=POSITIVE,
        metavar="LENGTH",
        help="Upper end of the colour range of distances, in the clouds' unit.",
    )(format_option(command))
    return background_option(command)


quiet_option = click.option("--quiet", "-q", is_flag=True, help="Print only errors, including failed pictures.")


def is_given(context: click.Context, name: str) -> bool:
    """Return whether the user set an option, even to its default."""
    return context.get_parameter_source(name) is not click.core.ParameterSource.DEFAULT


def numbers(option: str, text: str | None, kind: type[_Number]) -> tuple[_Number, ...] | None:
    """Parse comma-separated numbers; None if the option is not set.

    Raises:
        InputError: a part is not a number.
    """
    if text is None:
        return None
    try:
        return tuple(kind(word) for word in text.split(","))
    except ValueError:
        raise InputError(f"expected {option} as comma-separated numbers, got {text!r}") from None


def tiling_options(command: _Command) -> _Command:
    """Add the options of a comparison in tiles, see `tiling_choice`."""
    texts = {
        "--tiles": (
            "auto|SIZE",
            "Compute in tiles of at most SIZE points (1e6, 500k, 2M); auto, as without this option: only if the clouds"
            " do not fit into --memory.",
        ),
        "--memory": ("SIZE", "Memory that may be used, such as 4GiB or 500MB.  [default: 4GiB]"),
        "--workers": ("N", "Worker processes that compute tiles.  [default: the CPUs, as far as the memory allows]"),
        "--cluster": (
            "ADDRESS",
            "Compute tiles on a Dask cluster: tcp://HOST:PORT of its scheduler, or its scheduler file.",
        ),
        "--max-distance": (
            "LENGTH",
            "Compute in tiles, and search no closest point beyond this length: larger distances count as this one, and"
            " their share is stated.",
        ),
        "--workspace": (
            "FOLDER",
            "Folder for sorted copies and finished tiles, from which the same command continues after a failure."
            "  [default: a hidden folder beside --out]",
        ),
    }
    types: dict[str, Any] = {"--workers": click.IntRange(min=1), "--max-distance": POSITIVE, "--workspace": FILE}
    skip = "Compute in tiles, and leave out damaged files, which the report lists."
    command = click.option("--skip-bad", is_flag=True, help=skip)(command)
    for name, (metavar, text) in reversed(texts.items()):
        command = click.option(name, type=types.get(name), metavar=metavar, help=text)(command)
    return command


def tiling_choice(
    tiles: str | None,
    memory: str | None,
    workers: int | None,
    cluster: str | None,
    max_distance: float | None,
    skip_bad: bool,
    workspace: Path | None,
) -> Any:
    """Return the `TilingChoice` of the options of `tiling_options`.

    Raises:
        InputError: a value is not usable.
    """
    from pcbench.measure.tiled.settings import DEFAULT_MEMORY, TilingSettings, parse_bytes
    from pcbench.report.on_disk import TilingChoice

    if cluster is not None and not _CLUSTER.fullmatch(cluster) and not Path(cluster).is_file():
        raise InputError(
            "expected --cluster as the address of a Dask scheduler, tcp://HOST:PORT, or its scheduler file, got"
            f" {cluster!r}"
        )
    points = None if tiles in (None, "auto") else point_number("--tiles", str(tiles))
    size = DEFAULT_MEMORY if memory is None else parse_bytes(memory)
    settings = TilingSettings(points, size, workers, cluster, max_distance, skip_bad)
    if points is not None or cluster is not None or max_distance is not None or skip_bad:
        return TilingChoice(settings, "always", workspace)
    return TilingChoice(settings, "if-possible" if tiles is None else "auto", workspace)


def point_number(option: str, text: str) -> int:
    """Parse a number of points such as 1e6, 500k or 2M.

    Raises:
        InputError: the text is no such number, or not a whole number above 0.
    """
    found = _POINTS.fullmatch(text.strip())
    number = float(found[1]) * _POINT_FACTORS[found[2].lower()] if found else 0.0
    if not 1 <= number < 1e15 or number != int(number):
        raise InputError(f"expected {option} as auto or a number of points such as 1e6, 500k or 2M, got {text!r}")
    return int(number)


def share(option: str, text: str) -> float:
    """Parse a percentage such as 1%, or a share such as 0.01.

    Raises:
        InputError: the text is neither.
    """
    number = text.strip().removesuffix("%")
    try:
        value = float(number)
    except ValueError:
        raise InputError(f"expected {option} as a percentage such as 1%, got {text!r}") from None
    return value / 100 if text.strip().endswith("%") else value


def triple(option: str, text: str) -> tuple[float, float, float]:
    """Parse three numbers x,y,z.

    Raises:
        InputError: the text is not three finite numbers.
    """
    values = numbers(option, text, float)
    if values is None or len(values) != 3 or not all(map(math.isfinite, values)):
        raise InputError(f"expected {option} as three numbers x,y,z, got {text!r}")
    return values[0], values[1], values[2]


def split_names(values: tuple[str, ...]) -> tuple[str, ...]:
    """Return the names in an option that may be repeated or comma-separated."""
    return tuple(word for value in values for word in value.split(","))


def las_returns(text: str | None) -> str | tuple[int, ...] | None:
    """Parse the returns of LAS files: first, last, or numbers.

    Raises:
        InputError: the text is none of these.
    """
    try:
        return text if text in (None, "first", "last") else numbers("--returns", text, int)
    except InputError:
        raise InputError(f"expected --returns as first, last or numbers such as 1,2, got {text!r}") from None


def image_size(text: str) -> tuple[int, int]:
    """Parse WIDTHxHEIGHT in pixels.

    Raises:
        InputError: the text has another form, or a side is less than one pixel.
    """
    pixels = numbers("--size", text.lower().replace("x", ","), int)
    if pixels is None or len(pixels) != 2:
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
