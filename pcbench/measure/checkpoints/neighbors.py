"""The points of a cloud that are nearest to check points in plan view, collected piece by piece."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray, bounds
from pcbench.geometry.neighbors import Index

NEIGHBORS = 256  # kept per check point: about nine point spacings around it
_ROUNDING = 1e-9
_MAX_CELLS = 1000  # along a side
_MAX_REACH_SHARE = 0.1  # of the size of a piece; beyond it, cells hardly leave out points


class PlanNeighbors:
    """The nearest points in plan view of each check point, among all points that were added.

    The memory depends on the number of check points, not on the cloud.

    Args:
        positions: (M, 2) x and y of the check points.
    """

    def __init__(self, positions: FloatArray) -> None:
        count = len(positions)
        self.positions = np.asarray(positions, dtype=np.float64)
        self.total = 0
        self.low, self.high = np.full(3, np.inf), np.full(3, -np.inf)
        self._points = np.full((count, NEIGHBORS, 3), np.nan)
        self._distances = np.full((count, NEIGHBORS), np.inf)

    def add(self, points: FloatArray) -> None:
        """Add points (N, 3) of the cloud; the order of all points decides only between equal distances."""
        if not len(points):
            return
        self.total += len(points)
        low, high = bounds(points)
        self.low, self.high = np.minimum(self.low, low), np.maximum(self.high, high)
        # A check point needs this piece only if its box is nearer than the farthest point that is kept.
        gap = np.maximum(np.maximum(low[:2] - self.positions, self.positions - high[:2]), 0.0)
        rows = np.flatnonzero(np.hypot(*gap.T) < self._distances[:, -1])
        if not len(rows):
            return
        reach = float(self._distances[rows, -1].max())
        if 0.0 < reach < _MAX_REACH_SHARE * float((high - low)[:2].max()):
            points = points[_near(points[:, :2] - low[:2], self.positions[rows] - low[:2], reach)]
        if not len(points):
            return
        origin = low[:2]  # small coordinates lose less to rounding
        flat = np.column_stack([points[:, :2] - origin, np.zeros(len(points))])
        queries = np.column_stack([self.positions[rows] - origin, np.zeros(len(rows))])
        k = min(NEIGHBORS, len(points))
        matches = Index(flat).query(queries, k)
        indices = matches.indices.reshape(len(rows), k)
        distances = np.hstack([self._distances[rows], matches.distances.reshape(len(rows), k)])
        kept = np.argsort(distances, axis=1, kind="stable")[:, :NEIGHBORS]
        candidates = np.concatenate([self._points[rows], points[indices]], axis=1)
        self._distances[rows] = np.take_along_axis(distances, kept, axis=1)
        self._points[rows] = np.take_along_axis(candidates, kept[:, :, None], axis=1)

    def around(self, row: int) -> FloatArray:
        """Return the nearest points (K, 3) of a check point, the nearest first."""
        points: FloatArray = self._points[row, np.isfinite(self._distances[row])]
        return points

    @property
    def are_all(self) -> bool:
        """Return whether all points of the cloud are kept for each check point."""
        return self.total <= NEIGHBORS


def _near(places: FloatArray, positions: FloatArray, reach: float) -> NDArray[np.bool_]:
    """Return which places (N, 2) lie in the square cells that contain all places within a reach of positions (M, 2).

    Few points are near check points, and looking up their cells is faster than a search among all of them.

    Args:
        places: x and y of at least 0.
        positions: x and y.
        reach: the length, above 0.
    """
    extent = np.array([places[:, axis].max() for axis in (0, 1)])
    cell = max(reach * (1 + _ROUNDING), float(extent.max()) / _MAX_CELLS)
    shape = (extent / cell).astype(np.int64) + 3  # with a cell beside each border
    is_near = np.zeros(shape, dtype=bool)
    for column, row in np.clip(np.floor(positions / cell) + 1, 0, shape - 1).astype(int).tolist():
        is_near[max(column - 1, 0) : column + 2, max(row - 1, 0) : row + 2] = True
    columns, rows = ((places[:, axis] / cell).astype(np.int32) + 1 for axis in (0, 1))
    near: NDArray[np.bool_] = is_near[columns, rows]
    return near
