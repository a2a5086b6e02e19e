"""A measured change as plain values: what change.json holds, and what texts, tables and pictures are made from.

The fields of the types are the keys of change.json. Values with an interval are [value, low, high].
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import date
from typing import Any, NamedTuple

import numpy as np

from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.regions import Polygon, Region, Union
from pcbench.io.json_values import json_values
from pcbench.measure.dem.difference import DemOfDifference, ErrorBin
from pcbench.measure.dem.epochs import Epoch, date_of
from pcbench.measure.dem.grid import HeightGrid
from pcbench.measure.dem.result import AreaHistory, EpochChange
from pcbench.measure.dem.series import HeightTrend
from pcbench.measure.dem.volumes import AreaChange, CutFill, EstimatedChange
from pcbench.report.document import provenance

DOCUMENT, SCHEMA = "change.json", "pcbench.change/1"

Ring = tuple[tuple[float, float], ...]


@dataclass(frozen=True)
class EpochRecord:
    """A survey: its name, file, date, number of points, and the area that they cover."""

    name: str
    path: str
    date: str | None
    points: int
    area: float


class RangedError(NamedTuple):
    """A correlated error of a cell: its standard deviation, and the distance at which the correlation is 0.05."""

    sigma: float
    range: float


@dataclass(frozen=True)
class ErrorRecord:
    """Errors of the difference of a cell, and where they were estimated.

    Attributes:
        white: median standard deviation of the errors that differ from cell to cell.
        short: error that nearby cells share.
        long: error that wide parts of the area share.
        whole: error as long as the area, which its data do not exclude.
        datum_sigma: standard deviation of the offset between the epochs, as given.
        median_level: median level of detection.
        stable_area: area of the terrain that shows the errors.
        offset: mean difference of the named stable terrain, which was subtracted; None: none was named.
        by_slope: spread of stable cells by slope in degrees.
        by_count: spread of stable cells by the number of points in the sparser epoch.
    """

    white: float
    short: RangedError
    long: RangedError
    whole: RangedError
    datum_sigma: float
    median_level: float
    stable_area: float
    offset: float | None
    by_slope: tuple[ErrorBin, ...] = ()
    by_count: tuple[ErrorBin, ...] = ()


@dataclass(frozen=True)
class NormalsRecord:
    """Volumes along normals, see `pcbench.measure.dem.along_normals.NormalVolume`."""

    volumes: CutFill
    mean: EstimatedChange
    area: float
    void_area: float
    side: float
    reach: float
    steep_share: float
    undetected_share: float


@dataclass(frozen=True)
class ChangeRecord:
    """The change from the first epoch to a later one.

    Attributes:
        epoch: name of the later epoch.
        whole: change of all that both epochs cover.
        zones: changes of the zones.
        parts: changed parts, the largest first.
        part_count: number of changed parts, of which the smallest may not be listed.
        errors: errors of a cell; None: too little terrain without change shows them.
        along_normals: volumes along normals, if they were measured.
    """

    epoch: str
    whole: AreaChange
    zones: tuple[AreaChange, ...]
    parts: tuple[AreaChange, ...]
    part_count: int
    errors: ErrorRecord | None
    along_normals: NormalsRecord | None


@dataclass(frozen=True)
class ProfileRecord:
    """Heights along a line: `heights` has a row per epoch, `levels` one per later epoch (levels of detection)."""

    line: tuple[float, float, float, float]
    distances: tuple[float, ...]
    heights: tuple[tuple[float, ...], ...]
    levels: tuple[tuple[float, ...], ...]


@dataclass(frozen=True)
class PlaceRecord:
    """Change of a place x, y from the first epoch to each later one."""

    place: tuple[float, float]
    changes: tuple[EstimatedChange, ...]


@dataclass(frozen=True)
class TrendRecord:
    """Trends of the cells: median, share of the area with a trend beyond 1.96 standard errors, rising and falling."""

    is_per_year: bool
    median: float
    rising_share: float
    falling_share: float


@dataclass(frozen=True)
class ChangeDocument:
    """The change of an area over all epochs.

    Attributes:
        epochs: the surveys in the order given.
        grid: the cells.
        settings: settings of the measurement.
        changes: change from the first epoch to each later one.
        zone_rings: rings of the polygons of each zone.
        profiles: heights along lines.
        places: changes of places.
        years: times of the epochs in years since the first; None if one has no date.
        trend: trends of the cells, with three epochs or more.
        unit: unit of lengths, if known.
        crs: coordinate system, if known.
        warnings: what not to trust.
        provenance: version, machine, command and time.
    """

    epochs: tuple[EpochRecord, ...]
    grid: HeightGrid
    settings: Mapping[str, Any]
    changes: tuple[ChangeRecord, ...]
    zone_rings: Mapping[str, tuple[Ring, ...]]
    profiles: tuple[ProfileRecord, ...]
    places: tuple[PlaceRecord, ...]
    years: tuple[float, ...] | None
    trend: TrendRecord | None
    unit: str | None
    crs: str | None
    warnings: tuple[str, ...]
    provenance: Mapping[str, Any] | None = field(default=None, compare=False)

    @classmethod
    def of(cls, history: AreaHistory) -> ChangeDocument:
        """Return the document of a measurement."""
        times = history.times
        settings = {name: _plain(value) for name, value in vars(history.settings).items()}
        return cls(
            epochs=tuple(_epoch(epoch) for epoch in history.epochs),
            grid=history.grid,
            settings=settings,
            changes=tuple(_change(change, history) for change in history.changes),
            zone_rings={name: tuple(rings_of(region)) for name, region in history.zone_regions.items()},
            profiles=tuple(
                ProfileRecord(each.line, _floats(each.distances), _rows(each.heights), _rows(each.levels))
                for each in history.profiles
            ),
            places=tuple(PlaceRecord(each.place, each.changes) for each in history.places),
            years=None if times is None else _floats(times),
            trend=None if history.trend is None else _trend(history.trend),
            unit=history.unit,
            crs=history.crs,
            warnings=history.warnings,
            provenance=provenance(None),
        )

    def values(self) -> dict[str, Any]:
        """Return the content of change.json."""
        return {"schema": SCHEMA, **json_values(self)}

    @property
    def cell_area(self) -> float:
        """Area of a cell, in squared units."""
        return self.grid.cell_area


def rings_of(region: Region) -> list[Ring]:
    """Return the rings of the polygons of a region in the plane."""
    if isinstance(region, Union):
        return [ring for part in region.regions for ring in rings_of(part)]
    assert isinstance(region, Polygon)
    return [tuple((float(x), float(y)) for x, y in ring) for ring in region.rings]


def _epoch(epoch: Epoch) -> EpochRecord:
    file, day = epoch.source.path.name, None
    if epoch.date is not None:
        day = date_in_name(epoch.date, file) if date_of(file) == epoch.date else epoch.date.isoformat()
    return EpochRecord(epoch.name, str(epoch.source.path), day, epoch.count, epoch.area)


def date_in_name(day: date, name: str) -> str:
    """Return a date that comes from a name, as precisely as the name states it: 2023, 2023-05 or 2023-05-17."""
    digits = re.sub(r"[-_.]", "", name)
    return next(f"{day:{form}}" for form in ("%Y-%m-%d", "%Y-%m", "%Y") if f"{day:{form}}".replace("-", "") in digits)


def _change(change: EpochChange, history: AreaHistory) -> ChangeRecord:
    normals = change.along_normals
    difference = change.difference
    return ChangeRecord(
        epoch=change.epoch.name,
        whole=change.whole,
        zones=change.zones,
        parts=change.parts,
        part_count=0 if difference.model is None else int(difference.parts.max(initial=0)),
        errors=_errors(difference, history.grid.cell),
        along_normals=None
        if normals is None
        else NormalsRecord(
            normals.volumes,
            normals.mean,
            normals.area,
            normals.void_area,
            normals.side,
            normals.m3c2.half_length,
            normals.steep_share,
            normals.undetected_share,
        ),
    )


def _errors(difference: DemOfDifference, cell: float) -> ErrorRecord | None:
    model = difference.model
    if model is None:
        return None
    short, long, whole = (RangedError(each.sigma, each.range * cell) for each in (model.short, model.long, model.far))
    return ErrorRecord(
        white=math.sqrt(model.white_scale * float(np.nanmedian(difference.white))),
        short=short,
        long=long,
        whole=whole,
        datum_sigma=difference.datum_sigma,
        median_level=float(np.nanmedian(difference.level_of_detection)),
        stable_area=float(np.count_nonzero(difference.stable)) * cell**2,
        offset=difference.offset,
        by_slope=difference.by_slope,
        by_count=difference.by_count,
    )


def _trend(trend: HeightTrend) -> TrendRecord:
    with np.errstate(invalid="ignore"):
        scores = trend.rate / trend.sigma
    count = max(int(np.isfinite(trend.rate).sum()), 1)
    rising, falling = (float(np.count_nonzero(sign * np.nan_to_num(scores) > 1.96)) / count for sign in (1, -1))
    median = float(np.nanmedian(trend.rate)) if np.isfinite(trend.rate).any() else math.nan
    return TrendRecord(trend.is_per_year, median, rising, falling)


def _floats(values: FloatArray) -> tuple[float, ...]:
    return tuple(float(value) for value in values)


def _rows(values: Sequence[FloatArray] | FloatArray) -> tuple[tuple[float, ...], ...]:
    return tuple(_floats(row) for row in values)


def _plain(value: Any) -> Any:
    return str(value) if value is not None and not isinstance(value, bool | int | float | str | tuple) else value
