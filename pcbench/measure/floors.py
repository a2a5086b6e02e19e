"""Sampling floors: the scores that independent, error-free points of the same surface would get, in either direction.

Leave-one-out: a proxy point of the searched cloud replaces each query and is matched with the remaining points. Given
one point of a Poisson process, the others are distributed as if it did not exist (Slivnyak 1962). This holds on curved
surfaces, at edges, at borders and in volumes. The choice of the proxy matters. The point nearest to the query tends to
have more space around it than most: its mean squared distance is 1.38 times too large on a plane, that of the fourth
nearest point 1.01 times.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.neighbors import Index
from pcbench.geometry.normals import Surface, plane_normals
from pcbench.geometry.quantisation import PlacedQuantisation
from pcbench.geometry.sampling import Sampling, line_gaps
from pcbench.measure.metrics import Distances, plane_distances

_MAX_QUERIES = 2_500  # evenly sampled; the relative standard error of the mean squared distance is then 2 %
_PROXY_RANK = 4  # rank of the nearest neighbour that replaces a query (1: the nearest point)
_MAX_NEIGHBORS = 8  # neighbours considered: duplicates do not count, and noise changes the order
_MIN_VARIANCE_SHARE = 0.1  # of the largest rounding along a normal, for points whose distance from planes shows it
# Reference points kept per point of a sparse candidate: some neighbour is then at a similar distance.
_THINNED_DENSITY_RATIO = 3
_MIN_THINNED_POINTS = 64  # so that a random share of few points has neighbours


@dataclass(frozen=True, eq=False)
class FloorSurface:
    """Surface of a reference, and its properties on which floors depend.

    Attributes:
        surface: its points and normals, in local coordinates.
        spacing: its spacing, see `pcbench.geometry.sampling.median_spacing`.
        rounding: how its coordinates are rounded.
        has_given_normals: whether its normals were given with it.
        seed: random seed.
    """

    surface: Surface
    spacing: float
    rounding: PlacedQuantisation
    has_given_normals: bool
    seed: int

    @property
    def index(self) -> Index:
        """Search index over the points."""
        return self.surface.index

    @property
    def points(self) -> FloatArray:
        """The points to which the numbers of `index` refer (N, 3)."""
        return self.surface.points

    @property
    def has_normals(self) -> bool:
        """Return whether the points have normals or there are enough to estimate them."""
        return self.surface.has_normals


def even_sample(count: int) -> IntArray:
    """Return the rows of the points, of `count`, from which a floor is measured."""
    return np.linspace(0, count - 1, min(count, _MAX_QUERIES)).astype(np.int64)


def to_reference(reference: FloorSurface, queries: FloatArray, rounding: PlacedQuantisation | None) -> Distances | None:
    """Distances of independent points of the surface around the queries (M, 3); None if the reference has one point.

    Args:
        reference: the reference.
        queries: (M, 3) points of the aligned candidate, see `even_sample`.
        rounding: how the candidate's coordinates are rounded; None: rounding is negligible in both clouds.
    """
    if len(reference.index) < 2:
        return None
    sampling = reference.surface.sampling
    rows = _proxies(reference.index, sampling, queries)
    places, others = reference.points[rows], _neighbors(reference.index, sampling, rows)
    if rounding is not None:
        normals = reference.surface.normals(rows) if reference.has_normals else None
        around = reference.points[others].mean(axis=1)
        places = _stored_anew(places, around, normals, reference.rounding, rounding, reference.seed)
        others = _others_near(reference.index, sampling, places, rows)
    separations = np.linalg.norm(reference.points[others] - places[:, None], axis=2)
    is_coarse = rounding is not None and reference.rounding.is_coarse(reference.spacing)
    nearest = _nearest(separations, sampling, keep_coincident=is_coarse)
    planes = None
    if reference.has_normals:
        closest = _take_per_row(others, nearest)
        normals = _leave_one_out_normals(reference, closest, _normal_neighborhoods(reference, closest), rows)
        planes = plane_distances(places, reference.points, normals, closest_rows=closest)
    if sampling.has_lines and not is_coarse:
        distances, shares, gaps = _distances_between_lines(reference.index, rows, reference.seed)
        if planes is not None:
            planes = np.hypot(planes, _offsets_between_lines(reference, rows, gaps) * np.square(shares))
        return Distances(distances, planes)
    return Distances(_take_per_row(separations, nearest), planes)


def to_candidate(
    reference: FloorSurface,
    rows: IntArray,
    candidate: Surface,
    match: Callable[[IntArray], IntArray],
    error: float,
    rounding: PlacedQuantisation | None,
) -> Distances | None:
    """Distances of the reference's points to an error-free cloud with the local density of the candidate.

    Args:
        reference: the reference.
        rows: (M,) rows of points of the reference, see `even_sample`.
        candidate: the aligned candidate; the result is None if it has one point.
        match: function that returns the reference's points nearest to rows of the candidate; negative if unknown.
        error: share, 0 to 1, of the candidate's distances to tangent planes that is error. It is removed, because noise
            would make the candidate look sparse. Distances that are caused by edges must stay.
        rounding: how the candidate's coordinates are rounded; None: rounding is negligible in both clouds.
    """
    if len(candidate) < 2:
        return None
    index, sampling, seed = candidate.index, candidate.sampling, reference.seed
    proxies = _proxies(index, sampling, reference.points[rows])
    others = _neighbors(index, sampling, proxies)
    places = _shrink_to_surface(reference, index, proxies[:, None], match, error)[:, 0]
    if rounding is not None:
        normals = None
        if reference.has_normals:
            normals = reference.surface.normals(reference.index.query(index.points[proxies]).indices)
        around = _shrink_to_surface(reference, index, others, match, error).mean(axis=1)
        places = _stored_anew(places, around, normals, rounding, reference.rounding, seed)
        others = _others_near(index, sampling, places, proxies)
    positions = _shrink_to_surface(reference, index, others, match, error)
    separations = np.linalg.norm(positions - places[:, None], axis=2)
    is_coarse = rounding is not None and reference.rounding.is_coarse(reference.spacing)
    nearest = _nearest(separations, sampling, keep_coincident=is_coarse)
    distances = _take_per_row(separations, nearest)
    if sampling.has_lines and not (rounding is not None and rounding.is_coarse(sampling.spacing)):
        distances = _distances_between_lines(index, proxies, seed)[0]
    if not reference.has_normals:
        return Distances(distances, None)
    return Distances(distances, _plane_offsets(reference, rows, distances, seed, rounding))


def _others_near(index: Index, sampling: Sampling, places: FloatArray, rows: IntArray) -> IntArray:
    """Return (M, K) indexed points nearest to places (M, 3), without the row (M,) that each place stands for."""
    near = index.query(places, k=min(sampling.neighbors(2 + _MAX_NEIGHBORS), len(index))).indices
    is_other = near != rows[:, None]
    is_other[is_other.all(axis=1), -1] = False  # the same number of points in each row
    others: IntArray = near[is_other].reshape(len(rows), -1)
    return others


def _stored_anew(
    places: FloatArray,
    around: FloatArray,
    normals: FloatArray | None,
    own: PlacedQuantisation,
    other: PlacedQuantisation,
    seed: int,
) -> FloatArray:
    """Return points (M, 3) of one cloud as the other cloud would store the same places of the surface.

    Their rounding is undone before they are rounded anew: along the normal they move towards the plane through their
    neighbours, as far as rounding explains their distance from it, and along the surface to random places in their
    cells.

    Args:
        places: (M, 3) points.
        around: (M, 3) means of their neighbours.
        normals: (M, 3) unit normals; None: there are too few points for normals.
        own: how the points are rounded.
        other: how the other cloud is rounded.
        seed: random seed of the places in the cells.
    """
    if normals is not None:
        variances = own.normal_variances(normals)
        off = np.einsum("ni,ni->n", places - around, normals)
        is_rounded = variances > _MIN_VARIANCE_SHARE * variances.max()
        if is_rounded.any() and (typical := float(np.median(np.square(off[is_rounded])))) > 0:
            # The median of the square of a uniform variable is 3/4 of its mean.
            explained = min(1.0, 0.75 * float(np.median(variances[is_rounded])) / typical)
            removed = np.where(is_rounded, (1 - np.sqrt(1 - explained)) * off, 0.0)
            places = places - removed[:, None] * normals
    return other.rounded(own.moved_in_cells(places, normals, seed))


def _proxies(index: Index, sampling: Sampling, queries: FloatArray) -> IntArray:
    k = min(sampling.neighbors(_PROXY_RANK), len(index))
    nearest = index.query(queries, k=k).indices.reshape(len(queries), -1)
    return nearest[:, -1].copy()


def _neighbors(index: Index, sampling: Sampling, rows: IntArray) -> IntArray:
    """Return (M, K) nearest indexed points of the given rows, including the points themselves."""
    return index.query(index.points[rows], k=min(sampling.neighbors(1 + _MAX_NEIGHBORS), len(index))).indices


def _nearest(separations: FloatArray, sampling: Sampling, *, keep_coincident: bool) -> IntArray:
    """Return (M,) the column of the smallest distance to another point in each row of (M, K).

    The point is at another position, unless points may coincide.
    """
    allowed = separations if keep_coincident else np.where(separations > sampling.copy_radius, separations, np.inf)
    which: IntArray = allowed.argmin(axis=1)
    return which


def _distances_between_lines(index: Index, rows: IntArray, seed: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return distances (M,) to the nearest point from random places between the scan lines at the given rows (M,).

    The points of a line are not independent of each other: a point that is left out has neighbours along its line. The
    places, as shares (M,) of the gaps, and the gaps (M, 3) themselves are also returned.
    """
    points = index.points[rows]
    gaps, shares = line_gaps(index, points), np.random.default_rng(seed).uniform(-0.5, 0.5, len(rows))
    return index.query(points + shares[:, None] * gaps).distances, shares, gaps


