"""Voxel grids for downsampling, weighting and averaging."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pcbench.errors import InputError
from pcbench.geometry.arrays import FloatArray, IntArray, bounds
from pcbench.geometry.order_statistics import percentiles_of_columns
from pcbench.native import _core

_BLOCK_ROWS = 65_536  # rows that are read at a time


class Cells(NamedTuple):
    """The occupied cells of a grid, numbered by the order of their first points."""

    of_point: IntArray  # (N,) cell of each point
    first: IntArray  # (M,) index of the first point in each cell, ascending
    counts: IntArray  # (M,) number of points in each cell

    def means(self, values: FloatArray) -> FloatArray:
        """Return the mean in each cell (M,) of values (N,), one per point."""
        means: FloatArray = np.bincount(self.of_point, values, len(self.first)) / self.counts
        return means


def cells(points: FloatArray, side: float, lower: FloatArray | None = None) -> Cells:
    """Group points (N, 3) into cubic cells of edge length `side`, counted from `lower` (default: their lowest corner).

    Points more than 2^31 cells from the corner share the outermost cells.
    """
    if not side > 0:
        raise InputError(f"expected a positive cell side, got {side}")
    points = np.ascontiguousarray(points, np.float64)
    corner = bounds(points)[0] if lower is None else np.ascontiguousarray(lower, np.float64)
    of_point = np.empty(len(points), np.int64)
    return Cells(of_point, *_core.group_by_cell(points, side, corner, of_point))


def voxel_downsample(
    points: FloatArray, side: float, rows: IntArray | None = None, lower: FloatArray | None = None
) -> IntArray:
    """Return the indices of the first point in each occupied cell of edge length `side`, in ascending order.

    Args:
        points: (N, 3) points.
        side: edge length of the cells.
        rows: (M,) ascending indices of the points that are grouped; None: all.
        lower: (3,) corner from which cells count; None: the lowest one of the grouped points.
    """
    if not side > 0:
        raise InputError(f"expected a positive cell side, got {side}")
    points = np.ascontiguousarray(points, np.float64)
    if rows is not None:
        rows = np.ascontiguousarray(rows, np.int64)
        if not len(rows):
            return rows
    corner = _lowest_corner(points, rows) if lower is None else np.ascontiguousarray(lower, np.float64)
    return _core.first_in_cells(points, rows, side, corner)


def voxel_downsample_to(points: FloatArray, count: int, start: float, rows: IntArray | None = None) -> IntArray:
    """Downsample to at most 1.2 * `count` points: cells grow from edge length `start` until few enough are occupied.

    Args:
        points: (N, 3) points.
        count: the number of points.
        start: edge length of the smallest cells.
        rows: (M,) ascending indices of the points that are downsampled; None: all.

    Returns:
        Ascending indices of points.
    """
    side = max(start, 1e-12 * robust_extent(points, rows), np.finfo(float).tiny)
    which = voxel_downsample(points, side, rows)
    return which[voxel_thin_to(points[which], count, side)]


def voxel_thin_to(points: FloatArray, count: int, side: float) -> IntArray:
    """Continue `voxel_downsample_to` from the first points (N, 3) of cells of edge length `side`."""
    which = np.arange(len(points))
    while len(which) > 1.2 * count:
        side *= max(1.1, np.sqrt(len(which) / count))  # on surfaces the count is inversely proportional to side^2
        which = which[voxel_downsample(points[which], side)]
    return which


def _lowest_corner(points: FloatArray, rows: IntArray | None) -> FloatArray:
    """Return the lowest corner (3,) of points (N, 3), or of those at some rows, which are read in blocks."""
    if rows is None:
        return bounds(points)[0]
    starts = range(0, len(rows), _BLOCK_ROWS)
    corner: FloatArray = np.min([bounds(points[rows[start : start + _BLOCK_ROWS]])[0] for start in starts], axis=0)
    return corner


def cell_means(points: FloatArray, side: float, lower: FloatArray | None = None) -> FloatArray:
    """Return the mean point (M, 3) of each occupied cell of edge length `side`, counted from `lower` (see `cells`)."""
    grid = cells(points, side, lower)
    return np.stack([grid.means(points[:, axis]) for axis in range(3)], axis=1)


def open3d_voxel_means(points: FloatArray, side: float) -> FloatArray:
    """Return the mean point (M, 3) of each voxel as Open3D's `voxel_down_sample` does.

    Its grid begins half a voxel below the lowest corner of the points (N, 3), N >= 1.
    """
    return cell_means(points, side, bounds(points)[0] - side / 2)


def robust_bounds(points: FloatArray, rows: IntArray | None = None) -> tuple[FloatArray, FloatArray]:
    """Return the corners (3,) of the box around the inner 98 % of points along each axis: robust to outliers.

    Args:
        points: (N, 3) points.
        rows: (M,) indices of the points that count; None: all.
    """
    step = max(1, len(points if rows is None else rows) // 100_000)
    sample = points[::step] if rows is None else points[rows[::step]]
    lower, upper = percentiles_of_columns(sample, [1, 99])
    return lower, upper


def robust_extent(points: FloatArray, rows: IntArray | None = None) -> float:
    """Return the diagonal of the robust bounds of points (N, 3), or of those at some rows (M,)."""
    lower, upper = robust_bounds(points, rows)
    return float(np.linalg.norm(upper - lower))
