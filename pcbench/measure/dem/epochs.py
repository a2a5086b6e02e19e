"""Surveys of one area at several times: where they lie, and their heights on a common grid.

The points are read piece by piece, twice: for the area that they cover, from which the size of the cells follows, and
for the moments of their heights in the cells. So the memory depends on the number of cells and not of points, and the
result is the same however a cloud is divided into files and pieces.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import date

import numpy as np

from pcbench.errors import InputError
from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.crs import check_heights, check_lengths, crs_name, same_crs, single_unit
from pcbench.geometry.units import unit_key, unit_or_given
from pcbench.io.pieces.reading import read_piece, reading_warnings
from pcbench.io.pieces.types import CloudOnDisk, Piece, PieceNotes
from pcbench.io.source import Source
from pcbench.measure.dem.grid import BYTES_PER_CELL, BYTES_PER_FURTHER_EPOCH, CellMoments, HeightGrid, default_cell
from pcbench.measure.dem.surface import EpochSurface, GridMethod, surface_of

_MAX_COVERAGE_CELLS = 4096
_POINTS_PER_COVERAGE_CELL = 16
_BYTES_PER_POINT = 200
"""Memory for each point of an epoch for methods that need all points, in bytes; measured with a triangulation."""
_BASE_BYTES = 250 << 20
_DATE = re.compile(r"(?<!\d)((?:19|20)\d\d)(?:[-_.]?(0[1-9]|1[0-2])(?:[-_.]?(0[1-9]|[12]\d|3[01]))?)?(?!\d)")


class Coverage:
    """The extent of points and the area that they cover, to which pieces are added.

    The area is that of the occupied cells of a coarse grid, whose cells double as the extent grows. The result does not
    depend on the order or division of the points.
    """

    def __init__(self) -> None:
        self.count = 0
        self.low = np.full(3, np.inf)
        self.high = np.full(3, -np.inf)
        self._side = 0.0
        self._cells = np.empty((0, 2), np.int64)

    def add(self, points: FloatArray) -> None:
        """Add points (N, 3)."""
        if not len(points):
            return
        self.count += len(points)
        self.low, self.high = np.minimum(self.low, points.min(axis=0)), np.maximum(self.high, points.max(axis=0))
        if not self._side:
            self._side = 2.0**-20
        side = self._least_side(_MAX_COVERAGE_CELLS)
        first, last = (np.floor(corner[:2] / side).astype(np.int64) for corner in (self.low, self.high))
        is_covered = np.zeros(last - first + 1, dtype=bool)
        for cells in (self._coarser(side), np.floor(points[:, :2] / side).astype(np.int64)):
            is_covered[tuple((cells - first).T)] = True
        self._side, self._cells = side, np.argwhere(is_covered) + first

    @property
    def area(self) -> float:
        """Area that the points cover, in squared units."""
        side = self._least_side(min(_MAX_COVERAGE_CELLS, max(self.count // _POINTS_PER_COVERAGE_CELL, 1)))
        return len(np.unique(self._coarser(side), axis=0)) * side**2

    def _least_side(self, cells: int) -> float:
        """Return the smallest power of two, not below the present side, with at most that many cells in the extent."""
        width, height = self.high[:2] - self.low[:2]
        least = max(math.sqrt(width * height / cells), max(width, height) / cells, self._side)
        return 2.0 ** math.ceil(math.log2(least) - 1e-12)

    def _coarser(self, side: float) -> IntArray:
        cells: IntArray = self._cells >> round(math.log2(side / self._side))
        return cells


@dataclass(frozen=True, eq=False)
class Epoch:
    """One survey.

    Attributes:
        name: its name in tables.
        source: its files.
        date: its date, if known.
        cloud: its files as their headers describe them.
        count: number of points that passed the filters.
        low: smallest coordinates (3,).
        high: largest coordinates (3,).
        area: area that the points cover.
        warnings: warnings from reading.
    """

    name: str
    source: Source
    date: date | None
    cloud: CloudOnDisk
    count: int
    low: FloatArray
    high: FloatArray
    area: float
    warnings: tuple[str, ...]

    @property
    def density(self) -> float:
        """Points per squared unit of the covered area."""
        return self.count / self.area


def open_epoch(source: Source, name: str, day: date | None, unit: str | None = None) -> Epoch:
    """Read the files of a survey once for its extent, its number of points and its warnings.

    Args:
        source: its files.
        name: its name in tables.
        day: its date, if known.
        unit: unit of its coordinates, if its files state none.

    Raises:
        InputError: a file is damaged, no point is left, or the coordinates are no lengths of one unit or no heights,
            or the files state another unit than the given one.
    """
    cloud = source.pieces()
    check_heights(cloud.crs, str(source.path))
    warnings = list(cloud.warnings)
    coverage, notes = Coverage(), list[tuple[Piece, PieceNotes]]()
    for piece in cloud.pieces:
        part = read_piece(cloud, piece)
        coverage.add(part.points)
        notes.append((piece, part.notes))
    warnings += reading_warnings(cloud, notes)
    if not coverage.count:
        raise InputError(f"{source.path}: expected at least one point, got none: check --classes and --returns")
    centre = (coverage.low + coverage.high) / 2
    check_lengths(_Place(cloud.crs, cloud.unit, (float(centre[0]), float(centre[1]))), str(source.path))
    if cloud.unit is None:
        mixed: list[str] = []
        single_unit(cloud.crs, mixed.append)
        if mixed:
            raise InputError(f"{source.path}: expected one unit, because volumes have one: {mixed[0]}")
    cloud = replace(cloud, unit=unit_or_given(cloud.unit, unit, str(source.path)))
    if not (coverage.low < coverage.high)[:2].all():
        raise InputError(f"{source.path}: expected points that cover an area, got {coverage.count:,} on a line")
    return Epoch(name, source, day, cloud, coverage.count, coverage.low, coverage.high, coverage.area, tuple(warnings))


@dataclass(frozen=True)
class _Place:
    crs: str | None
    unit: str | None
    centre: tuple[float, float]


def date_of(text: str) -> date | None:
    """Return the date in a name such as 2023-05-17, 20230517 or 2023; the first day where a part is missing."""
    matches = _DATE.findall(text)
    if len(matches) != 1:
        return None
    year, month, day = (int(part) if part else 1 for part in matches[0])
    try:
        return date(year, month, day)
    except ValueError:
        return None


def check_same_system(epochs: Sequence[Epoch]) -> None:
    """Check that all surveys have the same coordinate system and unit, and share an area.

    Raises:
        InputError: they differ, or the extents do not meet. The message names both files.
    """
    first = epochs[0]
    for other in epochs[1:]:
        names = f"{first.source.path} and {other.source.path}"
        if first.cloud.crs and other.cloud.crs and not same_crs(first.cloud.crs, other.cloud.crs):
            raise InputError(
                f"{names}: expected one coordinate system, got {crs_name(first.cloud.crs)} and"
                f" {crs_name(other.cloud.crs)}: convert one of them with pcbench convert"
            )
        if first.cloud.unit and other.cloud.unit and unit_key(first.cloud.unit) != unit_key(other.cloud.unit):
            raise InputError(
                f"{names}: expected one unit, got {first.cloud.unit} and {other.cloud.unit}: convert one of them with"
                " pcbench convert"
            )
        if not (np.maximum(first.low, other.low)[:2] < np.minimum(first.high, other.high)[:2]).all():
            raise InputError(f"{names}: expected surveys of one area, but their extents do not meet: check the files")


def common_grid(epochs: Sequence[Epoch], cell: float | None, memory: int) -> HeightGrid:
    """Return the grid of the area that the first survey shares with the others.

    Args:
        epochs: the surveys.
        cell: edge of a cell; None: see `default_cell`, and large enough for the memory.
        memory: bytes that may be used.

    Raises:
        InputError: the cells do not fit into the memory, or a cell is larger than the area, so that its volume would be
            that of an area without points.
    """
    low = np.maximum(epochs[0].low, np.minimum.reduce([epoch.low for epoch in epochs[1:]]))
    high = np.minimum(epochs[0].high, np.maximum.reduce([epoch.high for epoch in epochs[1:]]))
    cell_bytes = BYTES_PER_CELL + BYTES_PER_FURTHER_EPOCH * max(len(epochs) - 2, 0)
    max_cells = int((memory - _BASE_BYTES) / cell_bytes)
    if max_cells < 1:
        raise InputError(f"expected --memory of more than {_BASE_BYTES >> 20} MiB, got {memory / (1 << 20):.3g} MiB")
    width, height = (high - low)[:2].tolist()
    sparsest = min(epochs, key=lambda epoch: epoch.density)
    given = cell
    if cell is None:
        cell = default_cell(width * height, sparsest.density, max_cells)
    if cell > min(width, height):
        reason = "choose smaller cells (--cell)"
        if given is None:
            reason = (
                f"{sparsest.source.path} has {sparsest.count:,} points in an area of {sparsest.area:.3g}: state"
                " --cell, or remove points that lie far from all others"
            )
        raise InputError(f"expected cells within the shared area of {width:.4g} x {height:.4g}, got {cell:g}: {reason}")
    grid = HeightGrid.over(low, high, cell)
    if grid.size > max_cells * 1.1:
        needed = (_BASE_BYTES + grid.size * cell_bytes) / (1 << 20)
        raise InputError(
            f"expected cells that fit into --memory, got {grid.size:,} of {cell:g}, which need {needed:,.0f} MiB:"
            " choose larger cells (--cell) or more memory"
        )
    return grid


def epoch_surface(epoch: Epoch, grid: HeightGrid, method: GridMethod, memory: int) -> EpochSurface:
    """Read a survey and return its heights on a grid.

    Args:
        epoch: the survey.
        grid: the cells.
        method: how points become heights.
        memory: bytes that may be used.

    Raises:
        InputError: the method needs all points and they do not fit into the memory, or the file has changed.
    """
    if method.needs_all_points and epoch.count * _BYTES_PER_POINT > memory:
        raise InputError(
            f"{epoch.source.path}: expected --surface mean or lowest for {epoch.count:,} points, because {method.value}"
            f" needs {epoch.count * _BYTES_PER_POINT / (1 << 30):.1f} GiB: choose one of them or more --memory"
        )
    moments = CellMoments(grid, float((epoch.low[2] + epoch.high[2]) / 2))
    kept, count = [], 0
    for piece in epoch.cloud.pieces:
        points = read_piece(epoch.cloud, piece).points
        count += len(points)
        moments.add(points)
        if method.needs_all_points:
            kept.append(points[grid.surrounds(points)])
    if count != epoch.count:
        raise InputError(f"{epoch.source.path}: expected {epoch.count:,} points, got {count:,}: the file has changed")
    return surface_of(moments, method, np.concatenate(kept) if kept else None)
