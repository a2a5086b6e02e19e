"""How fields of settings are given on a command line: `pcbench.cli` builds its options from these descriptions."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from enum import StrEnum
from typing import Any, TypeVar

from pcbench.errors import InputError

# Help texts of settings that several commands have.
REGISTER_HELP = (
    "How to align: icp (to planes), icp-point, similarity (with scale), global or global-similarity (from any pose),"
    " points:FILE (control points), matrix:FILE (a known pose), tnt:TRAJECTORY,SCENE, or none: measure the given"
    " coordinates."
)
SHAPES_HELP = "box:x0,y0,z0,x1,y1,z1, sphere:x,y,z,r, polygon:FILE"
CROP_HELP = (
    f"Region to measure: none, {SHAPES_HELP}, reference (its bounding box) or quantile:0.99 (the sphere around its"
    " centroid with this share of its points)."
)
REGIONS = "none", "box:", "sphere:", "polygon:FILE", "reference", "quantile:"  # for completion
CLASSES_HELP = "Use only these LAS classes, such as 2,6."
RETURNS_HELP = "Use only these LAS returns: first, last or numbers such as 1,2."
MIN_OPACITY_HELP = "Use only Gaussian splats of at least this opacity."
MAX_AXIS_HELP = "Use only Gaussian splats whose largest standard deviation is at most this length."
METRIC_HELP = (
    "Also compute your own metric: FILE.py:FUNCTION, MODULE:FUNCTION or an installed name (repeatable). Its code runs"
    " with your rights. fscore@T adds a threshold of the F-score."
)
VERTICES_HELP = "Measure a candidate mesh at its vertices, not at points sampled on its faces."

Values = Sequence[str] | Callable[[], Iterable[str]]
"""Values that completion offers: names, or a function that returns them."""

_Number = TypeVar("_Number", int, float)
_Settings = TypeVar("_Settings")


class OptionGroup(StrEnum):
    """Groups of options in the help of a command, in their order."""

    INPUT = "Input"
    COORDINATES = "Coordinates"
    CITY = "City"
    PHOTOGRAPHS = "Photographs"
    REGISTRATION = "Registration"
    METRICS = "Metrics"
    OUTPUT = "Output"
    LARGE_DATA = "Large data and long runs"


@dataclass(frozen=True)
class Bounds:
    """Numbers that an option accepts.

    Attributes:
        kind: `int` or `float`; floats are finite.
        low: smallest number.
        high: largest number; None: any.
        is_open: whether `low` itself is excluded.
    """

    kind: type[int | float]
    low: float
    high: float | None = None
    is_open: bool = False


@dataclass(frozen=True)
class Option:
    """The option of a command line that sets a field.

    Attributes:
        flag: its name, such as `--crop`.
        help: its help text.
        metavar: how the help shows its value; None: by its bounds, or it is a flag if it has none.
        parse: returns the value for the text of the option; it gets the flag and the text, and raises an InputError.
        bounds: numbers that it accepts; None: it is a text.
        is_repeatable: whether it may be given several times, with one or several comma-separated names.
        shows_default: whether the help shows the default.
        default: default value of the field.
        group: its group in the help; None: it is listed before all groups, because it matters most.
        values: values that completion offers, such as `icp`, or `points:FILE` for a name with a value.
    """

    flag: str
    help: str
    metavar: str | None = None
    parse: Callable[[str, str], Any] | None = None
    bounds: Bounds | None = None
    is_repeatable: bool = False
    shows_default: bool = False
    default: Any = None
    group: OptionGroup | None = None
    values: Values | None = None

    @property
    def is_flag(self) -> bool:
        """Return whether the option has no value."""
        return self.metavar is None and self.bounds is None

    def value(self, given: Any) -> Any:
        """Return the value of the field for what the command line has.

        Raises:
            InputError: the text is not usable.
        """
        if self.is_repeatable:
            return split_names(given)
        return given if self.parse is None or given is None else self.parse(self.flag, given)


def setting(default: Any, flag: str, help: str, **how: Any) -> Any:
    """Return a field of a dataclass of settings that a command line can set.

    Args:
        default: default value of the field.
        flag: name of the option.
        help: its help text.
        **how: other attributes of `Option`.
    """
    return field(default=default, metadata={"option": Option(flag, help, default=default, **how)})


def options_of(settings: type) -> dict[str, Option]:
    """Return the options of a dataclass of settings, by the names of the fields that they set."""
    return {item.name: item.metadata["option"] for item in fields(settings) if "option" in item.metadata}


def from_options(settings: type[_Settings], given: Mapping[str, Any]) -> _Settings:
    """Return settings from the values of options, by the names of fields; other names are left alone.

    Raises:
        InputError: a value is not usable.
    """
    options = options_of(settings)
    values = {name: option.value(given[name]) for name, option in options.items() if name in given}
    return settings(**{name: value for name, value in values.items() if value is not None})


def split_names(texts: Iterable[str]) -> tuple[str, ...]:
    """Return the names in the texts of an option that may be repeated or comma-separated."""
    return tuple(name for text in texts for name in text.split(","))


def parse_numbers(flag: str, text: str, kind: type[_Number]) -> tuple[_Number, ...]:
    """Parse comma-separated numbers.

    Raises:
        InputError: a part is not a number.
    """
    try:
        return tuple(kind(word) for word in text.split(","))
    except ValueError:
        raise InputError(f"expected {flag} as comma-separated numbers, got {text!r}") from None


def parse_lengths(flag: str, text: str) -> tuple[float, ...]:
    """Parse comma-separated lengths; raises the error of `parse_numbers`."""
    return parse_numbers(flag, text, float)


def parse_integers(flag: str, text: str) -> tuple[int, ...]:
    """Parse comma-separated whole numbers; raises the error of `parse_numbers`."""
    return parse_numbers(flag, text, int)


def parse_share(flag: str, text: str) -> float:
    """Parse a percentage such as 1%, or a share such as 0.01.

    Raises:
        InputError: the text is neither.
    """
    number = text.strip().removesuffix("%")
    try:
        value = float(number)
    except ValueError:
        raise InputError(f"expected {flag} as a percentage such as 1%, got {text!r}") from None
    return value / 100 if text.strip().endswith("%") else value


def parse_returns(flag: str, text: str) -> str | tuple[int, ...]:
    """Parse the returns of LAS files: first, last, or numbers.

    Raises:
        InputError: the text is none of these.
    """
    try:
        return text if text in ("first", "last") else parse_integers(flag, text)
    except InputError:
        raise InputError(f"expected {flag} as first, last or numbers such as 1,2, got {text!r}") from None
