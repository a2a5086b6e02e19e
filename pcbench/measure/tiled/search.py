"""Exact nearest-neighbour search in a cloud whose tiles have their search trees on disk.

A tile is searched only for queries whose k nearest points so far are not all nearer than its box. So a result is final
as soon as no unsearched box is nearer: distances are never cut off at the border of a tile, and results do not depend
on the tiles. Equal distances are ordered by the row of the point in its cloud, as in memory.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray, IntArray, bounds
from pcbench.measure.tiled.tiles import TiledCloud

_BLOCKS_ALONG = 12  # blocks of queries along the longest side of their box
_TILES_AT_ONCE = 1_024  # whose distances to all blocks are compared
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

    def column(self, cloud: TiledCloud, name: str) -> NDArray[Any]:
        """Return a column of the cloud's tiles at the nearest points, (M, k, ...); NaN where there is no point."""
        shape = cloud.open(cloud.occupied[0], name).shape[1:]
        column = np.full((*self.tiles.shape, *shape), np.nan)
        flat, tiles, places = column.reshape(-1, *shape), self.tiles.ravel(), self.places.ravel()
        for tile in np.unique(tiles):
            if tile >= 0:
                rows = np.flatnonzero(tiles == tile)
                flat[rows] = cloud.open(int(tile), name).take(places[rows], axis=0)
        return column


def nearest_in_tiles(queries: FloatArray, cloud: TiledCloud, k: int = 1, max_distance: float = np.inf) -> TileMatches:
    """Find the k nearest points of each query (M, 3) in a cloud of at least k points, up to a maximum distance."""
    if not len(queries):
        empty = np.zeros((0, k))
        return TileMatches(empty, empty.astype(np.int64), empty.astype(np.int32), empty.astype(np.int32))
    search = _Search(queries, cloud, k, max_distance)
    first = search.first_tiles()
    for tile in np.unique(first):
        search.visit(int(tile), np.flatnonzero(first == tile))
    # What remains: queries whose results may change by a tile that was not their first one.
    for tile in search.tiles_by_distance():
        search.visit(tile, np.flatnonzero(first != tile))
    return search.found()


class _NearTiles(NamedTuple):
    """Pairs of a block of queries and a tile that may contain results, P of them, sorted by tile and block."""

    blocks: IntArray
    tiles: IntArray
    squared_gaps: FloatArray  # between the boxes of both


