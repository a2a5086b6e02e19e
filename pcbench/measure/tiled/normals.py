"""Normals and spacings of the points of a tile, equal to the last bit to those of the complete cloud in memory."""

from __future__ import annotations

import math
from functools import reduce
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.neighbors import Index
from pcbench.geometry.sampling import COINCIDENT_NEIGHBORS, PROFILE_NEIGHBORS, profile_step
from pcbench.measure.tiled.columns import save_column
from pcbench.measure.tiled.ranks import BitHistogram
from pcbench.measure.tiled.search import nearest_in_tiles
from pcbench.measure.tiled.tiles import GIVEN_NORMALS, NORMALS, VARIATIONS, WIDE_NORMALS, TiledCloud
from pcbench.tasks.results import read_shared

MIN_PLANE_POINTS = 3
_HALO_SPACINGS = 4.0  # width of the halo, in radii of a disk that holds k points at the tile's mean density
_MAX_HALO = 4  # points around a tile per point of it: scattered points have a wide halo, and dense neighbours
_FEW_POINTS = 20_000  # which any halo may have
_SEARCHED_AT_ONCE = 50_000  # points whose neighbours are searched in tiles


def add_normals(file: Path, key: str, number: int, k: int) -> BitHistogram:
    """Store the columns `normals` (N, 3), `variation`, `spacings` and `profile` of a tile.

    Normals are those given with the cloud; where there are none, they are estimated from the k nearest points, see
    `pcbench.geometry.normals`. The surface variation (N,) is that of these points. Spacings (M,) are the distances to
    the nearest point at another position, without those of points that occur more than seven times. The profile (P, K)
    has the distances of some points to K neighbours, see `pcbench.geometry.sampling`.

    Clouds of one or two points have no variation, and no normals unless these are given for all points.

    Args:
        file: the shared `TiledCloud` of the cloud, with at least k points.
        key: identifies its content.
        number: number of the tile.
        k: number of neighbours, the point itself included, at least 3 unless the cloud has fewer points.

    Returns:
        The histogram of the spacings.
    """
    cloud = read_shared(file, key, TiledCloud)
    points = cloud.load(number, "points")
    if cloud.count < MIN_PLANE_POINTS:
        return _add_to_few(cloud, number, points)
    around = _Surroundings.of(cloud, number, k)
    planes = _local_planes(cloud, number, points, around, k)
    _save_planes(cloud, number, NORMALS, planes)
    save_column(cloud.folder, number, "profile", _profile(cloud, number, points, around))
    distances = planes.spacings
    coincident = np.flatnonzero(distances == 0)
    for start in range(0, len(coincident), _SEARCHED_AT_ONCE):
        some = coincident[start : start + _SEARCHED_AT_ONCE]
        near = nearest_in_tiles(points[some], cloud, min(COINCIDENT_NEIGHBORS, int(cloud.counts.sum()))).distances
        distances[some] = np.where(near > 0, near, np.inf).min(axis=1)
    spacings = distances[np.isfinite(distances)]
    save_column(cloud.folder, number, "spacings", spacings)
    return BitHistogram.of(spacings)


def _add_to_few(cloud: TiledCloud, number: int, points: FloatArray) -> BitHistogram:
    """Store the columns of `add_normals` for points (N, 3) of a cloud that has too few for a plane."""
    if cloud.has_column(GIVEN_NORMALS):
        given = [cloud.load(tile, GIVEN_NORMALS) for tile in cloud.occupied]
        if not any(np.isnan(normals).any() for normals in given):
            save_column(cloud.folder, number, NORMALS, cloud.load(number, GIVEN_NORMALS))
    others = nearest_in_tiles(points, cloud, cloud.count).distances[:, 1:]
    save_column(cloud.folder, number, "profile", others)
    spacings = others[others > 0]
    save_column(cloud.folder, number, "spacings", spacings)
    return BitHistogram.of(spacings)


def add_wide_normals(file: Path, key: str, number: int, k: int) -> None:
    """Store the columns `wide_normals` and `wide_variation` of a tile: as `add_normals` does, with another number k."""
    cloud = read_shared(file, key, TiledCloud)
    points, around = cloud.load(number, "points"), _Surroundings.of(cloud, number, k)
    _save_planes(cloud, number, WIDE_NORMALS, _local_planes(cloud, number, points, around, k))


class _Planes(NamedTuple):
    """Planes through the k nearest points of each point.

    Attributes:
        spacings: (N,) distance to the nearest other point.
        normals: (N, 3).
        variation: (N,) surface variation.
    """

    spacings: FloatArray
    normals: FloatArray
    variation: FloatArray


def _save_planes(cloud: TiledCloud, number: int, column: str, planes: _Planes) -> None:
    """Store the surface variation of a tile, and its normals: those given with the cloud where there are any."""
    save_column(cloud.folder, number, VARIATIONS[column], planes.variation.astype(np.float32))  # as in memory
    directions = planes.normals
    if cloud.file(number, GIVEN_NORMALS).exists():
        given = cloud.load(number, GIVEN_NORMALS)
        directions = np.where(np.isnan(given[:, :1]), directions, given)
    save_column(cloud.folder, number, column, directions)


