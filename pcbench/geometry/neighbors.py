"""Exact nearest-neighbour search. Only this module calls the compiled search over points.

Every result equals a float64 brute-force search that evaluates (dx*dx + dy*dy) + dz*dz in this order and breaks ties by
the lowest index, on any machine and with any number of threads.
"""

import math
from typing import Any, NamedTuple, NoReturn

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pcbench.errors import InputError
from pcbench.geometry.arrays import MAX_COORDINATE
from pcbench.native import _core

__all__ = ["Index", "LocalPlanes", "Matches", "Neighborhoods", "match_both_directions"]

_BLOCK_ROWS = 65_536  # rows that are drawn at a time
_MAX_FILTERED = 300  # neighbours that are searched for those in a share; more take longer than an index of the share
_MAX_LIMITS = 8  # distances within which `Index.count_near` counts points at a time


class Matches(NamedTuple):
    """Nearest points: distances, in the unit of the coordinates, and indices; one row per query."""

    distances: NDArray[np.float64]
    indices: NDArray[np.int64]

    def at(self, rows: NDArray[np.int64]) -> "Matches":
        """Return the matches of some queries, given by their rows (M,)."""
        return Matches(self.distances[rows], self.indices[rows])


class Neighborhoods(NamedTuple):
    """Neighbours of each query: those of query i are indices[offsets[i]:offsets[i + 1]], in ascending order."""

    offsets: NDArray[np.int64]
    indices: NDArray[np.int64]

    @property
    def counts(self) -> NDArray[np.int64]:
        """Number of neighbours of each query (N,)."""
        return np.diff(self.offsets)


class LocalPlanes(NamedTuple):
    """Planes through the k nearest points of indexed points; one row per point.

    Attributes:
        normals: (M, 3) unit vectors, oriented upwards: z > 0; if z is 0, y > 0; if both are 0, x > 0.
        variation: (M,) smallest eigenvalue of the covariance divided by the sum of all three, from 0 to 1/3.
        nearest_other: nearest other point of each point, as from `Index.nearest_other`, without extra cost.
        reach: (M,) distance of the k-th nearest point, the point itself included.
    """

    normals: NDArray[np.float64]
    variation: NDArray[np.float64]
    nearest_other: Matches
    reach: NDArray[np.float64]


