"""User settings of a measurement of change, stored with every result."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path

from pcbench.errors import InputError
from pcbench.geometry.units import check_unit_option
from pcbench.measure.dem.surface import GridMethod
from pcbench.options import (
    CLASSES_HELP,
    RETURNS_HELP,
    Bounds,
    OptionGroup,
    parse_integers,
    parse_numbers,
    parse_returns,
    setting,
)

Line = tuple[float, float, float, float]
Place = tuple[float, float]


def _parse_method(flag: str, text: str) -> GridMethod:
    """Parse the name of a method.

    Raises:
        InputError: there is no such method.
    """
    try:
        return GridMethod(text.strip().lower())
    except ValueError:
        raise InputError(f"expected {flag} as {', '.join(GridMethod)}, got {text!r}") from None


@dataclass(frozen=True)
class ChangeSettings:
    """User settings of a measurement of change.

    Attributes:
        cell: edge of a cell, in the clouds' unit; None: 1, 2 or 5 times a power of ten, so that the sparsest cloud has
            four points per cell on average, or fewer in small areas, see `pcbench.measure.dem.grid.default_cell`.
        surface: how the points of a cell become its height.
        fill_voids: whether a cell without points in an epoch gets the mean difference of the cells around it.
        stable: file with polygons of terrain that did not change; its mean difference is subtracted from all. None: the
            terrain without visible change shows the errors, and nothing is subtracted.
        datum_sigma: standard deviation of the offset in height between two epochs, in the clouds' unit.
        zones: file with polygons, each of which gets its own volumes.
        unit: unit of the coordinates, if the files of the clouds state none.
        classes: LAS classes to keep.
        returns: LAS returns to keep.
        profiles: lines x0, y0, x1, y1 along which the heights of the epochs are drawn.
        points: places x, y whose change is listed against time.
        normals: whether volumes along normals are measured too, for cliffs, facades and overhangs.

    Raises:
        InputError: a value is invalid.
    """

    cell: float | None = setting(
        None,
        "--cell",
        "Edge of a cell, in the clouds' unit.  [default: 1, 2 or 5 times a power of ten, with four points per cell on"
        " average, or fewer in a small area]",
        metavar="LENGTH",
        bounds=Bounds(float, 0, is_open=True),
    )
    surface: GridMethod = setting(
        GridMethod.MEAN.value,
        "--surface",
        "Height of a cell: mean, median or lowest of its points, or tin (triangulated, at its centre).",
        metavar="METHOD",
        parse=_parse_method,
        shows_default=True,
        group=OptionGroup.METRICS,
        values=tuple(GridMethod),
    )
    fill_voids: bool = setting(
        False,
        "--fill-voids",
        "Give cells without points the mean difference of the eight nearest cells, at most five cells away.",
        group=OptionGroup.METRICS,
    )
    stable: Path | None = setting(
        None,
        "--stable",
        "Polygons of terrain that did not change (GeoJSON or WKT): its mean difference is subtracted, and it shows the"
        " errors.  [default: the terrain without visible change shows the errors]",
        metavar="FILE",
        parse=lambda _, text: Path(text),
    )
    datum_sigma: float = setting(
        0.0,
        "--datum-sigma",
        "Standard deviation of the offset in height between two epochs, in the clouds' unit.",
        metavar="LENGTH",
        bounds=Bounds(float, 0),
        shows_default=True,
        group=OptionGroup.METRICS,
    )
    zones: Path | None = setting(
        None,
        "--zones",
        "Polygons (GeoJSON or WKT), each of which gets its own volumes.",
        metavar="FILE",
        parse=lambda _, text: Path(text),
    )
    unit: str | None = setting(
        None,
        "--unit",
        "Unit of the clouds, such as m or US-ft, if they state none.",
        metavar="UNIT",
        group=OptionGroup.INPUT,
    )
    classes: tuple[int, ...] | None = setting(
        None, "--classes", CLASSES_HELP, metavar="N,N,...", parse=parse_integers, group=OptionGroup.INPUT
    )
    returns: str | tuple[int, ...] | None = setting(
        None, "--returns", RETURNS_HELP, metavar="WHICH", parse=parse_returns, group=OptionGroup.INPUT
    )
    normals: bool = setting(
        False,
        "--normals",
        "Also measure the volume along normals, for cliffs, facades and overhangs.",
        group=OptionGroup.METRICS,
    )
    profiles: tuple[Line, ...] = field(default=())
    points: tuple[Place, ...] = field(default=())

    def __post_init__(self) -> None:
        object.__setattr__(self, "surface", _parse_method("surface", self.surface))
        for name in ("stable", "zones"):
            if isinstance(value := getattr(self, name), str):
                object.__setattr__(self, name, Path(value))
        check_unit_option(self.unit)
        if self.cell is not None and not (math.isfinite(self.cell) and self.cell > 0):
            raise InputError(f"expected the cell as a positive length, got {self.cell!r}")
        if not (math.isfinite(self.datum_sigma) and self.datum_sigma >= 0):
            raise InputError(f"expected the datum's sigma as a length of at least 0, got {self.datum_sigma!r}")

    @property
    def files(self) -> tuple[Path, ...]:
        """Files that the settings name; no output may replace them."""
        return tuple(file for file in (self.stable, self.zones) if file is not None)


def parse_line(flag: str, text: str) -> Line:
    """Parse the ends x0,y0,x1,y1 of a line.

    Raises:
        InputError: the text is not four finite numbers, or the ends are equal.
    """
    values = parse_numbers(flag, text, float)
    if len(values) != 4 or not all(map(math.isfinite, values)) or values[:2] == values[2:]:
        raise InputError(f"expected {flag} as two different places x0,y0,x1,y1, got {text!r}")
    return values[0], values[1], values[2], values[3]


def parse_place(flag: str, text: str) -> Place:
    """Parse a place x,y.

    Raises:
        InputError: the text is not two finite numbers.
    """
    values = parse_numbers(flag, text, float)
    if len(values) != 2 or not all(map(math.isfinite, values)):
        raise InputError(f"expected {flag} as a place x,y, got {text!r}")
    return values[0], values[1]
