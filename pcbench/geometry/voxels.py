"""Regular grids over points: voxels to downsample by, to weight by, and to average over."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pcbench.errors import InputError
from pcbench.geometry.arrays import FloatArray, IntArray, bounds
from pcbench.native import _core


class Cells(NamedTuple):
    """The occupied cells of a grid, numbered in the order in which points first fall into them."""

    of_point: IntArray  # (N,) the cell of each point
    first: IntArray  # (M,) the first point in each cell, ascending
    counts: IntArray  # (M,) of points in each cell

    def means(self, values: FloatArray) -> FloatArray:
        """The mean in each cell (M,) of one value a point (N,)."""
        means: FloatArray = np.bincount(self.of_point, values, len(self.first)) / self.counts
        return means


def cells(points: FloatArray, side: float, lower: FloatArray | None = None) -> Cells:
    """The cubic cells of edge `side` that points (N, 3) lie in, counted from `lower` (default: their lowest corner).

    Cells far outside (beyond 2^31 cells from the corner) share the outermost one.
    """
    if not side > 0:
        raise InputError(f"expected a positive cell side, got {side}")
    points = np.ascontiguousarray(points, np.float64)
    corner = bounds(points)[0] if lower is None else np.ascontiguousarray(lower, np.float64)
    of_point = np.empty(len(points), np.int64)
    return Cells(of_point, *_core.group_by_cell(points, side, corner, of_point))


def voxel_downsample(points: FloatArray, side: float) -> IntArray:
    """Voxel downsampling: indices of the first point in each occupied cell of edge `side`, in ascending order."""
    return cells(points, side).first


def voxel_downsample_to(points: FloatArray, count: int, start: float) -> IntArray:
    """Voxel downsampling to at most about `count` points: the first one in each cell; cells grow until that fits."""
    side = max(start, 1e-12 * robust_extent(points), np.finfo(float).tiny)
    which = voxel_downsample(points, side)
    while len(which) > 1.2 * count:
        side *= max(1.1, np.sqrt(len(which) / count))  # surfaces: the count falls with the square of the side
        which = which[voxel_downsample(points[which], side)]
    return which


def cell_means(points: FloatArray, side: float, lower: FloatArray | None = None) -> FloatArray:
    """Mean point (M, 3) of each occupied cell of edge `side`, counted from `lower` (default: the lowest corner)."""
    grid = cells(points, side, lower)
    return np.stack([grid.means(points[:, axis]) for axis in range(3)], axis=1)


def robust_bounds(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Corners (3,) of the box that holds the inner 98 % of points (N, 3) along each axis: stragglers do not count."""
    some = np.ascontiguousarray(points[:: max(1, len(points) // 100_000)].T)
    lower, upper = np.percentile(some, [1, 99], axis=1)
    return lower, upper


def robust_extent(points: FloatArray) -> float:
    """Diagonal of the robust bounds of points (N, 3)."""
    lower, upper = robust_bounds(points)
    return float(np.linalg.norm(upper - lower))
