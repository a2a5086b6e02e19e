"""Many points that overlap become few: weighted means in the cells of grids, added up as they come."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.normals import unit

_AXIS_BITS = 21  # of the number of a cell along each axis
_HALF = 1 << (_AXIS_BITS - 1)
_PENDING = 1 << 20  # points that wait to be added at least
_LEVELS = 5  # grids, each twice as coarse as the one before


class Points(NamedTuple):
    """Points of one image, or of all.

    Attributes:
        points, normals: (N, 3), float64.
        colors: (N, 3) 0 to 255.
        confidence: (N,) 0 to 1.
        views: (N,) images that agree.
    """

    points: FloatArray
    normals: FloatArray
    colors: FloatArray
    confidence: FloatArray
    views: IntArray

    def select(self, which: NDArray[Any]) -> Points:
        """Those of a mask (N,) or of indices (M,)."""
        parts: Any = (part[which] for part in self)
        return Points(*parts)


class _Grid:
    """Sums in float64 over the points in each cell of edge `side`, counted from the origin.

    What lies 2^20 cells or more from the origin along an axis is left out.

    Attributes:
        keys: (N,) numbers of the cells with points, rising.
    """

    def __init__(self, side: float) -> None:
        self.side = side
        self.keys: IntArray = np.empty(0, np.int64)
        self._sums: FloatArray = np.empty((0, 11))
        self._views: IntArray = np.empty(0, np.int64)
        self._pending: list[tuple[IntArray, FloatArray, IntArray]] = []

    def numbers(self, points: FloatArray) -> tuple[IntArray, NDArray[np.bool_]]:
        """The numbers (M,) of the cells of those points (N, 3) that are near enough, and which (N,) are."""
        cell = np.floor(points / self.side)
        near: NDArray[np.bool_] = np.asarray((np.abs(cell) < _HALF).all(axis=1))
        i, j, k = (cell[near].astype(np.int64) + _HALF).T
        return (i << 2 * _AXIS_BITS) | (j << _AXIS_BITS) | k, near

    def add(self, given: Points, weights: FloatArray) -> None:
        """Add points with weights (N,) above zero."""
        keys, near = self.numbers(given.points)
        values = [np.ones(len(weights)), given.points, given.normals, given.colors, given.confidence]
        rows = (weights[:, None] * np.column_stack(values))[near]
        self._pending.append((keys, rows, given.views[near]))
        if sum(len(keys) for keys, *_ in self._pending) > max(_PENDING, len(self.keys)):
            self.settle()

    def settle(self) -> None:
        """Add what waits to the sums."""
        parts = [(self.keys, self._sums, self._views), *self._pending]
        keys, rows, views = (np.concatenate(part) for part in zip(*parts, strict=True))
        self._pending = []
        self.keys, cell = np.unique(keys, return_inverse=True)
        sums = [np.bincount(cell, column, len(self.keys)) for column in rows.T]
        self._sums = np.stack(sums, axis=1)
        self._views = np.zeros(len(self.keys), dtype=np.int64)
        np.maximum.at(self._views, cell, views)

    def means(self, which: NDArray[np.bool_]) -> Points:
        """The weighted means of some cells (N,); of views the most; normals are of unit length."""
        mean = self._sums[which, 1:] / self._sums[which, :1]
        return Points(mean[:, :3], unit(mean[:, 3:6])[0], mean[:, 6:9], mean[:, 9], self._views[which])


class Voxels:
    """A fusion of points that are not all equally sure: each goes into the grid whose cells are as large as its
    uncertainty, from `side` over twice that to 16 times. A coarse cell counts only where there is no point of a finer
    one in it.

    So there are as many points as there is to say: many where the surface is known well, few where it is hardly known,
    and these are not left out. Memory grows with the surface, and not with the number of points that show it.
    """

    def __init__(self, side: float) -> None:
        self._grids = [_Grid(side * 2**level) for level in range(_LEVELS)]

    def add(self, given: Points, weights: FloatArray, uncertainty: FloatArray) -> None:
        """Add points with weights (N,) above zero and uncertainties (N,), lengths."""
        ratio = np.maximum(uncertainty / self._grids[0].side, 1)
        level = np.minimum(np.ceil(np.log2(ratio)), _LEVELS - 1).astype(np.int64)
        for number, grid in enumerate(self._grids):
            if len(here := np.flatnonzero(level == number)):
                grid.add(given.select(here), weights[here])

    def fused(self) -> Points:
        """The points, the finest first, in the order of the cells."""
        kept: list[Points] = []
        for grid in self._grids:
            grid.settle()
            free = np.ones(len(grid.keys), dtype=np.bool_)
            if kept:
                finer = np.concatenate([grid.numbers(part.points)[0] for part in kept])
                free = ~np.isin(grid.keys, finer)
            kept.append(grid.means(free))
        return joined(kept)


def joined(parts: Sequence[Points]) -> Points:
    """Points one after the other."""
    if not parts:
        none = np.empty((0, 3))
        return Points(none, none, none, np.empty(0), np.empty(0, np.int64))
    return Points(*(np.concatenate(column) for column in zip(*parts, strict=True)))
