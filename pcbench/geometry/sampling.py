"""How the points of a cloud are spread over its surfaces: their spacing, copies of points, and scan lines."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.neighbors import Index, Matches
from pcbench.geometry.order_statistics import median

PROFILE_NEIGHBORS = 128
"""Neighbours of a point in a profile: they reach the next scan line if points are up to 60 times denser along lines."""
COINCIDENT_NEIGHBORS = 8
"""Neighbours of a point, itself included, among which one at another position is searched."""
_SPACING_SAMPLE = 20_000  # points that a median spacing is estimated from; at most twice as many are used
_PROFILE_SAMPLE = 2_500  # points of a profile, at most twice as many: a median then has a standard error of 1.3 %

# Copies of a point are nearer than its other neighbours by this factor. Of randomly strewn points on a surface, 6.3 %
# (one in 4^2) have a nearest neighbour that is so much nearer than the second one by chance.
_MIN_JUMP, _MAX_CHANCE_JUMPS = 4.0, 0.15
_MAX_COPIES = 16  # of a point
_COPY_RADIUS = 2.0  # median distances within clumps: the radius of nearly all clumps
_MAX_COPY_SHARE = 1 / 3  # of the spacing: 7 % of strewn points have a nearest neighbour within it by chance

# Of the neighbours of a point as far as the next scan line, that many times as many have a fifth of their points in it.
_PLANE_LINES = 2.5
# Where most points lie in single lines, the distance of neighbours doubles from one rank to the other, and on a surface
# it grows by sqrt(2). It was at most 1.58 in real scans, of which only parts look like lines from nearby.
_LINE_RANKS, _MIN_LINE_GROWTH = (10, 20), 1.7
# Neighbours searched for the next scan line.
_MIN_LINE_NEIGHBORS, _MAX_LINE_NEIGHBORS, _LINE_NEIGHBOR_GROWTH = 12, 512, 1.5
_MIN_VARIANCE_RATIO = 0.1  # variance across over variance along: above it, points are not a single line

# On a surface with n strewn points per unit of area, a share of exp(-pi n r^2) (1 + ... + (pi n r^2)^(k-1) / (k-1)!) of
# the points has its k-th neighbour beyond r. The median of pi n r^2 is about k - 0.307, and log(2) for k = 1.
_MEDIAN_SHIFT = 0.307
_MIN_RANK = 4.0  # of the neighbours that show the density: nearer ones show the arrangement of the points
_MAX_RANK_SHARE = 1 / 32  # of the number of points: farther neighbours show the border of the cloud
_MAX_SURFACE_GROWTH = 1.15  # it was at most 1.09 in 30 measured clouds without scan lines, and 1.36 to 1.8 with them


class Sampling(NamedTuple):
    """The spread of a cloud's points, all lengths in the unit of the coordinates.

    Attributes:
        spacing: the spacing, see `median_spacing`.
        copy_radius: points within this distance of each other are copies of one point. It is 0, so that only
            coincident points are, unless many points have near duplicates.
        copies: number of points at a position, on average over the positions.
        has_lines: whether the points, or many of them, lie in lines, along which they are denser than across.
        line_neighbors: number of points, itself included, from a point to the nearest one in the next line, if the
            nearest points of most points lie in a single line; otherwise 0.
    """

    spacing: float
    copy_radius: float = 0.0
    copies: float = 1.0
    has_lines: bool = False
    line_neighbors: int = 0

    @property
    def definition(self) -> str:
        """Definition of the spacing in words."""
        if self.has_lines:
            return "of as many points strewn over the surface: these lie in lines"
        if self.copy_radius > 0:
            return f"median distance to the nearest neighbour beyond {self.copy_radius:.1g}: nearer points are copies"
        return "median distance to the nearest neighbour"

    def is_elsewhere(self, distances: FloatArray) -> NDArray[np.bool_]:
        """Return which neighbours of points, at distances (M, K), are no copies of them.

        The last one always counts: there may be more copies than neighbours.
        """
        is_other = distances > self.copy_radius
        is_other[:, -1] = True
        return is_other

    def neighbors(self, positions: int) -> int:
        """Return the number of nearest points of a point, itself included, that are at about this many positions."""
        return max(positions, round(positions * self.copies))

    def plane_neighbors(self, positions: int) -> int:
        """Return the number of nearest points, itself included, that show the plane around a point.

        They are at about this many positions, and in several lines if the points lie in lines.
        """
        return max(self.neighbors(positions), math.ceil(_PLANE_LINES * self.line_neighbors))


class NeighborRange(NamedTuple):
    """Smallest and largest distance from a point of a cloud to its nearest other point, in the coordinates' unit."""

    smallest: float
    largest: float

    @classmethod
    def of(cls, nearest_other: Matches | None) -> NeighborRange | None:
        """Return the range of the distances of `Index.nearest_other`; None if there are none."""
        if nearest_other is None:
            return None
        return cls(float(nearest_other.distances.min()), float(nearest_other.distances.max()))

    @classmethod
    def within(cls, index: Index) -> NeighborRange | None:
        """Return the range over all points of an index; None for a single point."""
        return cls.of(index.nearest_other() if len(index) > 1 else None)


