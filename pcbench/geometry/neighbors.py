"""Exact nearest-neighbour search: the only caller of the compiled search kernels.

Every answer equals a float64 brute force that evaluates (dx*dx + dy*dy) + dz*dz in this order and breaks ties by the
lowest index, on any machine and with any number of threads.
"""

from typing import Any, NamedTuple, NoReturn

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pcbench.errors import InputError
from pcbench.geometry.arrays import MAX_COORDINATE
from pcbench.native import _core

__all__ = ["Index", "LocalPlanes", "Matches", "Neighborhoods", "match_both_ways", "median_spacing"]

_SPACING_SAMPLE = 20_000  # points that a spacing is estimated from
_MAX_DUPLICATES = 8  # nearest points, itself included, among which one in another place is looked for


class Matches(NamedTuple):
    """Nearest points, in the unit of the coordinates: one row for each query."""

    distances: NDArray[np.float64]
    indices: NDArray[np.int64]


class Neighborhoods(NamedTuple):
    """Variable numbers of neighbours: those of query i are indices[offsets[i]:offsets[i + 1]], ascending."""

    offsets: NDArray[np.int64]
    indices: NDArray[np.int64]

    @property
    def counts(self) -> NDArray[np.int64]:
        """The number of neighbours of each query (N,)."""
        return np.diff(self.offsets)

    def of(self, query: int) -> NDArray[np.int64]:
        """The neighbours of one query, ascending."""
        return self.indices[self.offsets[query] : self.offsets[query + 1]]


class LocalPlanes(NamedTuple):
    """Planes through the nearest points around some of the indexed points: one row for each.

    normals (M, 3): unit, their sign chosen upwards: z > 0, then y, then x where the others are zero. variation (M,):
    smallest eigenvalue of the covariance over the sum of all three, 0 to 1/3. nearest_other: see
    `Index.nearest_other`; comes for free here.
    """

    normals: NDArray[np.float64]
    variation: NDArray[np.float64]
    nearest_other: Matches


class Index:
    """A search tree over points (N, 3), N >= 1: built in parallel, at most 40 bytes a point beside the points.

    The points are kept by reference when they are a C-contiguous float64 array, and must not change afterwards;
    anything else is converted first. Raises InputError for another shape, no points, or coordinates that are not
    finite. Ctrl-C stops building and searching.
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
            _explain(error, rows, "points")

    def __len__(self) -> int:
        return len(self.points)

    @property
    def nbytes(self) -> int:
        """Memory of the tree in bytes, without the points."""
        return self._tree.bytes

    def query(self, queries: ArrayLike, k: int = 1) -> Matches:
        """Distances to the k nearest points, in the unit of the coordinates.

        queries (M, 3); k = 1 gives arrays (M,), k > 1 gives (M, k) sorted by (distance, index). Raises InputError when
        k exceeds the number of points.
        """
        wanted = _as_points(queries, "queries")
        if not 1 <= k <= len(self):
            raise InputError(f"k: expected 1 to {len(self)} (the number of points), got {k}")
        shape = (len(wanted),) if k == 1 else (len(wanted), k)
        found = Matches(np.empty(shape, np.float64), np.empty(shape, np.int64))
        try:
            if k == 1:
                self._tree.nearest(wanted, *found)
            else:
                self._tree.knearest(wanted, *found)
        except ValueError as error:
            _explain(error, wanted, "queries")
        return found

    def query_radius(self, queries: ArrayLike, radius: float) -> Neighborhoods:
        """The points whose squared distance to each query (M, 3) is at most radius * radius."""
        wanted = _as_points(queries, "queries")
        _check_length(radius, "radius")
        try:
            return Neighborhoods(*self._tree.in_balls(wanted, radius))
        except ValueError as error:
            _explain(error, wanted, "queries")

    def query_cylinder(self, origins: ArrayLike, axes: ArrayLike, radius: float, half_length: float) -> Neighborhoods:
        """The points p in a cylinder around each origin (M, 3) along its unit axis (M, 3).

        With d = p - origin: |d . axis| <= half_length and |d - (d . axis) axis| <= radius.
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
            _explain(error, centers, "origins")

    def nearest_other(self) -> Matches:
        """Distance from each indexed point to its nearest other point (another index; a duplicate is at distance 0)."""
        if len(self) < 2:
            raise InputError("nearest_other: expected an index of at least two points, got one")
        return self.nearest_of(self)

    def local_planes(self, k: int, rows: ArrayLike | None = None) -> LocalPlanes:
        """The plane through the k nearest points of each point, itself included, or of those in `rows` (M,)."""
        if not 3 <= k <= len(self):
            raise InputError(f"k: expected 3 to {len(self)} (the number of points), got {k}")
        chosen = None if rows is None else self._as_rows(rows, "rows")
        count = len(self) if chosen is None else len(chosen)
        fits = LocalPlanes(
            np.empty((count, 3)), np.empty(count), Matches(np.empty(count), np.empty(count, dtype=np.int64))
        )
        self._tree.planes(k, chosen, fits.normals, fits.variation, *fits.nearest_other)
        return fits

    def nearest_of(self, queries: "Index") -> Matches:
        """The nearest point of each point of another index: `query`, but about a third faster, as they are sorted."""
        found = Matches(np.empty(len(queries), np.float64), np.empty(len(queries), np.int64))
        self._tree.nearest_of(queries._tree, *found)
        return found

    def nearest_of_with_ties(self, queries: "Index", slack: float) -> tuple[Matches, NDArray[np.bool_]]:
        """`nearest_of`, and whether another point is about as near: squared distance less the match's < slack (M,).

        slack is in squared units; 0 finds none.
        """
        if not 0 <= slack <= MAX_COORDINATE**2:
            raise InputError(f"slack: expected a finite squared length of at least 0, got {slack}")
        found = Matches(np.empty(len(queries), np.float64), np.empty(len(queries), np.int64))
        tied = np.empty(len(queries), np.bool_)
        self._tree.nearest_of(queries._tree, *found, slack, tied)
        return found, tied

    def nearest_of_moved(
        self, queries: "Index", motion: NDArray[np.float64], hint: NDArray[np.int64] | None = None
    ) -> tuple[NDArray[np.float64], Matches]:
        """The points of another index after a motion (3, 4) or (4, 4), and the nearest point of each: one ICP step.

        Points that were near each other still are, so nothing is sorted again. `hint` (M,) holds an index near each
        answer, such as the answer before a small motion: it never changes the result.
        """
        moved, found = np.empty((len(queries), 3)), Matches(np.empty(len(queries)), np.empty(len(queries), np.int64))
        rows = np.ascontiguousarray(motion[:3], np.float64)
        hint = None if hint is None else self._as_rows(hint, "hint")
        if hint is not None and len(hint) != len(queries):
            raise InputError(f"hint: expected one index for each of the {len(queries)} queries, got {len(hint)}")
        try:
            self._tree.nearest_of_moved(queries._tree, rows, hint, moved, *found)
        except ValueError as error:
            _explain(error, moved, "queries")
        return moved, found

    def _as_rows(self, values: ArrayLike, name: str) -> NDArray[np.int64]:
        rows: NDArray[Any] = np.asarray(values)
        if rows.ndim != 1 or (len(rows) and rows.dtype.kind not in "iu"):
            raise InputError(f"{name}: expected indices of shape (M,), got {rows.dtype} {rows.shape}")
        if len(rows) and not (rows.min() >= 0 and rows.max() < len(self)):
            raise InputError(f"{name}: expected indices from 0 to {len(self) - 1}, got {rows.min()} to {rows.max()}")
        return np.ascontiguousarray(rows, np.int64)