class Index:
    """A search tree over points, built in parallel, with about 40 bytes per point in addition to the points.

    A C-contiguous float64 array is not copied and must not change afterwards; other input is converted. Ctrl-C stops
    construction and queries.

    Args:
        points: (N, 3) finite coordinates, N >= 1.

    Raises:
        InputError: the points have another shape, are empty, or are not finite.
    """

    def __init__(self, points: ArrayLike) -> None:
        rows = _as_points(points, "points")
        if len(rows) == 0:
            raise InputError("points: expected at least one point, got none")
        self.points: NDArray[np.float64] = rows.view()
        self.points.flags.writeable = False
        try:
            self._tree = _core.PointIndex(rows)
        except ValueError as error:
            _raise_bad_coordinates(error, rows, "points")

    @classmethod
    def stored(cls, points: NDArray[np.float64], tree: NDArray[np.float64]) -> "Index":
        """Return the index of points (N, 3) from its `tree`, without building it; both may be mapped from files.

        Raises:
            ValueError: the tree has another size, or does not lie at a multiple of 32 bytes.
        """
        index = cls.__new__(cls)
        index.points, index._tree = points, _core.PointIndex(points, tree)
        return index

    @property
    def tree(self) -> NDArray[np.float64]:
        """The search tree as an array of numbers, to be stored."""
        memory = np.empty(self.nbytes // 8)
        self._tree.store(memory)
        return memory

    def __len__(self) -> int:
        return len(self.points)

    def __reduce__(self) -> tuple[type["Index"], tuple[NDArray[np.float64]]]:
        """Pickle the points: another process builds the same tree."""
        return Index, (self.points,)

    @property
    def nbytes(self) -> int:
        """Memory of the tree in bytes, without the points."""
        return self._tree.bytes

    def every(self, step: int) -> NDArray[np.float64]:
        """Return every `step`-th point (M, 3), from the first one on."""
        return self.points[::step]

    def thinned(self, share: float, seed: int) -> "Index":
        """Return an index of a random share, above 0 and below 1, of the points; see `is_kept`."""
        starts = range(0, len(self), _BLOCK_ROWS)  # to limit memory
        blocks = (np.arange(start, min(start + _BLOCK_ROWS, len(self))) for start in starts)
        return Index(self.points[np.concatenate([is_kept(block, share, seed) for block in blocks])])

    def neighbors_in_share(self, queries: NDArray[np.float64], k: int, share: float, seed: int) -> NDArray[np.float64]:
        """Find the k nearest points of each query among a random share of the points, without an index of the share.

        Args:
            queries: (M, 3) coordinates.
            k: number of neighbours.
            share: the share, above 0 and below 1.
            seed: seed of the share; see `is_kept`.

        Returns:
            Coordinates (M, K, 3) of the neighbours, nearest first; K is k, or the number of points in the share.
        """
        count = math.ceil(1.3 * k / share)
        indices, pending = np.empty((len(queries), k), np.int64), np.arange(len(queries))
        while len(pending):
            if count > min(_MAX_FILTERED, len(self)):
                return self._neighbors_in_thinned(queries, k, share, seed)
            near = self.query(queries[pending], count).indices
            kept = is_kept(near, share, seed)
            first = kept & (np.cumsum(kept, axis=1) <= k)
            is_complete = np.count_nonzero(first, axis=1) == k
            indices[pending[is_complete]] = near[is_complete][first[is_complete]].reshape(-1, k)
            pending, count = pending[~is_complete], 2 * count
        return self.points[indices]

    def _neighbors_in_thinned(
        self, queries: NDArray[np.float64], k: int, share: float, seed: int
    ) -> NDArray[np.float64]:
        index = self.thinned(share, seed)
        near = index.query(queries, min(k, len(index))).indices
        return index.points[near.reshape(len(queries), -1)]

    def query(self, queries: ArrayLike, k: int = 1, hint: ArrayLike | None = None) -> Matches:
        """Find the k nearest points of each query.

        Args:
            queries: (M, 3) coordinates.
            k: number of neighbours.
            hint: for k = 1, indices (M,) of points near the result; see `nearest_of_moved`.

        Returns:
            Distances, in the unit of the coordinates, and indices: (M,) for k = 1, else (M, k), sorted by
            (distance, index).

        Raises:
            InputError: k is less than 1 or exceeds the number of points, a coordinate is not finite, or hints are not
                indices of points, one for each query.
        """
        query_points = _as_points(queries, "queries")
        hint = self._as_hints(hint, len(query_points))
        if not 1 <= k <= len(self):
            raise InputError(f"k: expected 1 to {len(self)} (the number of points), got {k}")
        shape = (len(query_points),) if k == 1 else (len(query_points), k)
        matches = Matches(np.empty(shape, np.float64), np.empty(shape, np.int64))
        try:
            if k == 1:
                self._tree.nearest(query_points, hint, *matches)
            else:
                self._tree.knearest(query_points, *matches)
        except ValueError as error:
            _raise_bad_coordinates(error, query_points, "queries")
        return matches

    def query_radius(self, queries: ArrayLike, radius: float) -> Neighborhoods:
        """Find the points within `radius` of each query (M, 3): squared distance <= radius * radius.

        Raises:
            InputError: the radius is negative or not finite, or a coordinate is not finite.
        """
        query_points = _as_points(queries, "queries")
        _check_length(radius, "radius")
        try:
            return Neighborhoods(*self._tree.in_balls(query_points, radius))
        except ValueError as error:
            _raise_bad_coordinates(error, query_points, "queries")

    def count_near(self, queries: "Index", limits: ArrayLike) -> NDArray[np.int64]:
        """Count the points within several distances of each point of another index.

        Args:
            queries: index of the query points.
            limits: (M, S) distances from each query, at most 8; a point at exactly that distance counts.

        Returns:
            Numbers of points (M, S).

        Raises:
            InputError: a distance is negative or not finite, or there is not one row for each query.
        """
        distances = np.ascontiguousarray(limits, np.float64)
        if distances.ndim != 2 or len(distances) != len(queries) or distances.shape[1] > _MAX_LIMITS:
            raise InputError(
                f"limits: expected up to {_MAX_LIMITS} distances for each of the {len(queries)} queries, got an array"
                f" of shape {distances.shape}"
            )
        for extreme in (distances.min(initial=0), distances.max(initial=0)):
            _check_length(float(extreme), "limits")
        counts = np.empty(distances.shape, np.int64)
        self._tree.count_near(queries._tree, distances, counts)
        return counts

    def query_cylinder(self, origins: ArrayLike, axes: ArrayLike, radius: float, half_length: float) -> Neighborhoods:
        """Find the points inside the cylinder around each origin (M, 3) along its unit axis (M, 3).

        A point p with d = p - origin is inside if |d . axis| <= half_length and |d - (d . axis) axis| <= radius.

        Raises:
            InputError: a length is negative or not finite, a coordinate is not finite, or an axis is not a unit vector.
        """
        centers, directions = _as_points(origins, "origins"), _as_points(axes, "axes")
        _check_length(radius, "radius")
        _check_length(half_length, "half_length")
        if len(centers) != len(directions):
            raise InputError(f"axes: expected one for each of the {len(centers)} origins, got {len(directions)}")
        lengths = np.linalg.norm(directions, axis=1)
        unit = np.abs(lengths - 1.0) <= 1e-6
        if not unit.all():
            row = int(np.argmin(unit))
            raise InputError(f"axes: expected unit vectors, got length {lengths[row]:g} in row {row}")
        try:
            return Neighborhoods(*self._tree.in_cylinders(centers, directions, radius, half_length))
        except ValueError as error:
            _raise_bad_coordinates(error, centers, "origins")

    def nearest_other(self) -> Matches:
        """Find the nearest other point of each indexed point. A duplicate is another point, at distance 0.

        Raises:
            InputError: the index contains only one point.
        """
        if len(self) < 2:
            raise InputError("nearest_other: expected an index of at least two points, got one")
        return self.query_index(self)

    def local_planes(self, k: int, rows: ArrayLike | None = None) -> LocalPlanes:
        """Fit a plane to the k nearest points, the point itself included, of each point or of those in `rows` (M,).

        The result depends only on these k points and their order in the index, to the last bit.

        Raises:
            InputError: k is less than 3 or exceeds the number of points, or `rows` are not indices of points.
        """
        if not 3 <= k <= len(self):
            raise InputError(f"k: expected 3 to {len(self)} (the number of points), got {k}")
        selected = None if rows is None else self._as_indices(rows, "rows")
        count = len(self) if selected is None else len(selected)
        fits = LocalPlanes(
            np.empty((count, 3)),
            np.empty(count),
            Matches(np.empty(count), np.empty(count, dtype=np.int64)),
            np.empty(count),
        )
        self._tree.planes(k, selected, fits.normals, fits.variation, *fits.nearest_other, fits.reach)
        return fits

    def query_index(self, queries: "Index") -> Matches:
        """Find the nearest point of each point of another index; about a third faster than `query`.

        The points of an index are already sorted in space. If `queries` is this index, no point is its own neighbour.
        """
        matches = Matches(np.empty(len(queries), np.float64), np.empty(len(queries), np.int64))
        self._tree.nearest_of(queries._tree, *matches)
        return matches

    def query_index_with_ties(self, queries: "Index", slack: float) -> tuple[Matches, NDArray[np.bool_]]:
        """Find nearest points as `query_index` does, and report ties.

        Args:
            queries: index of the query points.
            slack: tolerance of a tie, in squared units; 0 reports none.

        Returns:
            The matches, and a mask (M,): whether the squared distance to another point exceeds the match's by
            less than `slack`.

        Raises:
            InputError: `slack` is negative or not finite.
        """
        if not 0 <= slack <= MAX_COORDINATE**2:
            raise InputError(f"slack: expected a finite squared length of at least 0, got {slack}")
        matches = Matches(np.empty(len(queries), np.float64), np.empty(len(queries), np.int64))
        tied = np.empty(len(queries), np.bool_)
        self._tree.nearest_of(queries._tree, *matches, slack, tied)
        return matches, tied

    def nearest_of_moved(
        self, queries: "Index", motion: NDArray[np.float64], hint: NDArray[np.int64] | None = None
    ) -> tuple[NDArray[np.float64], Matches]:
        """Move the points of another index and find the nearest point of each: the correspondence step of ICP.

        The spatial order of the other index is reused, since a motion preserves neighbourhoods.

        Args:
            queries: index of the query points.
            motion: affine motion (3, 4) or (4, 4) that is applied to the query points.
            hint: indices (M,) of points near the result, such as the matches before a small motion. They save time
                and never change the result.

        Returns:
            The moved points (M, 3) and their matches.
        """
        moved, matches = np.empty((len(queries), 3)), Matches(np.empty(len(queries)), np.empty(len(queries), np.int64))
        rows = np.ascontiguousarray(motion[:3], np.float64)
        hint = self._as_hints(hint, len(queries))
        try:
            self._tree.nearest_of_moved(queries._tree, rows, hint, moved, *matches)
        except ValueError as error:
            _raise_bad_coordinates(error, moved, "queries")
        return moved, matches

    def follow(self, queries: "Index") -> "FollowedQueries":
        """Return the points of another index as queries that move in small steps, such as those of ICP."""
        return FollowedQueries(self, queries)

    def _as_hints(self, values: ArrayLike | None, count: int) -> NDArray[np.int64] | None:
        if values is None:
            return None
        hints = self._as_indices(values, "hint")
        if len(hints) != count:
            raise InputError(f"hint: expected one index for each of the {count} queries, got {len(hints)}")
        return hints

    def _as_indices(self, values: ArrayLike, name: str) -> NDArray[np.int64]:
        rows: NDArray[Any] = np.asarray(values)
        if rows.ndim != 1 or (len(rows) and rows.dtype.kind not in "iu"):
            raise InputError(f"{name}: expected indices of shape (M,), got {rows.dtype} {rows.shape}")
        if len(rows) and not (rows.min() >= 0 and rows.max() < len(self)):
            raise InputError(f"{name}: expected indices from 0 to {len(self) - 1}, got {rows.min()} to {rows.max()}")
        return np.ascontiguousarray(rows, np.int64)


class FollowedQueries:
    """Points of one index that move in small steps, and their nearest points in another, as `Index.nearest_of_moved`.

    A search also returns how far all points but the nearest are from the query. As long as the query has moved less
    than the nearest point is nearer, that point remains the nearest, and no search is needed.

    Args:
        index: the searched index.
        queries: index of the query points, before any motion.
    """

    def __init__(self, index: Index, queries: Index) -> None:
        self._index, self._queries = index, queries
        self._places, self._clearances = np.empty((len(queries), 3)), np.zeros(len(queries))
        self._indices: NDArray[np.int64] | None = None

    def nearest(self, motion: NDArray[np.float64]) -> tuple[NDArray[np.float64], Matches]:
        """Return the moved points (M, 3), after an affine motion (3, 4) or (4, 4), and their nearest points."""
        index, queries = self._index, self._queries
        if self._indices is None:  # a first step is long: it leaves no match as it was
            moved, matches = index.nearest_of_moved(queries, motion)
            self._indices = matches.indices.copy()
            return moved, matches
        moved, distances = np.empty((len(queries), 3)), np.empty(len(queries))
        rows = np.ascontiguousarray(motion[:3], np.float64)
        try:
            index._tree.follow(queries._tree, rows, self._places, self._indices, self._clearances, moved, distances)
        except ValueError as error:
            _raise_bad_coordinates(error, moved, "queries")
        return moved, Matches(distances, self._indices.copy())


def is_kept(rows: NDArray[np.int64], share: float, seed: int) -> NDArray[np.bool_]:
    """Return whether the points with these rows (N,) belong to a random share of a cloud.

    That of one row does not depend on the others, so that a cloud can be thinned piece by piece.
    """
    mixed = rows.astype(np.uint64) + np.uint64((1 + 2 * seed) * 0x9E3779B97F4A7C15 % (1 << 64))
    for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):  # SplitMix64 (Steele et al. 2014)
        mixed = (mixed ^ (mixed >> np.uint64(shift))) * np.uint64(factor)
    kept: NDArray[np.bool_] = (mixed ^ (mixed >> np.uint64(31))) / 2.0**64 < share
    return kept


