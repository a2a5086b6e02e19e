"""Exact nearest-neighbour search in a cloud of which one tile at a time is in memory.

A tile is searched only for queries whose k nearest points so far are not all nearer than its box. So a result is final
as soon as no unsearched box is nearer: distances are never cut off at the border of a tile, and results do not depend on
the tiles. Equal distances are ordered by the row of the point in its cloud, as in memory.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray, IntArray, bounds
from pcbench.geometry.neighbors import Index
from pcbench.measure.tiled.tiles import Tiles

_BLOCKS_ALONG = 12  # blocks of queries along the longest side of their box
_NO_ROW = np.iinfo(np.int64).max


class TileMatches(NamedTuple):
    """The k nearest points of each query, sorted by (distance, row); one row per query.

    Attributes:
        distances: (M, k) distances; the maximum distance where no point lies within it.
        rows: (M, k) rows of the points in their cloud; the largest integer where there is none.
        tiles: (M, k) tiles of the points; -1 where there is none.
        places: (M, k) positions of the points in their tiles.
    """

    distances: FloatArray
    rows: IntArray
    tiles: NDArray[np.int32]
    places: NDArray[np.int32]

    def column(self, cloud: Tiles, name: str) -> NDArray[Any]:
        """Return a column of the cloud's tiles at the nearest points, (M, k, ...); NaN where there is no point."""
        shape = cloud.open(cloud.occupied[0], name).shape[1:]
        found = np.full((*self.tiles.shape, *shape), np.nan)
        for tile in np.unique(self.tiles):
            if tile >= 0:
                at = self.tiles == tile
                found[at] = cloud.open(int(tile), name)[self.places[at]]
        return found


def nearest_in_tiles(queries: FloatArray, cloud: Tiles, k: int = 1, max_distance: float = np.inf) -> TileMatches:
    """Find the k nearest points of each query (M, 3) in a cloud of at least k points, up to a maximum distance."""
    search = _Search(queries, cloud, k, max_distance)
    first = search.nearest_tiles()
    for tile in np.unique(first):
        search.visit(int(tile), first[search.block] == tile)
    # What remains: queries whose results may change by a tile that was not their first one.
    order = np.argsort(search.squared_gaps.min(axis=0), kind="stable")
    for tile in order:
        search.visit(int(tile), first[search.block] != tile)
    return search.found()