def match_both_ways(reference: Index, candidate: Index) -> tuple[Matches, Matches]:
    """Nearest distances in both directions: candidate -> reference, then reference -> candidate.

    The queries come from the other tree, where they are sorted in space already: cheaper than two calls of `query`.
    """
    if reference is candidate:
        itself = reference.query(reference.points)
        return itself, itself
    return reference.nearest_of(candidate), candidate.nearest_of(reference)


def median_spacing(index: Index, nearest_other: Matches | None = None) -> float:
    """Median distance from a point to the nearest point in another place; 0 where all points lie in one place.

    This is what "spacing" means everywhere in pcbench. A duplicate is no neighbour: the spacing of a cloud that was
    merged with itself is that of either copy. Points that are there more than seven times do not count.

    Args:
        nearest_other: of every point, where it is known already (`Index.nearest_other`): the median is then of all
            points, otherwise of an even sample of about 20,000.
    """
    if len(index) < 2:
        return 0.0
    if nearest_other is None:
        found = _nearest_elsewhere(index, np.arange(0, len(index), max(1, len(index) // _SPACING_SAMPLE)))
    else:
        found = nearest_other.distances
        doubled = np.flatnonzero(found == 0)
        if len(doubled):
            found = np.concatenate([found[found > 0], _nearest_elsewhere(index, doubled)])
    return float(np.median(found)) if len(found) else 0.0


def _nearest_elsewhere(index: Index, rows: NDArray[np.int64]) -> NDArray[np.float64]:
    """Distances of points to the nearest that is no duplicate, without those that have none among their nearest."""
    distances = index.query(index.points[rows], k=min(_MAX_DUPLICATES, len(index))).distances
    other = np.where(distances > 0, distances, np.inf).min(axis=1)
    found: NDArray[np.float64] = other[np.isfinite(other)]
    return found


def _as_points(values: ArrayLike, name: str) -> NDArray[np.float64]:
    array: NDArray[Any] = np.asarray(values)
    if array.ndim != 2 or array.shape[1] != 3 or array.dtype.kind not in "fiu":
        raise InputError(f"{name}: expected real numbers of shape (N, 3), got {array.dtype} {array.shape}")
    return np.ascontiguousarray(array, np.float64)


def _check_length(value: float, name: str) -> None:
    if not 0 <= value <= MAX_COORDINATE:
        raise InputError(f"{name}: expected a finite length of 0 to {MAX_COORDINATE:g}, got {value}")


def _explain(error: ValueError, rows: NDArray[np.float64], name: str) -> NoReturn:
    """The kernels check coordinates as they read them; which one is wrong is only looked up when one is."""
    wrong = ~(np.abs(rows) <= MAX_COORDINATE)
    if not wrong.any():
        raise error
    row = int(np.argmax(wrong.any(axis=1)))
    expected = f"expected finite coordinates of at most {MAX_COORDINATE:g}"
    raise InputError(f"{name}: {expected}, got {rows[row].tolist()} in row {row}; remove such points first") from error
