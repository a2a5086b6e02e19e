"""Double walls: one surface that appears twice, as two parallel sheets a small distance apart.

Drift of a trajectory and errors between scans copy a surface beside itself. The points around a place then have two
heights above the plane through them. They are two sheets if

- the split of the heights with the largest variance between both parts (Otsu 1979) leaves parts whose means are more
  than 4.5 of their standard deviations apart (Ashman et al. 1994, eq. 4: D > 4.5 where a flat distribution has 3.5),
  and few points lie between them,
- both parts lie around the middle of the place and not side by side, as those of a step or of roofs and ground do, and
- a group of neighbouring places agrees in the normal and in the distance.

A board or thin wall that was scanned from both sides looks the same. Where the file has normals, sheets that face
opposite directions are therefore not counted.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.neighbors import Index
from pcbench.measure.intervals import partition
from pcbench.measure.quality.bootstrap import BlockEstimate, median_estimate
from pcbench.measure.quality.groups import PointGroups
from pcbench.measure.quality.patches import neighborhoods, seeds_of

SEPARATION_SPACINGS = 22.0
"""Largest distance of the sheets that is searched for, in spacings."""
_RADIUS_SPACINGS = 8.0  # smallest radius of the places
_MAX_SEPARATION_SHARE = 0.7  # of the radius: farther sheets have too few points within it
_MIN_SCALES = 2  # radii, each twice the one before
_MIN_D, _MAX_VALLEY = 4.5, 0.35
_MIN_PART_SHARE, _MIN_PART_POINTS = 0.15, 6
_MIN_STEPS = 3.0  # in which coordinates are rounded: rounding makes sheets one step apart
_MIN_QUADRANTS = 3  # around the place, in which both sheets have points
_INNER_SHARE = 2 / 3  # of the radius, within which these points lie
_PLACES_PER_RADIUS = 3  # along an axis, beyond the first radius: a wall of a room has few places one radius apart
_MIN_BREADTH = 0.15  # second over first eigenvalue: points along a line have less
_MAX_WIDTH_SHARE = 0.12  # standard deviation of a sheet over the radius
_LINK_RADII, _MAX_LINK_ANGLE_DEG, _MAX_LINK_RATIO = 3.0, 15.0, 1.3
_MIN_PLACES = 16  # of a double wall: a few places are frames, boards and other thin things
_MIN_NEIGHBOR_SHARE = 0.4  # of the places around one with two sheets that have two as well
_MIN_FACING = 0.5  # mean product of normals of both sheets, above which they face one way


class DoubleWall(NamedTuple):
    """One surface that appears twice.

    Attributes:
        centre: its middle.
        separation: median distance of the sheets, along their normal.
        places: number of places at which it was measured.
        area: their area, in squared units, roughly.
    """

    centre: tuple[float, float, float]
    separation: float
    places: int
    area: float


class DoubleWalls(NamedTuple):
    """The double walls of a cloud.

    Attributes:
        walls: the walls, the largest first.
        separation: median distance of the sheets over all places; None without double walls.
        max_separation: largest distance that was searched for.
        tested: number of places that were tested.
        places: (P, 3) places of the walls.
        radius: (P,) radius of each place.
    """

    walls: tuple[DoubleWall, ...]
    separation: BlockEstimate | None
    max_separation: float
    tested: int
    places: FloatArray
    radius: FloatArray


class _Sheets(NamedTuple):
    """Places with two sheets: positions (P, 3), normals (P, 3), distances and radii (P,)."""

    places: FloatArray
    normals: FloatArray
    separations: FloatArray
    radii: FloatArray

    def select(self, rows: NDArray[np.bool_] | IntArray) -> _Sheets:
        return _Sheets(*(values[rows] for values in self))


def double_walls(
    index: Index,
    spacing: float,
    step: float,
    max_separation: float | None,
    seed: int,
    normals: FloatArray | None = None,
) -> DoubleWalls:
    """Find the double walls of a cloud.

    Args:
        index: index of the points (N, 3).
        spacing: their spacing.
        step: coarsest step in which the coordinates are rounded.
        max_separation: largest distance of the sheets; None: `SEPARATION_SPACINGS` spacings.
        seed: seed of random samples.
        normals: (N, 3) normals of the file, if it has any.
    """
    limit = SEPARATION_SPACINGS * spacing if max_separation is None else max_separation
    first = max(_RADIUS_SPACINGS * spacing, 0.05 * limit)
    radii = [first * 2**k for k in range(_scales(first, limit))]
    edges = [first, *(radius / _PLACES_PER_RADIUS for radius in radii[1:])]  # of the cells with one place each
    parts, tested = list[_Sheets](), 0
    for radius, edge in zip(radii, edges, strict=True):
        seeds = seeds_of(index.points, edge, seed)
        sheets, number = _sheets_around(index, seeds, radius, step, seed, normals)
        tested += number
        parts.append(sheets.select(sheets.separations <= limit))
    walls, members = _walls(parts, edges)
    groups = [sheets.select(rows) for sheets, rows in members]
    if not groups:
        return DoubleWalls((), None, limit, tested, np.empty((0, 3)), np.empty(0))
    together = _Sheets(*(np.concatenate(columns) for columns in zip(*groups, strict=True)))
    blocks = partition(together.places).of_point
    separation = median_estimate(together.separations, blocks, seed)
    return DoubleWalls(tuple(walls), separation, limit, tested, together.places, together.radii)


def _scales(first: float, limit: float) -> int:
    """Return the number of radii, each twice the one before, up to one in which both sheets have points."""
    wanted = np.log2(max(limit / (_MAX_SEPARATION_SHARE * first), 1.0))
    return max(int(np.ceil(wanted)) + 1, _MIN_SCALES)


def _sheets_around(
    index: Index, seeds: FloatArray, radius: float, step: float, seed: int, normals: FloatArray | None
) -> tuple[_Sheets, int]:
    """Return the places with two sheets, with a share of such places around them, and the number of tested places."""
    parts, tested = list[_Sheets](), list[FloatArray]()
    for start, groups in neighborhoods(index, seeds, radius, 2 * _MIN_PART_POINTS, seed):
        here = seeds[start : start + len(groups.counts)]
        is_double, axes, separations = _split(groups, here, radius, step, normals)
        parts.append(
            _Sheets(here[is_double], axes[is_double], separations[is_double], np.full(is_double.sum(), radius))
        )
        tested.append(here[groups.counts >= 2 * _MIN_PART_POINTS])
    places = np.concatenate(tested)
    sheets = _Sheets(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))
    if not len(sheets.places):
        return sheets, len(places)
    around = Index(places).query_radius(sheets.places, 2 * radius).counts
    double = Index(sheets.places).query_radius(sheets.places, 2 * radius).counts
    return sheets.select(double >= _MIN_NEIGHBOR_SHARE * around), len(places)


def _split(
    groups: PointGroups, seeds: FloatArray, radius: float, step: float, normals: FloatArray | None
) -> tuple[NDArray[np.bool_], FloatArray, FloatArray]:
    """Return which groups are two sheets (G,), the normals (G, 3), and the distances of the sheets (G,)."""
    offsets = groups.values - seeds[groups.of_row]
    ones = np.ones(len(offsets))
    means, _, axes = groups.principal_axes(offsets, ones)
    upper = _upper_part(groups, groups.along(offsets - means[groups.of_row], axes[:, :, 0]))
    # The normal follows from the points about the mean of each sheet, and the split from the normal.
    centred = offsets - _part_means(groups, offsets, upper)
    _, variances_along, axes = groups.principal_axes(centred, ones)
    heights = groups.along(offsets - means[groups.of_row], axes[:, :, 0])
    upper = _upper_part(groups, heights)
    is_in = [(~upper).astype(np.float64), upper.astype(np.float64)]
    counts, sums, squares = (
        np.stack([groups.sums(values * part) for part in is_in])
        for values in (np.ones_like(heights), heights, heights**2)
    )
    middles = sums / np.maximum(counts, 1)
    variances = np.maximum(squares / np.maximum(counts, 1) - middles**2, 0)
    separations = middles[1] - middles[0]
    width = np.sqrt(variances.mean(axis=0))
    position = (heights - middles[0][groups.of_row]) / np.maximum(separations, 1e-300)[groups.of_row]
    between = groups.sums(((position > 1 / 3) & (position < 2 / 3)).astype(np.float64)) * 3
    within = groups.sums(((position >= 0) & (position <= 1)).astype(np.float64))
    across = [groups.along(offsets, axes[:, :, k]) for k in (1, 2)]
    inner = np.hypot(*across) < _INNER_SHARE * radius
    quadrants = [_quadrants(groups, across[0] >= 0, across[1] >= 0, part & inner) for part in (upper, ~upper)]
    smaller = counts.min(axis=0)
    is_double = (
        (smaller >= np.maximum(_MIN_PART_SHARE * groups.counts, _MIN_PART_POINTS))
        & (separations > _MIN_D * width)
        & (separations > _MIN_STEPS * step)
        & (separations <= _MAX_SEPARATION_SHARE * radius)
        & (between < _MAX_VALLEY * within)
        & (np.minimum(*quadrants) >= _MIN_QUADRANTS)
        & (np.sqrt(variances.max(axis=0)) < _MAX_WIDTH_SHARE * radius)
        & (variances_along[:, 1] > _MIN_BREADTH * variances_along[:, 2])
    )
    if normals is not None:
        facing = groups.along(normals[groups.rows], axes[:, :, 0])
        below, above = (groups.sums(facing * part) / np.maximum(groups.sums(part), 1) for part in is_in)
        is_double &= ~((below * above < 0) & (np.minimum(np.abs(below), np.abs(above)) > _MIN_FACING))
    return is_double, axes[:, :, 0], separations


def _quadrants(
    groups: PointGroups, right: NDArray[np.bool_], up: NDArray[np.bool_], part: NDArray[np.bool_]
) -> IntArray:
    """Return the number of quadrants (G,) of each group in which a part of its points lies."""
    number = np.zeros(len(groups.counts), dtype=np.int64)
    for is_right in (False, True):
        for is_up in (False, True):
            number += groups.sums(((right == is_right) & (up == is_up) & part).astype(np.float64)) > 0
    return number


def _upper_part(groups: PointGroups, heights: FloatArray) -> NDArray[np.bool_]:
    """Return which heights (N,) are above the split with the largest variance between both parts (Otsu 1979)."""
    order = groups.ordered(heights)
    ordered = heights[order]
    sums = np.cumsum(ordered)
    before = np.concatenate([[0.0], sums])[groups.starts]
    totals = groups.sums(ordered)
    below = np.arange(len(ordered)) - groups.starts[groups.of_row] + 1.0
    above = groups.counts[groups.of_row] - below
    low = sums - before[groups.of_row]
    high = totals[groups.of_row] - low
    between = np.where(above > 0, below * above * (high / np.maximum(above, 1) - low / below) ** 2, 0.0)
    best = np.maximum.reduceat(between, groups.starts)
    is_best = between == best[groups.of_row]
    place = np.where(is_best, np.arange(len(ordered)), len(ordered))
    split = np.minimum.reduceat(place, groups.starts)
    upper = np.empty(len(heights), dtype=bool)
    upper[order] = np.arange(len(ordered)) > split[groups.of_row]
    return upper


def _part_means(groups: PointGroups, offsets: FloatArray, upper: NDArray[np.bool_]) -> FloatArray:
    """Return for each point (N, 3) the mean of the part of its group to which it belongs."""
    means = np.empty_like(offsets)
    for part in (upper, ~upper):
        counts = np.maximum(groups.sums(part.astype(np.float64)), 1)
        sums = np.stack([groups.sums(offsets[:, axis] * part) for axis in range(3)], axis=1)
        means[part] = (sums / counts[:, None])[groups.of_row[part]]
    return means


def _walls(
    scales: list[_Sheets], edges: list[float]
) -> tuple[list[DoubleWall], list[tuple[_Sheets, NDArray[np.bool_]]]]:
    """Group places that agree, at each radius; a place near a wall of a smaller radius belongs to that one."""
    walls, members, nearer = list[DoubleWall](), list[tuple[_Sheets, NDArray[np.bool_]]](), list[_Sheets]()
    for sheets, edge in zip(scales, edges, strict=True):
        for other in nearer:
            if len(sheets.places):
                is_new = Index(other.places).query(sheets.places).distances > 2 * sheets.radii
                sheets = sheets.select(is_new)
        labels = _components(sheets)
        counted = np.zeros(len(sheets.places), dtype=bool)
        for label in np.flatnonzero(np.bincount(labels) >= _MIN_PLACES) if len(labels) else []:
            rows = labels == label
            counted |= rows
            centre = np.median(sheets.places[rows], axis=0)
            separation, number = float(np.median(sheets.separations[rows])), int(rows.sum())
            x, y, z = map(float, centre)
            cells = 1 + min(separation / edge, 1.0)  # on average, that both sheets fill at a place
            walls.append(DoubleWall((x, y, z), separation, number, number * edge**2 / cells))
        if counted.any():
            members.append((sheets, counted))
            nearer.append(sheets.select(counted))
    return sorted(walls, key=lambda wall: -wall.area), members


def _components(sheets: _Sheets) -> IntArray:
    """Return the group (P,) of each place: neighbours with about the same normal and distance share a group."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    count = len(sheets.places)
    if not count:
        return np.empty(0, dtype=np.int64)
    near = Index(sheets.places).query_radius(sheets.places, _LINK_RADII * float(sheets.radii[0]))
    first, second = np.repeat(np.arange(count), near.counts), near.indices
    ratio = sheets.separations[first] / sheets.separations[second]
    aligned = np.abs(np.einsum("ni,ni->n", sheets.normals[first], sheets.normals[second]))
    agrees = (
        (ratio < _MAX_LINK_RATIO) & (ratio > 1 / _MAX_LINK_RATIO) & (aligned > np.cos(np.radians(_MAX_LINK_ANGLE_DEG)))
    )
    links = coo_matrix((np.ones(int(agrees.sum())), (first[agrees], second[agrees])), shape=(count, count))
    return np.asarray(connected_components(links, directed=False)[1], dtype=np.int64)