def _offsets_between_lines(reference: FloorSurface, rows: IntArray, gaps: FloatArray) -> FloatArray:
    """Return distances (M,) of the next scan line to the planes at `rows` (M,), across gaps (M, 3).

    In between, a curved surface leaves the plane with the square of the distance.
    """
    points = reference.points[rows]
    closest = reference.index.query(points + gaps).indices
    normals = reference.surface.normals(rows)
    offsets: FloatArray = np.einsum("ni,ni->n", reference.points[closest] - points, normals)
    return offsets


def _take_per_row(values: NDArray[Any], which: IntArray) -> NDArray[Any]:
    picked: NDArray[Any] = np.take_along_axis(values, which[:, None], axis=1)[:, 0]
    return picked


def _shrink_to_surface(
    reference: FloorSurface, candidate: Index, rows: IntArray, match: Callable[[IntArray], IntArray], error: float
) -> FloatArray:
    """Move candidate points (..., 3) along the normals by a share of their distance to the reference's planes."""
    positions = candidate.points[rows]
    if not (reference.has_normals and error > 0):
        return positions
    closest = match(rows)
    has_match = closest >= 0
    matched = closest[has_match]
    n = reference.surface.normals(matched)
    positions[has_match] -= (
        error * np.einsum("ni,ni->n", positions[has_match] - reference.points[matched], n)[:, None] * n
    )
    return positions