class _Search:
    """State of a search: the k nearest points of each query so far, with the queries grouped in compact blocks."""

    def __init__(self, queries: FloatArray, cloud: TiledCloud, k: int, max_distance: float) -> None:
        low, high = bounds(queries)
        cell = float((high - low).max()) / _BLOCKS_ALONG or 1.0
        place = np.minimum((queries - low) / cell, _BLOCKS_ALONG - 1).astype(np.int16)
        number = (place[:, 0] * _BLOCKS_ALONG + place[:, 1]) * _BLOCKS_ALONG + place[:, 2]
        self.order = np.argsort(number, kind="stable")
        self.starts = np.flatnonzero(np.diff(number[self.order], prepend=-1))
        self.ends = np.append(self.starts[1:], len(queries))
        self.queries = queries.take(self.order, axis=0)
        self.cloud, self.k = cloud, k
        shape = (len(queries), k)
        self.best = TileMatches(
            np.full(shape, max_distance),
            np.full(shape, _NO_ROW),
            np.full(shape, -1, np.int32),
            np.zeros(shape, np.int32),
        )
        self.reach = np.full(len(self.starts), max_distance)  # largest distance to a k-th nearest point in each block
        self.low, self.high = (reduce.reduceat(self.queries, self.starts) for reduce in (np.minimum, np.maximum))
        self.near = self._near_tiles()

    def _near_tiles(self) -> _NearTiles:
        """Return the tiles that may contain results of each block: no other tile certainly contains nearer ones."""
        near_all = self._near_box()
        upper = np.square(self.reach)
        nothing = np.zeros(0, np.int64)
        near = [_NearTiles(nothing, nothing, np.zeros(0))]  # all tiles may lie beyond the maximum distance
        for start in range(0, len(near_all), _TILES_AT_ONCE):
            some = near_all[start : start + _TILES_AT_ONCE]
            gaps, largest = _squared_ranges(self.low, self.high, self.cloud.low[some], self.cloud.high[some])
            enough = self.cloud.counts[some] >= self.k
            if enough.any():
                upper = np.minimum(upper, largest[:, enough].min(axis=1))
            is_near = gaps <= upper[:, None] * (1 + 1e-12)
            blocks, columns = np.nonzero(is_near)
            near.append(_NearTiles(blocks, some[columns], gaps[is_near]))
        every = _NearTiles(
            np.concatenate([part.blocks for part in near]),
            np.concatenate([part.tiles for part in near]),
            np.concatenate([part.squared_gaps for part in near]),
        )
        kept = np.flatnonzero(every.squared_gaps <= upper[every.blocks] * (1 + 1e-12))
        order = kept[np.lexsort((every.blocks[kept], every.tiles[kept]))]
        return _NearTiles(every.blocks[order], every.tiles[order], every.squared_gaps[order])

    def _near_box(self) -> IntArray:
        """Return the tiles (T,) that may contain results of any query, from the box of all queries."""
        occupied = np.array(self.cloud.occupied)
        low, high = self.low.min(axis=0, keepdims=True), self.high.max(axis=0, keepdims=True)
        gaps, largest = _squared_ranges(low, high, self.cloud.low[occupied], self.cloud.high[occupied])
        certain = largest[0, self.cloud.counts[occupied] >= self.k].min(initial=np.square(self.reach.max()))
        near: IntArray = occupied[gaps[0] <= certain * (1 + 1e-12)]
        return near

    def first_tiles(self) -> IntArray:
        """Return the tile (B,) to search first for each block: of the nearest boxes, the one nearest to its centre."""
        blocks, tiles, squared_gaps = self.near
        center = 0.5 * (self.low + self.high)[blocks]
        to_center = _squared_gaps(center, self.cloud.low[tiles], self.cloud.high[tiles])
        order = np.lexsort((tiles, to_center, squared_gaps, blocks))
        first = np.full(len(self.starts), -1)
        used_blocks, starts = np.unique(blocks[order], return_index=True)
        first[used_blocks] = tiles[order[starts]]
        return first

    def tiles_by_distance(self) -> list[int]:
        """Return the tiles that may contain results, nearest first."""
        tiles, starts = np.unique(self.near.tiles, return_index=True)
        if not len(tiles):
            return []
        nearest = np.minimum.reduceat(self.near.squared_gaps, starts)
        return [int(tile) for tile in tiles[np.argsort(nearest, kind="stable")]]

    def visit(self, tile: int, candidates: IntArray) -> None:
        """Search a tile for the queries of some blocks whose results it may change."""
        low, high = np.searchsorted(self.near.tiles, [tile, tile + 1])
        blocks, gaps = self.near.blocks[low:high], self.near.squared_gaps[low:high]
        blocks = blocks[(gaps <= np.square(self.reach[blocks]) * (1 + 1e-12)) & np.isin(blocks, candidates)]
        if not len(blocks):
            return
        which = np.concatenate([np.arange(self.starts[block], self.ends[block]) for block in blocks])
        worst = self.best.distances[which, -1]
        gap = np.sqrt(_squared_gaps(self.queries.take(which, axis=0), self.cloud.low[tile], self.cloud.high[tile]))
        which = which[gap <= worst]
        if len(which):
            self._search(tile, which)
            for block in blocks:
                self.reach[block] = self.best.distances[self.starts[block] : self.ends[block], -1].max()

    def _search(self, tile: int, which: IntArray) -> None:
        queries, worst = self.queries.take(which, axis=0), self.best.distances[which, -1]
        index, rows = self.cloud.index(tile), self.cloud.open(tile, "rows")
        k = min(self.k, len(index))
        matches = index.query(queries, k)
        indices = matches.indices.reshape(len(which), k)
        nearer = TileMatches(
            matches.distances.reshape(len(which), k),
            rows.take(indices),
            np.full(indices.shape, tile, np.int32),
            indices.astype(np.int32),
        )
        best = self.best
        before = TileMatches(best.distances[which], best.rows[which], best.tiles[which], best.places[which])
        better = nearer
        if k < self.k or (before.tiles >= 0).any() or np.isfinite(worst).any():
            before_squared = _squared_distances(before.column(self.cloud, "points"), queries)
            found_squared = _squared_distances(index.points.take(indices, axis=0), queries)
            # Squares decide, as in memory: square roots of different squares may be equal.
            limit = np.where(before.rows == _NO_ROW, np.square(before.distances), before_squared)
            better = _merge(before, limit, nearer, found_squared, self.k)
        best.distances[which], best.rows[which] = better.distances, better.rows
        best.tiles[which], best.places[which] = better.tiles, better.places

    def found(self) -> TileMatches:
        """Return the results in the order of the queries."""
        back = np.empty(len(self.order), np.int64)
        back[self.order] = np.arange(len(self.order))
        best = self.best
        return TileMatches(
            best.distances.take(back, axis=0),
            best.rows.take(back, axis=0),
            best.tiles.take(back, axis=0),
            best.places.take(back, axis=0),
        )


