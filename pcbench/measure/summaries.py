"""Sums and statistics of the distances of one direction, from which its metrics are computed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pcbench.geometry import voxels
from pcbench.geometry.arrays import FloatArray, IntArray, rounding_bound
from pcbench.measure import metrics
from pcbench.measure.deviation import Spread
from pcbench.measure.directions import MEAN_METRICS, PLANE_METRIC, Direction
from pcbench.measure.intervals import CellNumbers, CorrelationCells
from pcbench.measure.plane_sample import PlaneSample
from pcbench.measure.results import Extremes, SampledMean


class CellSums(NamedTuple):
    """The mean of a quantity over all queries, and the sum of its values in each correlation cell."""

    mean: float
    sums: FloatArray  # (B,)


@dataclass(frozen=True, eq=False)
class DirectionSummary:
    """All that the metrics of one direction need to know about its queries.

    Attributes:
        count: number of queries.
        cell_counts: (B,) number of queries in each correlation cell.
        means: mean and sums of each quantity: of the mean metrics by name, and of being within each threshold (1 or 0)
            by `within_key`. Without distances of all queries to tangent planes, their metric is missing.
        area_weighted: area-weighted mean of the mean metrics by name; None if it is not defined.
        floors: sampling floor of each mean metric by name; None if it does not exist.
        spreads: distribution of `distance` and, if there are normals, of `plane_distance`.
        extremes: largest distance, high percentiles, and the farthest query.
        d2_sample: sample in which the distances to tangent planes were measured; None if it was all queries.
        rounding: upper bound of the rounding error of the queries' coordinates, as a length.
    """

    count: int
    cell_counts: IntArray
    means: Mapping[str, CellSums]
    area_weighted: Mapping[str, float | None]
    floors: Mapping[str, float | None]
    spreads: Mapping[str, Spread]
    extremes: Extremes
    d2_sample: SampledMean | None
    rounding: float


def summarize(
    direction: Direction,
    thresholds: tuple[float, ...],
    *,
    cells: CorrelationCells,
    voxel: float,
    corner: FloatArray,
    origin: FloatArray,
) -> DirectionSummary:
    """Summarise one direction, one quantity at a time to limit memory.

    Args:
        direction: distances of its queries.
        thresholds: distance thresholds of the F-score.
        cells: correlation cells of the intervals.
        voxel: side of the voxels for area weighting.
        corner: (3,) origin of those voxels.
        origin: (3,) offset that was subtracted from all coordinates.
    """
    to_points, to_planes = direction.distances
    area_weighted = _area_weighted_means(direction, voxel, corner)
    means: dict[str, CellSums] = {}
    for metric in MEAN_METRICS:
        if (values := metric.values_of(direction.distances)) is not None:
            means[metric.name] = _cell_sums(values, direction.cells, cells.number)
    for threshold in thresholds:
        within = (to_points <= threshold).astype(np.float64)
        means[within_key(threshold)] = _cell_sums(within, direction.cells, cells.number)

    spreads = {"distance": Spread.of(to_points)}
    if to_planes is not None:
        spreads["plane_distance"] = Spread.of(to_planes)
    ranks = spreads["distance"].percentiles or {}
    worst = direction.points[int(np.argmax(to_points))] + origin
    return DirectionSummary(
        len(to_points),
        np.bincount(direction.cells, minlength=cells.number),
        means,
        area_weighted,
        direction.floors,
        spreads,
        Extremes(metrics.one_way_hausdorff(to_points), ranks["p95"], ranks["p99"], worst),
        SampledMean(len(to_planes.rows), to_planes.half_width) if isinstance(to_planes, PlaneSample) else None,
        rounding_bound(direction.points, origin),
    )


def within_key(threshold: float) -> str:
    """Name in `DirectionSummary.means` of the share of queries within a threshold."""
    return f"within/{threshold!r}"


def _area_weighted_means(direction: Direction, voxel: float, corner: FloatArray) -> dict[str, float | None]:
    """Return the area-weighted mean of each metric that has distances; None if only a sample was measured.

    A sample represents a whole direction, but not each voxel.
    """
    grid = voxels.cells(direction.points, voxel, corner)
    means: dict[str, float | None] = {}
    for metric in MEAN_METRICS:
        if metric.name == PLANE_METRIC and isinstance(direction.distances.to_planes, PlaneSample):
            means[metric.name] = None
        elif (values := metric.values_of(direction.distances)) is not None:
            means[metric.name] = metrics.area_weighted_mean(values, grid)
    return means


def _cell_sums(values: FloatArray, cells: CellNumbers, number: int) -> CellSums:
    return CellSums(float(np.mean(values)), np.bincount(cells, values, number).astype(np.float64, copy=False))