def match_both_directions(reference: Index, candidate: Index) -> tuple[Matches, Matches]:
    """Match points in both directions: candidate to reference, then reference to candidate.

    The query points are already sorted in space by their own index, so this is faster than two calls of `query`.
    """
    if reference is candidate:
        self_matches = reference.query(reference.points)
        return self_matches, self_matches
    return reference.query_index(candidate), candidate.query_index(reference)


def _as_points(values: ArrayLike, name: str) -> NDArray[np.float64]:
    array: NDArray[Any] = np.asarray(values)
    if array.ndim != 2 or array.shape[1] != 3 or array.dtype.kind not in "fiu":
        raise InputError(f"{name}: expected real numbers of shape (N, 3), got {array.dtype} {array.shape}")
    return np.ascontiguousarray(array, np.float64)


def _check_length(value: float, name: str) -> None:
    if not 0 <= value <= MAX_COORDINATE:
        raise InputError(f"{name}: expected a finite length of 0 to {MAX_COORDINATE:g}, got {value}")


def _raise_bad_coordinates(error: ValueError, rows: NDArray[np.float64], name: str) -> NoReturn:
    """Raise an InputError that names the first bad coordinate. The kernels only report that there is one."""
    wrong = ~(np.abs(rows) <= MAX_COORDINATE)
    if not wrong.any():
        raise error
    row = int(np.argmax(wrong.any(axis=1)))
    expected = f"expected finite coordinates up to {MAX_COORDINATE:g}"
    raise InputError(f"{name}: {expected}, got {rows[row].tolist()} in row {row}; remove such points first") from error
