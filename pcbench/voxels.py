"""Regular grids over points: cells to thin by, to weight by, and to resample by."""

from __future__ import annotations

import numpy as np

from pcbench.errors import InputError
from pcbench.neighbors import FloatArray, IntArray

_BITS = 21  # a coordinate's share of a 63-bit key


def cell_keys(points: FloatArray, side: float, lower: FloatArray) -> IntArray:
    """Identifiers (N,) of the cubic cells of edge `side` that points (N, 3) lie in, counted from corner `lower`.

    Cells far outside (beyond 2^20 cells from the corner) share the outermost one.
    """
    if not side > 0:
        raise InputError(f"expected a positive cell side, got {side}")
    half = 1 << (_BITS - 1)
    key = np.zeros(len(points), dtype=np.int64)
    for axis in range(3):  # one axis at a time: no (N, 3) temporaries
        cell = np.floor((points[:, axis] - lower[axis]) / side)
        key <<= _BITS
        key |= np.clip(cell, -half, half - 1).astype(np.int64) + half
    return key


def thin(points: FloatArray, side: float) -> IntArray:
    """Indices of the first point in each occupied cell of edge `side`, in ascending order."""
    _, first = np.unique(cell_keys(points, side, points.min(axis=0)), return_index=True)
    return np.sort(first)


def thin_to(points: FloatArray, count: int, start: float) -> IntArray:
    """Indices of an even sample of at most about `count` points: the first in each cell; cells grow until it fits."""
    side = max(start, 1e-12 * robust_extent(points), np.finfo(float).tiny)
    which = thin(points, side)
    while len(which) > 1.2 * count:
        side *= max(1.1, np.sqrt(len(which) / count))  # surfaces: the count falls with the square of the side
        which = which[thin(points[which], side)]
    return which


def cell_means(points: FloatArray, side: float, lower: FloatArray | None = None) -> FloatArray:
    """Mean point (M, 3) of each occupied cell of edge `side`, counted from `lower` (default: the lowest corner)."""
    keys = cell_keys(points, side, points.min(axis=0) if lower is None else lower)
    _, cell, counts = np.unique(keys, return_inverse=True, return_counts=True)
    return np.stack([np.bincount(cell, points[:, axis]) / counts for axis in range(3)], axis=1)


def robust_extent(points: FloatArray) -> float:
    """Diagonal of the box that holds the inner 98 % of points (N, 3) along each axis: stragglers do not count."""
    some = points[:: max(1, len(points) // 100_000)]
    lower, upper = np.percentile(some, [1, 99], axis=0)
    return float(np.linalg.norm(upper - lower))
