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


def robust_extent(points: FloatArray) -> float:
    """Diagonal of the box that holds the inner 98 % of points (N, 3) along each axis: stragglers do not count."""
    some = points[:: max(1, len(points) // 100_000)]
    lower, upper = np.percentile(some, [1, 99], axis=0)
    return float(np.linalg.norm(upper - lower))
