"""Fusion of overlapping points: weighted means in the cells of grids, accumulated incrementally."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.normals import unit

_AXIS_BITS = 21  # bits of the index of a cell along each axis
_HALF_RANGE = 1 << (_AXIS_BITS - 1)
_MIN_PENDING_POINTS = 1 << 20  # points to collect before they are added to the sums
_GRID_LEVELS = 5  # grids, each twice as coarse as the one before


class Points(NamedTuple):
    """Points of one image or of all images.

    Attributes:
        points, normals: (N, 3), float64.
        colors: (N, 3) 0 to 255.
        confidence: (N,) 0 to 1.
        views: (N,) numbers of images that agree.
        stereo: (N,) shares of dense stereo, 0 to 1.
    """

    points: FloatArray
    normals: FloatArray
    colors: FloatArray
    confidence: FloatArray
    views: IntArray
    stereo: FloatArray

    def select(self, selection: NDArray[Any]) -> Points:
        """Return the points of a mask (N,) or of indices (M,)."""
        parts: Any = (part[selection] for part in self)
        return Points(*parts)


class _Grid:
    """Float64 sums over the points in each cell of a grid with edge `side`.

    Points in cells 2^20 or more from the origin along an axis are left out.

    Attributes:
        keys: (N,) keys of the cells with points, ascending.
    """

    def __init__(self, side: float) -> None:
        self.side = side
        self.keys: IntArray = np.empty(0, np.int64)
        self._sums: FloatArray = np.empty((0, 12))
        self._views: IntArray = np.empty(0, np.int64)
        self._pending: list[tuple[IntArray, FloatArray, IntArray]] = []

    def cell_keys(self, points: FloatArray) -> tuple[IntArray, NDArray[np.bool_]]:
        """Return the keys (M,) of the cells of the points (N, 3) within range, and the mask (N,) of these points."""
        cell = np.floor(points / self.side)
        near: NDArray[np.bool_] = np.asarray((np.abs(cell) < _HALF_RANGE).all(axis=1))
        i, j, k = (cell[near].astype(np.int64) + _HALF_RANGE).T
        return (i << 2 * _AXIS_BITS) | (j << _AXIS_BITS) | k, near

    def add(self, new_points: Points, weights: FloatArray) -> None:
        """Add points with weights (N,) above zero."""
        keys, near = self.cell_keys(new_points.points)
        values = [
            np.ones(len(weights)),
            new_points.points,
            new_points.normals,
            new_points.colors,
            new_points.confidence,
            new_points.stereo,
        ]
        rows = (weights[:, None] * np.column_stack(values))[near]
        self._pending.append((keys, rows, new_points.views[near]))
        if sum(len(keys) for keys, *_ in self._pending) > max(_MIN_PENDING_POINTS, len(self.keys)):
            self.flush()

    def flush(self) -> None:
        """Add the pending points to the sums."""
        parts = [(self.keys, self._sums, self._views), *self._pending]
        keys, rows, views = (np.concatenate(part) for part in zip(*parts, strict=True))
        self._pending = []
        self.keys, cell = np.unique(keys, return_inverse=True)
        sums = [np.bincount(cell, column, len(self.keys)) for column in rows.T]
        self._sums = np.stack(sums, axis=1)
        self._views = np.zeros(len(self.keys), dtype=np.int64)
        np.maximum.at(self._views, cell, views)

    def means(self, selection: NDArray[np.bool_]) -> Points:
        """Return the weighted means of the cells of a mask (N,), with unit normals and the maximum of views."""
        mean = self._sums[selection, 1:] / self._sums[selection, :1]
        return Points(mean[:, :3], unit(mean[:, 3:6])[0], mean[:, 6:9], mean[:, 9], self._views[selection], mean[:, 10])


class Voxels:
    """Fusion of points of different uncertainty.

    Each point goes into the grid whose cells are as large as its uncertainty; there are five grids, with cells from
    `side` to 16 times that. A coarse cell counts only if no point of a finer cell lies in it.

    So the density of the points follows the quality: high where the surface is known well, low where it is hardly
    known. Memory grows with the surface, not with the number of points.
    """

    def __init__(self, side: float) -> None:
        self._grids = [_Grid(side * 2**level) for level in range(_GRID_LEVELS)]

    def add(self, new_points: Points, weights: FloatArray, uncertainty: FloatArray) -> None:
        """Add points with weights (N,) above zero and uncertainties (N,), which are lengths."""
        ratio = np.maximum(uncertainty / self._grids[0].side, 1)
        level = np.minimum(np.ceil(np.log2(ratio)), _GRID_LEVELS - 1).astype(np.int64)
        for index, grid in enumerate(self._grids):
            if len(rows := np.flatnonzero(level == index)):
                grid.add(new_points.select(rows), weights[rows])

    def fuse(self) -> Points:
        """Return the fused points, the finest first, sorted by cell."""
        fused_parts: list[Points] = []
        for grid in self._grids:
            grid.flush()
            free = np.ones(len(grid.keys), dtype=np.bool_)
            if fused_parts:
                finer = np.concatenate([grid.cell_keys(part.points)[0] for part in fused_parts])
                free = ~np.isin(grid.keys, finer)
            fused_parts.append(grid.means(free))
        return concatenate_points(fused_parts)


def concatenate_points(parts: Sequence[Points]) -> Points:
    """Return the points of all parts, one part after the other."""
    if not parts:
        none = np.empty((0, 3))
        return Points(none, none, none, np.empty(0), np.empty(0, np.int64), np.empty(0))
    return Points(*(np.concatenate(column) for column in zip(*parts, strict=True)))