def median_spacing(index: Index, nearest_other: Matches | None = None) -> float:
    """Return the median distance from a point to the nearest point at another position; 0 if there is none.

    This is the definition of "spacing" everywhere in pcbench. On surfaces with evenly strewn points, the distances of
    all neighbours show the same density. Where they do not, the spacing is that of the surface, not of what is finer:

    - Copies are ignored: neighbours that are at least four times nearer than the next one, as in clouds that were
      merged with themselves, exactly or almost. The spacing is that of either copy.
    - In scan lines, points are denser along the lines. The spacing is the one that the same number of points would have
      if they were strewn over the surface. It follows from the distances of 4th to 128th neighbours: the largest median
      of r sqrt(log(2) / (k - 0.307)), where r is the distance of the k-th one.

    Args:
        index: index of the cloud.
        nearest_other: result of `Index.nearest_other`, if available. With it the median is taken over all points,
            otherwise over every n-th point, 20,000 to 40,000 in total. Copies and lines are found, and measured, at
            every n-th point, 2,500 to 5,000 in total.
    """
    return sampling_of(index, nearest_other).spacing


def sampling_of(index: Index, nearest_other: Matches | None = None, profile: FloatArray | None = None) -> Sampling:
    """Return the sampling of a cloud.

    Args:
        index: index of the cloud.
        nearest_other: see `median_spacing`.
        profile: distances (M, K) of every `profile_step`-th point to its K nearest other points, in any order of the
            points; None: they are searched.
    """
    if len(index) < 2:
        return Sampling(0.0)
    nearest = _median_nearest(index, nearest_other)
    if profile is not None:
        return sampling_of_profile(nearest, profile, len(index))
    # Farther neighbours have no effect unless points have copies, and small clouds have fewer neighbours within them.
    few = max(_LINE_RANKS[1], int(_MAX_RANK_SHARE * len(index)))
    sampling = sampling_of_profile(nearest, _profile(index, min(few, PROFILE_NEIGHBORS)), len(index))
    if sampling.copies == 1 or few >= PROFILE_NEIGHBORS:
        return sampling
    return sampling_of_profile(nearest, _profile(index, PROFILE_NEIGHBORS), len(index))


def spacing_of_all(index: Index, sampling: Sampling, nearest_other: Matches) -> float:
    """Return the `median_spacing` from the nearest other points of all points, for a cloud whose sampling is known."""
    if len(index) < 2 * _SPACING_SAMPLE or sampling.has_lines or sampling.copy_radius > 0:
        return sampling.spacing
    return _median_nearest(index, nearest_other) or sampling.spacing


