"""Distances of the points of one tile to the other cloud, and their sums for the metrics."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from operator import add
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pcbench.deformation.polynomials import whole_normal_equations
from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.regions import Mask, Region
from pcbench.io.map_tiles import MapOverview
from pcbench.measure.budget import FIRST, BudgetSums, FitFrame, sum_queries
from pcbench.measure.deviation import Spread
from pcbench.measure.intervals import CorrelationGrid
from pcbench.measure.metrics import plane_distances
from pcbench.measure.tiled.columns import column_file, save_column
from pcbench.measure.tiled.labels import PointLabels
from pcbench.measure.tiled.overview import OverviewSums, PixelGrid, PixelSums, along_upward_normals
from pcbench.measure.tiled.search import nearest_in_tiles
from pcbench.measure.tiled.spreads import Distribution, spread_of
from pcbench.measure.tiled.steps import Steps, tile_tasks
from pcbench.measure.tiled.sums import GroupSums
from pcbench.measure.tiled.tiles import TiledCloud
from pcbench.measure.tiled.totals import DirectionTotals
from pcbench.tasks.results import read_shared, write_result

DISTANCE, PLANE_DISTANCE, MEASURED = "distance", "plane_distance", "measured"
_MERGED_AT_ONCE = 32  # tiles whose sums are in memory


@dataclass(frozen=True, eq=False)
class TiledPair:
    """A reference and an aligned candidate in tiles, with all that the tasks of a candidate have in common.

    Attributes:
        reference: tiles of the reference, with normals if it has any.
        candidate: tiles of the aligned candidate.
        forth: folder for the distances of the candidate's points.
        back: folder for the distances of the reference's points.
        grid: correlation cells of the intervals.
        voxel, corner: side and origin (3,) of the voxels of area weighting.
        thresholds: distance thresholds of the F-score.
        max_distance: length beyond which no closest point is searched.
        overlap_distance: distance within which a point lies on the other cloud.
        pixels: grid of the overview; None: none is made.
        frame: frame of the budget's sums; None: there is no budget.
        labels: labels of the points of the candidate and of the reference.
    """

    reference: TiledCloud
    candidate: TiledCloud
    forth: Path
    back: Path
    grid: CorrelationGrid
    voxel: float
    corner: FloatArray
    thresholds: tuple[float, ...]
    max_distance: float
    overlap_distance: float
    pixels: PixelGrid | None
    frame: FitFrame | None
    labels: tuple[PointLabels, PointLabels]

    @property
    def has_normals(self) -> bool:
        """Return whether the reference has normals; one or two points have only given ones."""
        return self.reference.has_column(self.reference.normals)


class DistanceSums(NamedTuple):
    """Sums over the distances of one tile or of several.

    Attributes:
        totals: counts and sums for the metrics.
        near: sums over the points within the overlap distance of squared distances to planes, as `square`.
        pixels: sums of one tile per pixel of the overview, if one is made.
        squares: sums of squared distances to planes by label, as `square`.
        budget: sums of the budget, without these squares; None if there is no budget, or distances are unknown.
    """

    totals: DirectionTotals
    near: GroupSums
    pixels: PixelSums | None
    squares: GroupSums
    budget: BudgetSums | None

    @property
    def budget_sums(self) -> BudgetSums | None:
        """All sums of the budget; None if there is none."""
        if self.budget is None:
            return None
        squares = np.zeros(len(self.budget.counts))
        squares[self.squares.keys] = self.squares.sums("square")
        return replace(self.budget, squares=squares)

    @classmethod
    def merge(cls, parts: Iterable[DistanceSums]) -> DistanceSums:
        """Return the sums over all tiles of one or several parts, without pixels, merged some at a time."""
        merged: list[DistanceSums] = []
        for part in parts:
            merged.append(part)
            if len(merged) == _MERGED_AT_ONCE:
                merged = [_merge(merged)]
        return _merge(merged)


@dataclass(frozen=True, eq=False)
class MeasuredDirection:
    """The measured distances of one direction.

    Attributes:
        stage: start of the names of its stages.
        queries: tiles of the points from which distances were measured.
        folder: folder of the distances.
        sums: sums over all of them, without pixels.
        overview: raster of the distances, in local coordinates; None: none is made.
    """

    stage: str
    queries: TiledCloud
    folder: Path
    sums: DistanceSums
    overview: MapOverview | None = None

    def files(self, column: str) -> list[Path]:
        """Return the files of a column of the distances, such as `DISTANCE`, of all tiles with points."""
        return [column_file(self.folder, number, column) for number in self.queries.occupied]


def measure_tiles(
    steps: Steps, pair: TiledPair, stage: str, name: str, region: Region | None
) -> tuple[MeasuredDirection, MeasuredDirection]:
    """Measure both directions, c→r and r→c, tile by tile, inside a region.

    Args:
        steps: the steps of the comparison.
        pair: both clouds.
        stage: start of the names of the stages.
        name: name of the candidate, for progress.
        region: the measured region in local coordinates; None: everything.
    """
    file, key = steps.folder / f"{stage}.pair", f"{steps.key}{stage}"
    write_result(file, key, pair)

    def measured(
        way: str, function: Callable[..., DistanceSums], queries: TiledCloud, folder: Path, title: str
    ) -> MeasuredDirection:
        folder.mkdir(parents=True, exist_ok=True)
        tasks = tile_tasks(queries, lambda number: (file, key, number, region))
        raster = None if pair.pixels is None else OverviewSums(pair.pixels)

        def parts() -> Iterator[DistanceSums]:
            for part in steps.results(f"{stage}-{way}", function, tasks, title):
                if raster is not None and part.pixels is not None:
                    raster.add(part.pixels)
                yield part._replace(pixels=None)

        sums = DistanceSums.merge(parts())
        overview = None if raster is None else raster.overview(np.zeros(3))
        return MeasuredDirection(f"{stage}-{way}", queries, folder, sums, overview)

    return (
        measured("forth", measure_candidate_tile, pair.candidate, pair.forth, f"{name}: measuring c→r"),
        measured("back", measure_reference_tile, pair.reference, pair.back, f"{name}: measuring r→c"),
    )


def measure_spreads(steps: Steps, direction: MeasuredDirection) -> dict[str, Spread]:
    """Return the summary statistics of the distances to points and to planes, by the names of their columns."""
    totals = direction.sums.totals

    def spread(name: str, distribution: Distribution) -> Spread:
        return spread_of(direction.files(name), distribution, map_files=steps.file_map(f"{direction.stage}-{name}"))

    spreads = {DISTANCE: spread(DISTANCE, totals.distances)}
    if totals.censored:  # these are not even bounds
        spreads[DISTANCE] = replace(spreads[DISTANCE], std=None, nmad=None)
    if totals.plane_distances is not None:
        has_planes = totals.has_planes  # False: distances of points beyond the maximum distance are unknown
        spreads[PLANE_DISTANCE] = spread(PLANE_DISTANCE, totals.plane_distances) if has_planes else Spread()
    return spreads


def _merge(parts: Sequence[DistanceSums]) -> DistanceSums:
    return DistanceSums(
        DirectionTotals.merge([part.totals for part in parts]),
        GroupSums.merge([part.near for part in parts]),
        None,
        GroupSums.merge([part.squares for part in parts]),
        reduce(add, budgets) if (budgets := [part.budget for part in parts if part.budget is not None]) else None,
    )


def measure_candidate_tile(file: Path, key: str, number: int, region: Region | None) -> DistanceSums:
    """Measure and store the distances of the points of a tile of the candidate to the reference.

    Args:
        file: the shared `TiledPair`.
        key: identifies its content.
        number: number of the tile.
        region: measured region in local coordinates; None: everything.
    """
    pair = read_shared(file, key, TiledPair)
    points, rows, inside = _queries(pair.candidate, number, region)
    matches = nearest_in_tiles(points, pair.reference, 1, pair.max_distance)
    closest = matches.column(pair.reference, "points")[:, 0]
    normals = np.full(points.shape, np.nan)
    if pair.has_normals:
        normals = matches.column(pair.reference, pair.reference.normals)[:, 0]
    planes = plane_distances(points, closest, normals)
    # Intervals count a distance where the reference is.
    cells = pair.grid.cells_of(np.where(np.isnan(closest), points, closest))
    distances = _Distances(points, rows, cells, matches.distances[:, 0], planes, np.isnan(closest[:, 0]))
    budget = _budget_sums(pair, planes, closest, normals, pair.labels[0], points)
    return _store(pair, pair.forth, number, inside, distances, along_upward_normals(planes, normals), budget)


def measure_reference_tile(file: Path, key: str, number: int, region: Region | None) -> DistanceSums:
    """Measure and store the distances of the points of a tile of the reference to the candidate.

    Arguments are as for `measure_candidate_tile`.
    """
    pair = read_shared(file, key, TiledPair)
    points, rows, inside = _queries(pair.reference, number, region)
    matches = nearest_in_tiles(points, pair.candidate, 1, pair.max_distance)
    closest = matches.column(pair.candidate, "points")[:, 0]
    normals = np.full(points.shape, np.nan)
    if pair.has_normals:
        normals = pair.reference.load(number, pair.reference.normals)
        normals = normals if inside is None else normals[inside]
    planes = plane_distances(points, closest, normals)
    cells = pair.grid.cells_of(points)
    distances = _Distances(points, rows, cells, matches.distances[:, 0], planes, np.isnan(closest[:, 0]))
    budget = _budget_sums(pair, planes, points, normals, pair.labels[1], points)
    # The queries are the reference's points: below the candidate, their distance to it is negative.
    return _store(pair, pair.back, number, inside, distances, -along_upward_normals(planes, normals), budget)


class _TileBudget(NamedTuple):
    """Sums of the budget of a tile, if there is one, and the label of each query, counted from 0."""

    sums: BudgetSums | None
    labels: IntArray


def _budget_sums(
    pair: TiledPair,
    planes: FloatArray,
    places: FloatArray,
    normals: FloatArray,
    labels: PointLabels,
    points: FloatArray,
) -> _TileBudget:
    """Return the sums of the budget over queries (n, 3), with distances (n,) from planes at places (n, 3)."""
    if pair.frame is None or np.isnan(planes).any():
        return _TileBudget(None, np.zeros(len(points), np.int64))
    changes = labels.of_points(points)
    sums = sum_queries(planes, places, normals, None, changes, labels.changes, pair.frame, whole_normal_equations)
    return _TileBudget(sums, changes.astype(np.int64) + FIRST)


class _Distances(NamedTuple):
    """The queries of a tile and their distances."""

    points: FloatArray  # (n, 3)
    rows: IntArray  # (n,)
    cells: IntArray  # (n,) correlation cells
    to_points: FloatArray  # (n,)
    to_planes: FloatArray  # (n,); NaN: unknown
    is_censored: Mask  # (n,) whether there is no closest point within the maximum distance


def _queries(cloud: TiledCloud, number: int, region: Region | None) -> tuple[FloatArray, IntArray, IntArray | None]:
    """Return the points of a tile inside the region, their rows, and their positions in the tile; None: all."""
    points, rows = cloud.load(number, "points"), cloud.load(number, "rows")
    if region is None:
        return points, rows, None
    inside = np.flatnonzero(region.contains(points))
    return points[inside], rows[inside], inside


def _store(
    pair: TiledPair,
    folder: Path,
    number: int,
    inside: IntArray | None,
    distances: _Distances,
    signed: FloatArray,
    budget: _TileBudget,
) -> DistanceSums:
    """Store the distances of a tile and add them up.

    Args:
        pair: both clouds.
        folder: folder of the distances.
        number: number of the tile.
        inside: positions of the queries in the tile; None: all.
        distances: the queries and their distances.
        signed: (n,) signed distances, positive where the candidate is above the reference; NaN: unknown.
        budget: sums of the budget.
    """
    save_column(folder, number, DISTANCE, distances.to_points)
    save_column(folder, number, PLANE_DISTANCE, distances.to_planes)
    if inside is not None:
        save_column(folder, number, MEASURED, inside)
    to_planes = np.where(np.isnan(distances.to_planes), 0.0, distances.to_planes)
    totals = DirectionTotals.of(
        distances.points,
        distances.rows,
        distances.cells,
        distances.to_points,
        to_planes if pair.has_normals else None,
        thresholds=pair.thresholds,
        voxel=pair.voxel,
        corner=pair.corner,
        is_censored=distances.is_censored,
    )
    is_near = (distances.to_points <= pair.overlap_distance) & ~distances.is_censored
    near = GroupSums.of(None, {"square": np.square(to_planes[is_near])})
    pixels = None if pair.pixels is None else PixelSums.of(pair.pixels, distances.points, distances.to_points, signed)
    squares = GroupSums.of(budget.labels, {"square": np.square(to_planes)})
    return DistanceSums(totals, near, pixels, squares, budget.sums)