class _Surroundings(NamedTuple):
    """The points of a cloud in a box around a tile; none if they are too many, or too few for a plane."""

    points: Index | None
    rows: IntArray  # (N,) rows of the points, ascending
    low: FloatArray  # (3,) corners of the box
    high: FloatArray

    @classmethod
    def of(cls, cloud: TiledCloud, number: int, k: int) -> _Surroundings:
        """Return the points among which most of the points of a tile have their k nearest ones."""
        width = _halo_width(cloud, number, k)
        low, high = cloud.low[number] - width, cloud.high[number] + width
        most = max(_MAX_HALO * int(cloud.counts[number]), _FEW_POINTS)
        points, rows = _points_in_box(cloud, low, high, most=most)
        return cls(Index(points) if len(points) >= k else None, rows, low, high)


def _local_planes(cloud: TiledCloud, number: int, points: FloatArray, around: _Surroundings, k: int) -> _Planes:
    """Return the planes of the points (N, 3) of a tile."""
    local = _Planes(np.empty(len(points)), np.empty((len(points), 3)), np.empty(len(points)))
    certain = np.zeros(len(points), bool)
    if around.points is not None:
        planes = around.points.local_planes(k)
        own = np.searchsorted(around.rows, cloud.open(number, "rows"))
        local = _Planes(planes.nearest_other.distances[own], planes.normals.take(own, axis=0), planes.variation[own])
        certain = planes.reach[own] < _distance_to_border(points, around.low, around.high)
    rest = np.flatnonzero(~certain)
    for start in range(0, len(rest), _SEARCHED_AT_ONCE):
        some = rest[start : start + _SEARCHED_AT_ONCE]
        searched = _searched_planes(cloud, points[some], cloud.open(number, "rows")[some], k)
        for values, rest_values in zip(local, searched, strict=True):
            values[some] = rest_values
    return local


def _profile(cloud: TiledCloud, number: int, points: FloatArray, around: _Surroundings) -> FloatArray:
    """Return the distances (P, K), ascending, of those points (N, 3) of a tile that belong to the cloud's profile."""
    count = int(cloud.counts.sum())
    k = min(1 + PROFILE_NEIGHBORS, count)
    places = points[np.flatnonzero(cloud.open(number, "rows") % profile_step(count) == 0)]
    distances, certain = np.empty((len(places), k)), np.zeros(len(places), bool)
    if around.points is not None and len(around.points) >= k:
        distances = around.points.query(places, k).distances
        certain = distances[:, -1] < _distance_to_border(places, around.low, around.high)
    distances[~certain] = nearest_in_tiles(places[~certain], cloud, k).distances
    return distances[:, 1:]


def _searched_planes(cloud: TiledCloud, points: FloatArray, rows: IntArray, k: int) -> _Planes:
    """Return the planes of points (N, 3) with these rows (N,) of the cloud, from a search in all tiles."""
    matches = nearest_in_tiles(points, cloud, k)
    # The same planes as in the complete cloud: of these points and their neighbours, in the order of rows.
    every, first = np.unique(np.concatenate([rows, matches.rows.ravel()]), return_index=True)
    near = np.concatenate([points, matches.column(cloud, "points").reshape(-1, 3)])[first]
    planes = Index(near).local_planes(k, np.searchsorted(every, rows))
    return _Planes(matches.distances[:, 1], planes.normals, planes.variation)


def _halo_width(cloud: TiledCloud, number: int, k: int) -> float:
    """Return the width around a tile beyond which few points have neighbours, if its points form a surface."""
    sides = np.sort(cloud.high[number] - cloud.low[number])
    area = float(sides[1] * sides[2])
    return _HALO_SPACINGS * math.sqrt(k * area / (math.pi * int(cloud.counts[number])))


def _points_in_box(cloud: TiledCloud, low: FloatArray, high: FloatArray, most: int) -> tuple[FloatArray, IntArray]:
    """Return the points (N, 3) of a cloud in a box and their rows (N,), ascending; none if they exceed `most`."""
    points, rows, count = [np.zeros((0, 3))], [np.zeros(0, np.int64)], 0
    overlaps = (cloud.counts > 0) & (cloud.low <= high).all(axis=1) & (cloud.high >= low).all(axis=1)
    for tile in map(int, np.flatnonzero(overlaps)):
        candidates = cloud.open(tile, "points")
        inside = _positions_in_box(candidates, low, high)
        count += len(inside)
        if count > most:
            return points[0], rows[0]
        points.append(candidates.take(inside, axis=0))
        rows.append(cloud.open(tile, "rows").take(inside))
    every = np.concatenate(rows)
    order = np.argsort(every, kind="stable")  # fast, because the rows of each tile are in order
    return np.concatenate(points).take(order, axis=0), every[order]


def _positions_in_box(points: FloatArray, low: FloatArray, high: FloatArray) -> IntArray:
    """Return the ascending positions of the points (N, 3) in a box with corners `low` (3,) and `high` (3,)."""
    positions: IntArray | None = None
    for axis in range(3):
        values = points[:, axis] if positions is None else points[positions, axis]
        inside = np.flatnonzero((values >= low[axis]) & (values <= high[axis]))
        positions = inside if positions is None else positions[inside]
    assert positions is not None
    return positions


def _distance_to_border(points: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray:
    """Return the distance (N,) of points (N, 3) in a box from its border."""
    sides = (np.minimum(points[:, axis] - low[axis], high[axis] - points[:, axis]) for axis in range(3))
    return reduce(np.minimum, sides)
