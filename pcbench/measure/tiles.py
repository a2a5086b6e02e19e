"""Deviations by tile: statistics of the distances within the squares of a grid over the scene."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.order_statistics import median, percentiles
from pcbench.measure.metrics import nmad

MIN_TILE_POINTS = 30
"""Points that a tile needs for its statistics."""


class TileGrid(NamedTuple):
    """Square tiles along two axes of a scene.

    Attributes:
        axes: the two axes; 0, 1 and 2 are x, y and z.
        size: edge of a tile, in the clouds' unit.
        low: lower corner of the grid along the axes, at multiples of the size.
        shape: number of tiles along the axes.
    """

    axes: tuple[int, int]
    size: float
    low: tuple[float, float]
    shape: tuple[int, int]

    @classmethod
    def covering(cls, low: FloatArray, high: FloatArray, size: float) -> TileGrid:
        """Return the grid over a box with corners `low` (3,) and `high` (3,), along its two longest axes."""
        first, second = sorted(np.argsort(low - high, kind="stable")[:2].tolist())
        axes = (first, second)
        starts = [math.floor(low[axis] / size) for axis in axes]
        counts = [max(1, math.ceil(high[axis] / size) - start) for axis, start in zip(axes, starts, strict=True)]
        return cls(axes, size, (size * starts[0], size * starts[1]), (counts[0], counts[1]))

    def tiles_of(self, points: FloatArray) -> IntArray:
        """Return the number of the tile of each point (N, 3), row by row along the first axis; -1 outside the grid."""
        place = [np.floor((points[:, axis] - low) / self.size) for axis, low in zip(self.axes, self.low, strict=True)]
        inside = (place[0] >= 0) & (place[0] < self.shape[0]) & (place[1] >= 0) & (place[1] < self.shape[1])
        tiles: IntArray = np.where(inside, place[0] + self.shape[0] * place[1], -1).astype(np.int64)
        return tiles

    def lower_corner(self, tile: int) -> tuple[float, float]:
        """Return the lower corner of a tile along the axes."""
        second, first = divmod(tile, self.shape[0])
        return self.low[0] + self.size * first, self.low[1] + self.size * second


@dataclass(frozen=True)
class TileDeviations:
    """Deviations of the points within a tile, in the clouds' unit.

    Attributes:
        tile: number of the tile in its grid.
        at: centre of the tile; along the third axis the median of its points.
        count: number of points.
        median: median of the values, signed if they are.
        nmad: normalised median absolute deviation of the values, see `pcbench.metrics.nmad`.
        p95: 95th percentile of the absolute values.
    """

    tile: int
    at: tuple[float, float, float]
    count: int
    median: float
    nmad: float
    p95: float


def deviations_by_tile(grid: TileGrid, points: FloatArray, values: FloatArray) -> list[TileDeviations]:
    """Return the statistics of each tile with at least `MIN_TILE_POINTS` points, largest 95th percentile first.

    Args:
        grid: the tiles.
        points: (N, 3) points.
        values: (N,) their deviations; points whose value is NaN do not count.
    """
    tiles = np.where(np.isfinite(values), grid.tiles_of(points), -1)
    order = np.argsort(tiles, kind="stable")
    numbers, starts, counts = np.unique(tiles[order], return_index=True, return_counts=True)
    by_tile = [
        _deviations(grid, int(number), points[rows], values[rows])
        for number, start, count in zip(numbers, starts, counts, strict=True)
        if number >= 0 and count >= MIN_TILE_POINTS
        for rows in [order[start : start + count]]
    ]
    return sorted(by_tile, key=lambda deviations: -deviations.p95)


def _deviations(grid: TileGrid, tile: int, points: FloatArray, values: FloatArray) -> TileDeviations:
    third = 3 - sum(grid.axes)
    corner = grid.lower_corner(tile)
    position = [0.0, 0.0, 0.0]
    for axis, low in zip(grid.axes, corner, strict=True):
        position[axis] = low + 0.5 * grid.size
    position[third] = median(np.ascontiguousarray(points[:, third]))
    p95 = float(percentiles(np.abs(values), [95])[0])
    return TileDeviations(tile, (position[0], position[1], position[2]), len(values), median(values), nmad(values), p95)
