"""Exact nearest-neighbour search; the only room that knows which engine does it."""

from __future__ import annotations

import os
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.errors import InputError

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


class Matches(NamedTuple):
    """Distances in the clouds' unit and indices of the matched points; (N,) for one neighbour, (N, k) for k."""

    distances: FloatArray
    indices: IntArray


class Index:
    """Nearest-neighbour queries against a fixed set of points (N, 3)."""

    def __init__(self, points: FloatArray) -> None:
        from scipy.spatial import cKDTree

        if points.ndim != 2 or points.shape[1] != 3 or not len(points):
            raise InputError(f"expected points of shape (N, 3) with N >= 1, got {points.shape}")
        self.points = points
        # Sliding midpoints without shrunken boxes build three times faster and answer as fast on surfaces.
        self._tree = cKDTree(points, leafsize=16, balanced_tree=False, compact_nodes=False)

    def __len__(self) -> int:
        return len(self.points)

    def query(self, queries: FloatArray, k: int = 1) -> Matches:
        """The k nearest points of each query (M, 3), nearest first.

        Raises:
            InputError: there are fewer than k points.
        """
        if k > len(self):
            raise InputError(f"expected at least {k} points to find {k} neighbours, got {len(self)}")
        distances, indices = self._tree.query(queries, k=k, workers=_threads())
        return Matches(np.asarray(distances), np.asarray(indices, dtype=np.int64))

    def nearest_other(self, which: IntArray | None = None) -> Matches:
        """For each point (or those of `which`) its nearest other point, at distance 0 where it has a duplicate.

        Raises:
            InputError: there is one point only.
        """
        own = np.arange(len(self)) if which is None else which
        matches = self.query(self.points[own], k=2)
        # Among duplicates the point itself need not come first.
        other = (matches.indices[:, 0] == own).astype(np.int64)
        rows = np.arange(len(own))
        return Matches(matches.distances[rows, other], matches.indices[rows, other])


def _threads() -> int:
    # One knob for the whole package: OpenMP's, which batch systems and tests already set.
    limit = os.environ.get("OMP_NUM_THREADS", "")
    available = len(os.sched_getaffinity(0))
    return min(int(limit), available) if limit.isdigit() and int(limit) > 0 else available
