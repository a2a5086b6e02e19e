"""Every option that several commands have, once; the types of their values, and how their texts are read."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import click

from pcbench.errors import InputError

_Number = TypeVar("_Number", int, float)
_Command = TypeVar("_Command", bound=Callable[..., Any])

FILE = click.Path(path_type=Path)


class FiniteRange(click.FloatRange):
    """A finite number in a range; click takes nan for a number of any range."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        number = float(super().convert(value, param, ctx))
        if not math.isfinite(number):
            self.fail(f"{value} is not a finite number", param, ctx)
        return number


POSITIVE = FiniteRange(min=0, min_open=True)

_REGISTER_HELP = (
    "icp, icp-point, similarity (ICP with scale), global or global-similarity (the same from any pose), points:FILE,"
    " matrix:FILE or none."
)
_CROP_HELP = "none, box:x0,y0,z0,x1,y1,z1, sphere:x,y,z,r, polygon:FILE, reference or quantile:0.99."


def register_option(default: str = "icp", help: str = _REGISTER_HELP) -> Callable[[_Command], _Command]:
    return click.option("--register", default=default, show_default=True, metavar="HOW", help=help)


crop_option = click.option("--crop", default="none", show_default=True, metavar="REGION", help=_CROP_HELP)
required_crop_option = click.option("--crop", required=True, metavar="REGION", help=_CROP_HELP)


def seed_option(of: str) -> Callable[[_Command], _Command]:
    """The seed of what is random, named in the help text."""
    return click.option("--seed", default=0, show_default=True, type=click.IntRange(min=0), help=of)


def las_options(files: str) -> Callable[[_Command], _Command]:
    """Filters of LAS files; `files` is how the help text names them."""

    def add(command: _Command) -> _Command:
        returns = f"Only these returns of {files}: first, last or numbers."
        command = click.option("--returns", metavar="WHICH", help=returns)(command)
        return click.option("--classes", metavar="N,N,...", help=f"Only these classes of {files}, such as 2,6.")(
            command
        )

    return add


def splat_options(command: _Command) -> _Command:
    """Filters of models of Gaussian splats."""
    axis = "Only Gaussian splats whose largest axis (sigma) is at most this."
    command = click.option("--max-axis", type=POSITIVE, metavar="LENGTH", help=axis)(command)
    opacity = FiniteRange(min=0, max=1)
    return click.option("--min-opacity", type=opacity, metavar="0..1", help="Only Gaussian splats so opaque.")(command)


def cameras_option(help: str = "auto, none, or a file or folder with cameras.") -> Callable[[_Command], _Command]:
    return click.option("--cameras", default="auto", show_default=True, metavar="WHICH", help=help)


masks_option = click.option("--masks", type=FILE, help="Folder of masks; black is left out.  [default: masks/]")
image_scale_option = click.option(
    "--image-scale", default=1.0, show_default=True, type=float, help="Work with images of this scale, up to 1."
)
write_cameras_option = click.option(
    "--write-cameras", type=FILE, metavar="OUT", help="OUT.json (transforms.json), or a COLMAP model's folder."
)


def wgs84_option(what: str) -> Callable[[_Command], _Command]:
    """Whether metres of Earth Studio's sphere become those of WGS84."""
    help = f"Of Earth Studio: {what} in metres of WGS84 instead of its sphere."
    return click.option("--wgs84", is_flag=True, help=help)


def size_option(default: str) -> Callable[[_Command], _Command]:
    return click.option("--size", default=default, show_default=True, metavar="WxH", help="Of an image, in pixels.")


def no_figures_option(what: str = "pictures") -> Callable[[_Command], _Command]:
    return click.option("--no-figures", is_flag=True, help=f"Leave the {what} out.")


format_option = click.option("--format", "figure_format", metavar="KIND", help="Of pictures: png, svg or pdf.")
background_option = click.option("--background", metavar="COLOUR", help="Of pictures: dark, white, black or #rrggbb.")


def figure_options(command: _Command) -> _Command:
    """How pictures look: the fields of `pcbench.report.Figures`."""
    command = click.option(
        "--range", "color_range", type=POSITIVE, metavar="LENGTH", help="Of distances: where colours end."
    )(format_option(command))
    return background_option(command)


quiet_option = click.option("--quiet", "-q", is_flag=True, help="Print nothing but errors.")


def given(context: click.Context, name: str) -> bool:
    """Whether the user gave an option, be it with its default."""
    return context.get_parameter_source(name) is not click.core.ParameterSource.DEFAULT


def numbers(option: str, text: str | None, kind: type[_Number]) -> tuple[_Number, ...] | None:
    """Numbers with commas between them; None where the option is not given.

    Raises:
        InputError: a part is no number.
    """
    if text is None:
        return None
    try:
        return tuple(kind(word) for word in text.split(","))
    except ValueError:
        raise InputError(f"expected {option} as numbers with commas, got {text!r}") from None


def triple(option: str, text: str) -> tuple[float, float, float]:
    """Three numbers x,y,z.

    Raises:
        InputError: they are not three, or no finite numbers.
    """
    values = numbers(option, text, float)
    if values is None or len(values) != 3 or not all(map(math.isfinite, values)):
        raise InputError(f"expected {option} as three numbers x,y,z, got {text!r}")
    return values[0], values[1], values[2]


def words(values: tuple[str, ...]) -> tuple[str, ...]:
    """The names in an option that may be repeated, or hold several names with commas."""
    return tuple(word for value in values for word in value.split(","))


def las_returns(text: str | None) -> str | tuple[int, ...] | None:
    """Which returns of LAS files: a word, or numbers."""
    return text if text in (None, "first", "last") else numbers("--returns", text, int)


def image_size(text: str) -> tuple[int, int]:
    """WIDTHxHEIGHT, in pixels.

    Raises:
        InputError: it is something else, or less than one pixel.
    """
    pixels = numbers("--size", text.lower().replace("x", ","), int)
    if pixels is None or len(pixels) != 2:
        raise InputError(f"expected --size as WIDTHxHEIGHT, such as 960x540, got {text!r}")
    if min(pixels) < 1:
        raise InputError(f"expected an image of at least one pixel, got {text!r}")
    return pixels[0], pixels[1]


def key_value(text: str) -> tuple[str, str]:
    """KEY=VALUE.

    Raises:
        InputError: it is something else.
    """
    key, equals, value = text.partition("=")
    if not equals or not key:
        raise InputError(f"expected --set KEY=VALUE, got {text!r}")
    return key.strip(), value.strip()