def _profile(index: Index, neighbors: int) -> FloatArray:
    """Return the distances (M, K) of every `profile_step`-th point to its nearest other points, at most `neighbors`."""
    places = index.every(profile_step(len(index)))
    return index.query(places, k=min(1 + neighbors, len(index))).distances[:, 1:]


def profile_step(count: int) -> int:
    """Return the step between the rows of the points, of `count`, whose neighbours are the profile of a cloud."""
    return max(1, count // _PROFILE_SAMPLE)


def sampling_of_profile(nearest: float, profile: FloatArray, count: int) -> Sampling:
    """Return the sampling of a cloud from distances within it.

    Args:
        nearest: median distance of a point to the nearest one at another position.
        profile: (M, K) distances of points to their K nearest other points, ascending; in any order of the points.
        count: number of points of the cloud.
    """
    radius = _copy_radius(profile)
    spacing = nearest if radius == 0 < nearest else _median_first(profile, profile > radius)
    copies = _copies(profile, radius)
    # Of points that have c copies, every c-th is at another position. Neighbours are counted in positions.
    ranks = np.arange(2, profile.shape[1] + 2) / copies - 1
    shown = (ranks >= _MIN_RANK) & (ranks <= _MAX_RANK_SHARE * count / copies)
    if not shown.any():
        return Sampling(spacing, radius, copies)
    medians = np.median(profile.T[shown], axis=1, overwrite_input=True)  # of a copy with a row for each rank
    equivalent = medians * np.sqrt(math.log(2) / (ranks[shown] - _MEDIAN_SHIFT))
    of_surface = float(equivalent.max())
    of_points = spacing if radius > 0 else _median_first(profile, profile > 0)  # so that it follows from the profile
    if of_surface <= _MAX_SURFACE_GROWTH * of_points:
        return Sampling(spacing, radius, copies)
    if of_surface > _MAX_SURFACE_GROWTH * equivalent[0]:  # it grows from neighbour to neighbour
        next_line = 2 + int(np.flatnonzero(shown)[equivalent.argmax()])
        return Sampling(of_surface, radius, copies, True, next_line if _are_single_lines(profile, copies) else 0)
    radius = max(radius, _MAX_COPY_SHARE * of_surface)  # of copies that lie almost as far apart as other neighbours
    return Sampling(of_surface, radius, _copies(profile, radius))


def _are_single_lines(profile: FloatArray, copies: float) -> bool:
    """Return whether the nearest points of most points lie in a single line, from distances (M, K) to neighbours."""
    near, far = (min(round(rank * copies), profile.shape[1]) - 1 for rank in _LINE_RANKS)
    inner, outer = profile[:, near], profile[:, far]
    growth = np.divide(outer, inner, out=np.zeros_like(inner), where=inner > 0)
    return float(np.median(growth)) >= _MIN_LINE_GROWTH


def _copies(profile: FloatArray, radius: float) -> float:
    """Return the number of points at a position from distances (M, K) of points to others: the harmonic mean."""
    counts = np.bincount(1 + np.count_nonzero(profile <= radius, axis=1))[1:]  # the order of the points has no effect
    return len(profile) / float((counts / np.arange(1, len(counts) + 1)).sum())


def _copy_radius(profile: FloatArray) -> float:
    """Return the distance within which points are copies of one; 0 if few have near duplicates."""
    near = profile[:, : _MAX_COPIES + 1]
    inner, outer = near[:, :-1], near[:, 1:]
    jumps = np.divide(outer, inner, out=np.zeros_like(inner), where=inner > 0)
    if not jumps.size:
        return 0.0
    has_jump = (jumps >= _MIN_JUMP).any(axis=1)
    if np.count_nonzero(has_jump) <= _MAX_CHANCE_JUMPS * len(profile):
        return 0.0
    last = jumps[has_jump].argmax(axis=1)[:, None]
    within, beyond = (float(np.median(np.take_along_axis(side[has_jump], last, 1))) for side in (inner, outer))
    return min(_COPY_RADIUS * within, _MAX_COPY_SHARE * beyond)


def _median_first(distances: FloatArray, is_other: NDArray[np.bool_]) -> float:
    """Return the median over rows of the first distance (M, K) that is one to another position."""
    first = np.where(is_other, distances, np.inf).min(axis=1)
    finite = first[np.isfinite(first)]
    return median(finite) if len(finite) else 0.0


def _median_nearest(index: Index, nearest_other: Matches | None) -> float:
    """Return the median distance to the nearest point at another position, without points of more than seven copies."""
    if nearest_other is None:
        step = max(1, len(index) // _SPACING_SAMPLE)
        places = index.every(step)
        nearest = index.nearest_other() if step == 1 else index.query(places, k=2)
        distances = nearest.distances.reshape(len(places), -1)[:, -1]
    else:
        places, distances = index.points, nearest_other.distances
    is_duplicate = distances == 0
    if is_duplicate.any():
        around = index.query(places[is_duplicate], k=min(COINCIDENT_NEIGHBORS, len(index))).distances
        first = np.where(around > 0, around, np.inf).min(axis=1)
        distances = np.concatenate([distances[~is_duplicate], first[np.isfinite(first)]])
    return median(distances) if len(distances) else 0.0


def nearest_elsewhere(index: Index, sampling: Sampling, rows: IntArray, queries: FloatArray | None = None) -> Matches:
    """Return the points of a cloud nearest to queries, without the query's own point and its copies.

    Args:
        index: index of the cloud.
        sampling: its sampling.
        rows: (M,) rows of the own points of the queries.
        queries: (M, 3) positions; None: the own points.
    """
    own = index.points[rows]
    k = 2 if sampling.copies == 1 else 1 + _MAX_COPIES
    matches = index.query(own if queries is None else queries, min(k, len(index)))
    separations = np.linalg.norm(index.points[matches.indices] - own[:, None], axis=2)
    is_other = sampling.is_elsewhere(separations)
    first = is_other.argmax(axis=1)[:, None]
    distances, indices = matches
    return Matches(np.take_along_axis(distances, first, 1)[:, 0], np.take_along_axis(indices, first, 1)[:, 0])


def line_gaps(index: Index, positions: FloatArray) -> FloatArray:
    """Return the vectors (P, 3) along the surface from the scan line of each position to the next scan line.

    The number of neighbours grows until they are no longer a single line. The nearest of them beyond the widest gap
    across the line is in the next line. For evenly spread points the result is about their spacing. It is zero if no
    other line is found.
    """
    gaps, lines = np.zeros(positions.shape), np.zeros(positions.shape)  # directions of the lines; 0: not a line
    pending, count = np.arange(len(positions)), _MIN_LINE_NEIGHBORS
    while len(pending) and count <= min(_MAX_LINE_NEIGHBORS, len(index)):
        near = index.query(positions[pending], count).indices
        offsets = index.points[near] - positions[pending, None]
        variances, axes = np.linalg.eigh(np.einsum("pki,pkj->pij", offsets, offsets, optimize=False) / count)
        is_broad = variances[:, 1] > _MIN_VARIANCE_RATIO * variances[:, 2]
        if count == _MIN_LINE_NEIGHBORS:
            across = axes[is_broad, :, 1]
            lines[pending[~is_broad]] = axes[~is_broad, :, 2]
        else:  # neighbours on several lines may extend farther across the lines than along them
            across = np.cross(axes[is_broad, :, 0], lines[pending[is_broad]])
            across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), np.finfo(float).tiny)
        away = np.sort(np.abs(np.einsum("pki,pi->pk", offsets[is_broad], across, optimize=False)), axis=1)
        widest = np.diff(away, axis=1).argmax(axis=1)[:, None]
        beyond, before = (np.take_along_axis(away, widest + after, axis=1) for after in (1, 0))
        gaps[pending[is_broad]] = (beyond - before if count == _MIN_LINE_NEIGHBORS else beyond) * across
        pending, count = pending[~is_broad], int(_LINE_NEIGHBOR_GROWTH * count)
    return gaps
