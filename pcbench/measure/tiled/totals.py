"""Counts and sums of the distances of one direction, from which its metrics are computed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple, TypeVar, cast

import numpy as np

from pcbench.geometry import voxels
from pcbench.geometry.arrays import FloatArray, IntArray, bounds, rounding_bound
from pcbench.geometry.regions import Mask
from pcbench.measure.deviation import Spread
from pcbench.measure.directions import MEAN_METRICS, PLANE_METRIC
from pcbench.measure.metrics import Distances
from pcbench.measure.results import Extremes
from pcbench.measure.summaries import CellSums, DirectionSummary, within_key
from pcbench.measure.tiled.spreads import Distribution
from pcbench.measure.tiled.sums import Groups, GroupSums

_Array = TypeVar("_Array", FloatArray, IntArray)

_VOXEL_BITS = 21  # per axis, so that three coordinates fit into an integer of 64 bits


class Farthest(NamedTuple):
    """The query with the largest distance; among several, the one with the lowest row."""

    distance: float
    row: int
    point: FloatArray  # (3,)

    def precedes(self, other: Farthest) -> bool:
        """Return whether this query is farther, or equally far with a lower row."""
        return (-self.distance, self.row) < (-other.distance, other.row)


@dataclass(frozen=True, eq=False)
class DirectionTotals:
    """Counts and sums of the queries of one direction, or of some of them. They can be merged in any order.

    Attributes:
        by_cell: sums over correlation cells of the mean metrics by name, and of being within each threshold (1 or 0).
        by_voxel: sums over voxels of the mean metrics by name.
        distances: distribution of the distances to points.
        plane_distances: distribution of the signed distances to planes; None without normals.
        farthest: the query with the largest distance; None without queries.
        corners: (2, 3) lowest and highest corner of the queries; infinite without queries.
        censored: number of queries without a closest point within the maximum distance. Their distances count as this
            one. Their distances to planes are unknown, so all of the direction are: a part of them represents nothing.
    """

    by_cell: GroupSums
    by_voxel: GroupSums
    distances: Distribution
    plane_distances: Distribution | None
    farthest: Farthest | None
    corners: FloatArray
    censored: int

    @classmethod
    def of(
        cls,
        points: FloatArray,
        rows: IntArray,
        cells: IntArray,
        to_points: FloatArray,
        to_planes: FloatArray | None,
        *,
        thresholds: tuple[float, ...],
        voxel: float,
        corner: FloatArray,
        is_censored: Mask | None = None,
    ) -> DirectionTotals:
        """Add up the queries of one tile.

        Args:
            points: (n, 3) queries, in local coordinates.
            rows: (n,) row of each query among all queries of the direction.
            cells: (n,) correlation cell of each query.
            to_points: (n,) distances to the closest points.
            to_planes: (n,) signed distances to the reference's tangent planes; None without normals.
            thresholds: distance thresholds of the F-score.
            voxel: side of the voxels for area weighting.
            corner: (3,) origin of those voxels.
            is_censored: (n,) whether a query has no closest point within the maximum distance. Its distance is that
                maximum, its distance to planes any finite value. None: all have one.

        Raises:
            InputError: a distance is not finite, or not below 2e14.
        """
        measured = Distances(to_points, to_planes)
        means = {metric.name: values for metric in MEAN_METRICS if (values := metric.values_of(measured)) is not None}
        is_found = True if is_censored is None else ~is_censored
        within = {within_key(t): ((to_points <= t) & is_found).astype(np.float64) for t in thresholds}
        return cls(
            GroupSums.of(cells, {**means, **within}),
            GroupSums.of(_voxel_groups(points, voxel, corner), means),
            Distribution.of(to_points),
            None if to_planes is None else Distribution.of(to_planes),
            _farthest(points, rows, to_points),
            np.array(bounds(points)) if len(points) else np.array([[np.inf] * 3, [-np.inf] * 3]),
            0 if is_censored is None else int(np.count_nonzero(is_censored)),
        )

    @classmethod
    def merge(cls, parts: Sequence[DirectionTotals]) -> DirectionTotals:
        """Return the totals of all queries of one or several parts."""
        farthest = None
        for part in parts:
            if part.farthest is not None and (farthest is None or part.farthest.precedes(farthest)):
                farthest = part.farthest
        plane_distances = [part.plane_distances for part in parts if part.plane_distances is not None]
        corners = np.stack([part.corners for part in parts])
        return cls(
            GroupSums.merge([part.by_cell for part in parts]),
            GroupSums.merge([part.by_voxel for part in parts]),
            Distribution.merge([part.distances for part in parts]),
            Distribution.merge(plane_distances) if plane_distances else None,
            farthest,
            np.stack([corners[:, 0].min(axis=0), corners[:, 1].max(axis=0)]),
            sum(part.censored for part in parts),
        )

    @property
    def has_planes(self) -> bool:
        """Return whether the distances of all queries to planes are known."""
        return self.plane_distances is not None and not self.censored

    def summary(
        self,
        *,
        cells: int,
        floors: Mapping[str, float | None],
        spreads: Mapping[str, Spread],
        origin: FloatArray,
    ) -> DirectionSummary:
        """Return the summary of all queries, at least one.

        Args:
            cells: number of correlation cells.
            floors: sampling floor of each mean metric by name; None if it does not exist.
            spreads: spread of `distances` as `distance` and, with normals, of `plane_distances` as `plane_distance`;
                see `pcbench.measure.tiled.spreads.spread_of`.
            origin: (3,) offset that was subtracted from all coordinates.
        """
        assert self.farthest is not None
        names = [name for name in self.by_cell.limbs if name != PLANE_METRIC or self.has_planes]
        ranks = spreads["distance"].percentiles or {}
        return DirectionSummary(
            self.by_cell.count,
            _dense(self.by_cell.keys, self.by_cell.counts, cells),
            {
                name: CellSums(self.by_cell.mean(name), _dense(self.by_cell.keys, self.by_cell.sums(name), cells))
                for name in names
            },
            {name: float(np.mean(self.by_voxel.means(name))) for name in self.by_voxel.limbs if name in names},
            floors,
            spreads,
            Extremes(self.farthest.distance, ranks["p95"], ranks["p99"], self.farthest.point + origin),
            None,
            rounding_bound(self.corners, origin),
        )


def _voxel_groups(points: FloatArray, voxel: float, corner: FloatArray) -> Groups:
    """Group points (n, 3) by voxel, as `pcbench.geometry.voxels.cells` does."""
    grid = voxels.cells(points, voxel, corner)
    keys = _voxel_keys(points[grid.first], voxel, corner)
    ascending, group_of_cell = np.unique(keys, return_inverse=True)
    return Groups(ascending, group_of_cell[grid.of_point])


def _voxel_keys(points: FloatArray, voxel: float, corner: FloatArray) -> IntArray:
    """Return an integer (M,) for the voxel of each point.

    Within 2^20 voxels of the corner it is made of their coordinates. Farther ones have a negative hash: two of them
    have the same one with a probability of 2^-63.
    """
    coordinates = np.clip(np.floor((points - corner) / voxel), -(2.0**31), 2.0**31 - 1).astype(np.int64)
    shifted = coordinates + (1 << (_VOXEL_BITS - 1))
    packed = (shifted[:, 0] << 2 * _VOXEL_BITS) + (shifted[:, 1] << _VOXEL_BITS) + shifted[:, 2]
    is_far = ((shifted < 0) | (shifted >= 1 << _VOXEL_BITS)).any(axis=1)
    mixed = np.zeros(len(points), np.uint64)
    for axis in range(3):  # the finaliser of SplitMix64 after each coordinate (Steele et al. 2014)
        mixed = (mixed ^ coordinates[:, axis].view(np.uint64)) + np.uint64(0x9E3779B97F4A7C15)
        mixed = (mixed ^ (mixed >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        mixed = (mixed ^ (mixed >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        mixed ^= mixed >> np.uint64(31)
    return np.where(is_far, (mixed | np.uint64(1 << 63)).view(np.int64), packed)


def _farthest(points: FloatArray, rows: IntArray, to_points: FloatArray) -> Farthest | None:
    if not len(rows):
        return None
    largest = to_points.max()
    tied = np.flatnonzero(to_points == largest)
    farthest = tied[np.argmin(rows[tied])]
    return Farthest(float(largest), int(rows[farthest]), points[farthest].copy())


def _dense(keys: IntArray, values: _Array, size: int) -> _Array:
    """Return values by key (size,), 0 for keys that do not occur."""
    dense = np.zeros(size, values.dtype)
    dense[keys] = values
    return cast(_Array, dense)