def _squared_length(components: Iterable[FloatArray]) -> FloatArray:
    """Squared lengths of vectors from their three components, summed as in the compiled search."""
    x, y, z = components
    squared: FloatArray = np.square(x) + np.square(y) + np.square(z)
    return squared


def _squared_ranges(
    low: FloatArray, high: FloatArray, tile_low: FloatArray, tile_high: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Squares (B, T) of the smallest and the largest distance between points of boxes (B, 3) and of tiles (T, 3)."""
    below = [low[:, axis, None] - tile_high[:, axis] for axis in range(3)]
    above = [tile_low[:, axis] - high[:, axis, None] for axis in range(3)]
    gaps = _squared_length(np.maximum(0, np.maximum(a, b)) for a, b in zip(above, below, strict=True))
    return gaps, _squared_length(np.minimum(a, b) for a, b in zip(above, below, strict=True))


def _squared_gaps(points: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray:
    """Squared distances of points (..., 3) to boxes.

    The sums are rounded like squared distances between points, so they never exceed that of a point in the box.
    """
    return _squared_length(
        np.maximum(0, np.maximum(low[..., axis] - points[..., axis], points[..., axis] - high[..., axis]))
        for axis in range(3)
    )


def _squared_distances(points: FloatArray, queries: FloatArray) -> FloatArray:
    """Squared distances (M, k) of points (M, k, 3) from queries (M, 3)."""
    return _squared_length(points[..., axis] - queries[:, None, axis] for axis in range(3))


def _merge(
    one: TileMatches, one_squared: FloatArray, other: TileMatches, other_squared: FloatArray, k: int
) -> TileMatches:
    """Return the k nearest of both by (squared distance, row)."""
    squared = np.concatenate([one_squared, other_squared], axis=1)
    order = np.lexsort((np.concatenate([one.rows, other.rows], axis=1), squared))[:, :k]

    def best(a: NDArray[Any], b: NDArray[Any]) -> NDArray[Any]:
        nearest: NDArray[Any] = np.take_along_axis(np.concatenate([a, b], axis=1), order, axis=1)
        return nearest

    return TileMatches(
        best(one.distances, other.distances),
        best(one.rows, other.rows),
        best(one.tiles, other.tiles),
        best(one.places, other.places),
    )
