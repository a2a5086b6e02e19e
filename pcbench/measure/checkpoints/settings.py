"""Settings of an accuracy test by check points."""

from __future__ import annotations

from dataclasses import dataclass

from pcbench.errors import InputError
from pcbench.geometry.units import check_unit_option
from pcbench.options import CLASSES_HELP, RETURNS_HELP, Bounds, OptionGroup, parse_integers, parse_returns, setting

SURFACES = ("auto", "tin", "plane")
STANDARDS = ("asprs2", "nssda")
_LENGTH = Bounds(float, 0, is_open=True)


@dataclass(frozen=True)
class CheckPointSettings:
    """Settings of an accuracy test by check points.

    Attributes:
        surface: how the cloud's height at a check point is found: `tin` interpolates linearly in the triangle around
            it, `plane` fits a plane to the points around it, `auto` takes the plane if the noise exceeds the spacing.
        standard: whose statement is written: `asprs2` (ASPRS Edition 2) or `nssda`.
        vertical_class: vertical accuracy class that the project demands, in centimetres; None: the smallest class of
            whole centimetres that the result meets.
        horizontal_class: horizontal accuracy class, in centimetres; None: likewise.
        sigma_z: standard error of the surveyed heights, if the file of check points has no column for it.
        sigma_xy: standard error of the surveyed x and y, likewise.
        classes: LAS classes to keep, see `pcbench.read_cloud`.
        returns: returns to keep, likewise.
        unit: unit of the coordinates, if the file of the cloud states none.

    Raises:
        InputError: a value is not usable.
    """

    surface: str = setting(
        "auto",
        "--surface",
        "Height of the cloud at a check point: tin (linear in the triangle around it), plane (fitted to the points"
        " around it) or auto (the plane if the noise exceeds the point spacing, else the triangle).",
        metavar="HOW",
        shows_default=True,
        group=OptionGroup.METRICS,
        values=SURFACES,
    )
    standard: str = setting(
        "asprs2",
        "--standard",
        "Standard of the statement: asprs2 (ASPRS Edition 2) or nssda (FGDC-STD-007.3-1998).",
        metavar="NAME",
        shows_default=True,
        values=STANDARDS,
    )
    vertical_class: float | None = setting(
        None,
        "--vertical-class",
        "Vertical accuracy class to test, in centimetres.  [default: the smallest of whole centimetres that is met]",
        metavar="CM",
        bounds=_LENGTH,
    )
    horizontal_class: float | None = setting(
        None, "--horizontal-class", "Horizontal accuracy class to test, in centimetres.", metavar="CM", bounds=_LENGTH
    )
    sigma_z: float | None = setting(
        None,
        "--sigma-z",
        "Standard error of the surveyed heights, if POINTS has no column sigma or sigma_z.",
        metavar="LENGTH",
        bounds=Bounds(float, 0),
        group=OptionGroup.INPUT,
    )
    sigma_xy: float | None = setting(
        None,
        "--sigma-xy",
        "Standard error of the surveyed x and of y, if POINTS has no column sigma or sigma_xy.",
        metavar="LENGTH",
        bounds=Bounds(float, 0),
        group=OptionGroup.INPUT,
    )
    classes: tuple[int, ...] | None = setting(None, "--classes", CLASSES_HELP, metavar="N,N,...", parse=parse_integers)
    returns: str | tuple[int, ...] | None = setting(
        None, "--returns", RETURNS_HELP, metavar="WHICH", parse=parse_returns, group=OptionGroup.INPUT
    )
    unit: str | None = setting(
        None,
        "--unit",
        "Unit of CLOUD and POINTS, such as m or US-ft, if CLOUD states none.",
        metavar="UNIT",
        group=OptionGroup.INPUT,
    )

    def __post_init__(self) -> None:
        for name, value, choices in (("surface", self.surface, SURFACES), ("standard", self.standard, STANDARDS)):
            if value not in choices:
                raise InputError(f"expected --{name} as {', '.join(choices)}, got {value!r}")
        check_unit_option(self.unit)