def _plane_offsets(
    reference: FloorSurface, rows: IntArray, distances: FloatArray, seed: int, rounding: PlacedQuantisation | None
) -> FloatArray:
    """Estimate how far the surface leaves the tangent planes at `rows` (M,), at the given distances (M,).

    The estimate uses the neighbour of each point whose distance fits best, in a thinned sample if the reference is much
    denser than the candidate. The remaining ratio of distances is corrected by a model fitted to all points.
    """
    around, points = _normal_neighborhoods(reference, rows), reference.points
    typical = float(np.median(distances))
    share = _THINNED_DENSITY_RATIO * (reference.spacing / typical) ** 2 if typical > 0 else 1.0
    share = max(share, _MIN_THINNED_POINTS / len(reference.index))
    is_thinned = 0 < share < 1
    near = points[around]
    if is_thinned:
        near = reference.index.neighbors_in_share(points[rows], around.shape[1], share, seed)
    separations = np.linalg.norm(near - points[rows, None], axis=2)
    least = 1e-12 * float(separations.max()) or 1.0
    ratio = np.maximum(separations, least) / np.maximum(distances, least)[:, None]
    which = np.abs(np.log(ratio)).argmin(axis=1)
    neighbours, separation = near[np.arange(len(rows)), which], _take_per_row(separations, which)
    normals = _leave_one_out_normals(reference, rows, around, None if is_thinned else _take_per_row(around, which))
    variance = 0.0
    if rounding is not None:
        centers = points[around].mean(axis=1)
        neighbours = _stored_anew(neighbours, centers, normals, reference.rounding, rounding, seed)
        variance = float(np.mean(reference.rounding.normal_variances(normals) + rounding.normal_variances(normals)))
    off = plane_distances(points, neighbours, normals, query_rows=rows)
    separation = np.maximum(separation, least)
    slope, curvature = _slope_and_curvature(np.square(off), np.square(separation))
    wanted, there = (slope + curvature * np.square(lengths) for lengths in (distances, separation))
    factors = np.square(distances / separation) * wanted / there
    if variance > 0:  # it is as large at any distance
        share = min(1.0, variance / max(float(np.mean(np.square(off))), 1e-300))
        factors = (1 - share) * factors + share
    bridged: FloatArray = off * np.sqrt(factors)
    return bridged