class _Search:
    """State of a search: the k nearest points of each query so far, with the queries grouped in compact blocks."""

    def __init__(self, queries: FloatArray, cloud: Tiles, k: int, max_distance: float) -> None:
        low, high = bounds(queries)
        cell = float((high - low).max()) / _BLOCKS_ALONG or 1.0
        place = np.minimum((queries - low) / cell, _BLOCKS_ALONG - 1).astype(np.int16)
        number = (place[:, 0] * _BLOCKS_ALONG + place[:, 1]) * _BLOCKS_ALONG + place[:, 2]
        self.order = np.argsort(number, kind="stable")
        self.starts = np.flatnonzero(np.diff(number[self.order], prepend=-1))
        self.queries = queries[self.order]
        self.block = np.repeat(np.arange(len(self.starts)), np.diff([*self.starts, len(queries)]))
        self.cloud, self.k = cloud, k
        shape = (len(queries), k)
        self.best = TileMatches(
            np.full(shape, max_distance),
            np.full(shape, _NO_ROW),
            np.full(shape, -1, np.int32),
            np.zeros(shape, np.int32),
        )
        self.tiles = np.array(cloud.occupied)
        block_low = np.minimum.reduceat(self.queries, self.starts)
        block_high = np.maximum.reduceat(self.queries, self.starts)
        # (blocks, occupied tiles) squared distances between boxes; infinite for empty tiles.
        self.squared_gaps = np.full((len(self.starts), len(cloud)), np.inf)
        for tile in self.tiles:
            gap = np.maximum(0, np.maximum(cloud.low[tile] - block_high, block_low - cloud.high[tile]))
            self.squared_gaps[:, tile] = np.square(gap[:, 0]) + np.square(gap[:, 1]) + np.square(gap[:, 2])
        self.block_center = 0.5 * (block_low + block_high)

    def nearest_tiles(self) -> IntArray:
        """Return the tile (B,) to search first for each block: of the nearest boxes, the one nearest to its centre."""
        first = np.zeros(len(self.starts), np.int64)
        for block, center in enumerate(self.block_center):
            near = np.flatnonzero(self.squared_gaps[block] == self.squared_gaps[block].min())
            to_center = _squared_gaps(center, self.cloud.low[near], self.cloud.high[near])
            first[block] = near[np.argmin(to_center)]
        return first

    def visit(self, tile: int, candidates: NDArray[np.bool_]) -> None:
        """Search a tile for those queries, among the candidates (M,), whose results it may change."""
        worst = self.best.distances[:, -1]
        reach = np.maximum.reduceat(np.where(candidates, worst, -1.0), self.starts)
        blocks = (reach >= 0) & (self.squared_gaps[:, tile] <= np.square(reach) * (1 + 1e-12))
        if not blocks.any():
            return
        which = np.flatnonzero(candidates & blocks[self.block])
        gaps = np.sqrt(_squared_gaps(self.queries[which], self.cloud.low[tile], self.cloud.high[tile]))
        which = which[gaps <= worst[which]]
        if len(which):
            self._search(tile, which)

    def _search(self, tile: int, which: IntArray) -> None:
        queries, worst = self.queries[which], self.best.distances[which, -1]
        points, rows = self.cloud.load(tile, "points"), self.cloud.open(tile, "rows")
        places = _near_points(points, queries, worst)
        if places is not None:
            points, rows = points[places], rows[places]
        if not len(points):
            return
        k = min(self.k, len(points))
        distances, indices = (values.reshape(len(which), k) for values in Index(points).query(queries, k))
        found = TileMatches(
            distances,
            np.asarray(rows)[indices],
            np.full(indices.shape, tile, np.int32),
            (indices if places is None else places[indices]).astype(np.int32),
        )
        before = TileMatches(*(values[which] for values in self.best))
        better = found
        if k < self.k or (before.tiles >= 0).any() or np.isfinite(worst).any():
            before_squared = _squared_lengths(before.column(self.cloud, "points") - queries[:, None])
            found_squared = _squared_lengths(points[indices] - queries[:, None])
            # Squares decide, as in memory: square roots of different squares may be equal.
            limit = np.where(before.rows == _NO_ROW, np.square(before.distances), before_squared)
            better = _merge(before, limit, found, found_squared, self.k)
        for values, new in zip(self.best, better, strict=True):
            values[which] = new

    def found(self) -> TileMatches:
        """Return the results in the order of the queries."""
        back = np.empty(len(self.order), np.int64)
        back[self.order] = np.arange(len(self.order))
        return TileMatches(*(values[back] for values in self.best))


def _squared_gaps(points: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray:
    """Squared distances of points (..., 3) to boxes.

    The sums are rounded like squared distances between points, so they never exceed that of a point in the box.
    """
    gap = np.maximum(0, np.maximum(low - points, points - high))
    squared: FloatArray = np.square(gap[..., 0]) + np.square(gap[..., 1]) + np.square(gap[..., 2])
    return squared


def _near_points(points: FloatArray, queries: FloatArray, reach: FloatArray) -> IntArray | None:
    """Return the positions of the points that may lie within `reach` (M,) of a query (M, 3); None: all of them."""
    if not np.isfinite(reach).all():
        return None
    margin = 1e-12 * (np.abs(queries).max() + reach.max())  # for the rounding of sums
    low = (queries - reach[:, None]).min(axis=0) - margin
    high = (queries + reach[:, None]).max(axis=0) + margin
    keep = np.ones(len(points), bool)
    for axis in range(3):
        keep &= (points[:, axis] >= low[axis]) & (points[:, axis] <= high[axis])
    return np.flatnonzero(keep)


def _squared_lengths(offsets: FloatArray) -> FloatArray:
    """Squared lengths of vectors (..., 3), summed as in the compiled search."""
    squared: FloatArray = np.square(offsets[..., 0]) + np.square(offsets[..., 1]) + np.square(offsets[..., 2])
    return squared


def _merge(
    one: TileMatches, one_squared: FloatArray, other: TileMatches, other_squared: FloatArray, k: int
) -> TileMatches:
    """Return the k nearest of both by (squared distance, row)."""
    both = TileMatches(*(np.concatenate(columns, axis=1) for columns in zip(one, other, strict=True)))
    squared = np.concatenate([one_squared, other_squared], axis=1)
    order = np.lexsort((both.rows, squared))[:, :k]
    return TileMatches(*(np.take_along_axis(values, order, axis=1) for values in both))
