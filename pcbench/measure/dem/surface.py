"""The heights of one epoch in the cells of a grid, and the variance of each from the points in the cell."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray
from pcbench.measure.dem.grid import CellMoments, HeightGrid

_SLOPE_EDGES_DEG = np.array([0.0, 2, 5, 10, 15, 20, 30, 40, 50, 60, 75, 90.001])
_PRIOR_POINTS = 4.0
"""Weight of the mean variance at the same slope against the variance of the points in a cell, in points."""
_MAX_TRIANGLE_CELLS = 3.0
"""Longest edge of a triangle that heights are interpolated in, in cells."""


class GridMethod(StrEnum):
    """How the points of a cell become its height.

    The lowest of more points is lower, so that it has an offset between epochs of different density; see
    `lowest_offset`.
    """

    MEAN = "mean"
    MEDIAN = "median"
    LOWEST = "lowest"
    TIN = "tin"

    @property
    def needs_all_points(self) -> bool:
        """Return whether all points of a cloud have to be in memory."""
        return self in (GridMethod.MEDIAN, GridMethod.TIN)


@dataclass(frozen=True, eq=False)
class EpochSurface:
    """The heights of one epoch.

    Attributes:
        heights: (H, W) heights; NaN in cells without points.
        variances: (H, W) variances of the heights from the scatter of the points in the cells; NaN with the heights.
        counts: (H, W) numbers of points.
    """

    heights: FloatArray
    variances: FloatArray
    counts: NDArray[np.int32]


def surface_of(moments: CellMoments, method: GridMethod, points: FloatArray | None = None) -> EpochSurface:
    """Return the heights of an epoch.

    Args:
        moments: moments of the points in the cells.
        method: how points become a height.
        points: all points (N, 3); only needed by the methods that need them.
    """
    grid = moments.grid
    counts = moments.counts.reshape(grid.shape)
    with np.errstate(divide="ignore", invalid="ignore"):
        means = moments.sums / moments.counts
        scatter = np.maximum(moments.squares - moments.sums * means, 0.0)  # sum of squared deviations from the mean
    means, scatter = (np.where(moments.counts > 0, values, np.nan).reshape(grid.shape) for values in (means, scatter))
    variances = _point_variances(means, scatter, counts, grid.cell)
    if method is GridMethod.MEAN:
        heights, variances = means + moments.base, variances / counts
    elif method is GridMethod.LOWEST:
        heights = np.where(counts > 0, moments.lowest.reshape(grid.shape) + moments.base, np.nan)
    else:
        assert points is not None
        if method is GridMethod.MEDIAN:
            heights, variances = _medians(grid, points), np.pi / 2 * variances / counts
        else:
            heights = _interpolated(grid, points)
            # The mean of the squared weights of three corners at a random place in their triangle is 1/2.
            variances = 0.5 * np.where(np.isfinite(variances), variances, np.nanmedian(variances))
    missing = ~np.isfinite(heights)
    return EpochSurface(heights, np.where(missing, np.nan, variances), counts)


def lowest_offset(before: EpochSurface, after: EpochSurface) -> float:
    """Return the mean difference of the lowest points of two epochs that their numbers of points alone make.

    The lowest of n points whose heights scatter normally with a standard deviation s lies s z((n - 0.375) / (n + 0.25))
    below their mean, where z is the normal quantile (Blom 1958).
    """
    from scipy.special import ndtri

    both = (before.counts > 0) & (after.counts > 0)
    depths = [
        np.sqrt(epoch.variances[both]) * ndtri((epoch.counts[both] - 0.375) / (epoch.counts[both] + 0.25))
        for epoch in (before, after)
    ]
    return float(np.mean(depths[0] - depths[1])) if both.any() else 0.0


def slopes_deg(heights: FloatArray, cell: float) -> FloatArray:
    """Return the slope (H, W) of heights in degrees, from differences to the neighbours that exist; 0 without any."""
    squares = np.zeros(heights.shape)
    for axis in (0, 1):
        steps = np.diff(heights, axis=axis) / cell
        pad = [(0, 0), (0, 0)]
        pad[axis] = (1, 1)
        padded = np.pad(steps, pad, constant_values=np.nan)
        size = heights.shape[axis]
        sides = np.stack([padded.take(range(size), axis), padded.take(range(1, size + 1), axis)])
        known_sides = np.isfinite(sides)
        count = np.maximum(known_sides.sum(axis=0), 1)
        squares += (np.where(known_sides, sides, 0.0).sum(axis=0) / count) ** 2
    result: FloatArray = np.degrees(np.arctan(np.sqrt(squares)))
    return result


def _point_variances(means: FloatArray, scatter: FloatArray, counts: NDArray[np.int32], cell: float) -> FloatArray:
    """Return the variance of a point about the mean of its cell: that in the cell, weighed with that at its slope.

    Steep cells scatter more, because their points lie at different heights; few points tell little about their own
    scatter.
    """
    numbers = np.digitize(slopes_deg(means, cell), _SLOPE_EDGES_DEG) - 1
    repeated = counts > 1
    bins = len(_SLOPE_EDGES_DEG)
    freedom = np.bincount(numbers[repeated], counts[repeated] - 1.0, bins)
    sums = np.bincount(numbers[repeated], scatter[repeated], bins)
    overall = sums.sum() / max(freedom.sum(), 1.0)
    pooled = (sums + 10 * overall) / (freedom + 10)
    result: FloatArray = (np.nan_to_num(scatter) + _PRIOR_POINTS * pooled[numbers]) / (
        np.maximum(counts - 1, 0) + _PRIOR_POINTS
    )
    return np.where(counts > 0, result, np.nan)


def _medians(grid: HeightGrid, points: FloatArray) -> FloatArray:
    numbers = grid.numbers(points)
    order = np.lexsort((points[:, 2], numbers))
    order = order[numbers[order] >= 0]
    numbers, heights = numbers[order], points[order, 2]
    starts = np.flatnonzero(np.concatenate([[True], numbers[1:] != numbers[:-1]]))
    counts = np.diff(np.append(starts, len(numbers)))
    medians = np.full(grid.size, np.nan)
    medians[numbers[starts]] = (heights[starts + (counts - 1) // 2] + heights[starts + counts // 2]) / 2
    return medians.reshape(grid.shape)


def _interpolated(grid: HeightGrid, points: FloatArray) -> FloatArray:
    """Return the heights of the triangulated points at the centres of the cells; NaN in triangles with long edges."""
    from scipy.spatial import Delaunay

    origin = np.array([grid.west, grid.north])
    plane, first = np.unique(points[:, :2] - origin, axis=0, return_index=True)
    triangles = Delaunay(plane)
    centres = grid.centres() - origin
    numbers = triangles.find_simplex(centres)
    corners = triangles.simplices[numbers]
    transform = triangles.transform[numbers]
    two = np.einsum("nij,nj->ni", transform[:, :2], centres - transform[:, 2])
    weights = np.column_stack([two, 1 - two.sum(axis=1)])
    heights = (weights * points[first, 2][corners]).sum(axis=1)
    edges = np.stack([plane[corners[:, a]] - plane[corners[:, b]] for a, b in ((0, 1), (1, 2), (2, 0))])
    long = np.hypot(edges[..., 0], edges[..., 1]).max(axis=0) > _MAX_TRIANGLE_CELLS * grid.cell
    return np.where((numbers < 0) | long, np.nan, heights).reshape(grid.shape)