def _slope_and_curvature(squares: FloatArray, lengths: FloatArray) -> tuple[float, float]:
    """Fit `squares` = a `lengths` + b `lengths`^2 with a, b >= 0 to squared values (M,), by the method of moments."""
    m1, m2, m3 = (float(np.mean(lengths**power)) for power in (1, 2, 3))
    s0, s1 = float(np.mean(squares)), float(np.mean(squares * lengths))
    determinant = m1 * m3 - m2 * m2
    if not determinant > 0:
        return 1.0, 0.0
    slope, curvature = (s0 * m3 - s1 * m2) / determinant, (s1 * m1 - s0 * m2) / determinant
    if curvature <= 0 or s0 == 0:
        return 1.0, 0.0
    return (slope, curvature) if slope > 0 else (0.0, 1.0)


def _normal_neighborhoods(reference: FloorSurface, rows: IntArray) -> IntArray:
    """Return (M, K) neighbours for normal estimation, including the points themselves, and spares for one position."""
    index, spare = reference.index, reference.surface.sampling.neighbors(1)
    return index.query(reference.points[rows], k=min(reference.surface.k + spare, len(index))).indices


def _leave_one_out_normals(
    reference: FloorSurface, rows: IntArray, around: IntArray, others: IntArray | None
) -> FloatArray:
    """Estimate normals (M, 3) at `rows` (M,) without the points `others` (M,), which would tilt the planes.

    On a sphere, their mean squared distance to the planes would otherwise be 1.3 times too large.
    """
    k = min(reference.surface.k, around.shape[1] - 1)
    if others is None or reference.has_given_normals or k < 3:
        return reference.surface.normals(rows)
    out = around == others[:, None]
    if (sampling := reference.surface.sampling).copy_radius > 0:
        apart = np.linalg.norm(reference.points[around] - reference.points[others, None], axis=2)
        out |= apart <= sampling.copy_radius
    kept = np.sort(np.argsort(out, axis=1, kind="stable")[:, :k], axis=1)
    return plane_normals(reference.points, np.take_along_axis(around, kept, axis=1)).directions
