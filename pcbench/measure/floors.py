"""Sampling floors: what independent, error-free points of the same surface would score, in either direction.

A point of the searched cloud, searched for among the others, stands for such a point: given one point of a Poisson
process, the others lie as if it were not there (Slivnyak 1962), on curved surfaces, at edges, at borders and in volumes
alike. Which point stands for a query matters. The nearest one has more room around it than most: its squared distance
comes out 1.38 times too large on a plane, that of the fourth nearest 1.01 times.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.neighbors import Index
from pcbench.geometry.normals import plane_normals
from pcbench.measure.metrics import Distances, plane_distances
from pcbench.measure.reference import Reference

_MAX_QUERIES = 2_500  # an even sample: the mean of as many squared distances is right to 2 %
_STANDS = 4  # the nearest, the second nearest, ...: which point of the searched cloud stands for a query
_OTHERS = 8  # of its neighbours are looked at: duplicates are no neighbours, and noise changes their order
_THINNED = 3  # points of the reference for each of a sparse candidate, so that some neighbour is as far away as its are


def to_reference(reference: Reference, queries: FloatArray) -> Distances | None:
    """Of independent points of the surface around the queries (M, 3) to the reference; None where it has one point."""
    if len(reference.points) < 2:
        return None
    rows = _stands_for(reference.index, queries[_even(len(queries))])
    others = _others(reference.index, rows)
    apart = np.linalg.norm(reference.points[others] - reference.points[rows, None], axis=2)
    nearest = _nearest_elsewhere(apart)
    planes = None
    if reference.has_normals:
        closest = _picked(others, nearest)
        normals = _normals_without(reference, closest, _around(reference, closest), rows)
        planes = plane_distances(reference.points, reference.points, normals, query_rows=rows, closest_rows=closest)
    return Distances(_picked(apart, nearest), planes)


def to_candidate(
    reference: Reference, candidate: Index, matches: IntArray, error: float, seed: int
) -> Distances | None:
    """Of the reference's points to an error-free cloud that is as dense as the candidate is around each of them.

    Args:
        candidate: None is returned where it has one point.
        matches: (N,) the reference's point nearest to each point of the candidate; negative where it is not known.
        error: the share, 0 to 1, of the candidate's distances to tangent planes that is error: it is taken off, lest
            noise make the candidate look sparse. Where edges make the distances, that would flatten them.
        seed: of a sample of the reference.
    """
    if len(candidate) < 2:
        return None
    few = _even(len(reference.measured_points))
    rows = few if reference.rows is None else reference.rows[few]
    stands = _stands_for(candidate, reference.points[rows])
    others = _others(candidate, stands)
    places = _on_surface(reference, candidate, others, matches, error)
    apart = np.linalg.norm(places - _on_surface(reference, candidate, stands[:, None], matches, error), axis=2)
    distances = _picked(apart, _nearest_elsewhere(apart))
    if not reference.has_normals:
        return Distances(distances, None)
    return Distances(distances, _off_planes(reference, rows, distances, seed))


def _even(count: int) -> IntArray:
    return np.linspace(0, count - 1, min(count, _MAX_QUERIES)).astype(np.int64)


def _stands_for(index: Index, queries: FloatArray) -> IntArray:
    nearest = index.query(queries, k=min(_STANDS, len(index))).indices.reshape(len(queries), -1)
    return nearest[:, -1].copy()


def _others(index: Index, rows: IntArray) -> IntArray:
    """(M, K) the nearest of the indexed points to some of them, themselves among them."""
    return index.query(index.points[rows], k=min(1 + _OTHERS, len(index))).indices


def _nearest_elsewhere(apart: FloatArray) -> IntArray:
    """(M,) which of the distances (M, K) is the smallest that is not zero."""
    which: IntArray = np.where(apart > 0, apart, np.inf).argmin(axis=1)
    return which


def _picked(values: NDArray[Any], which: IntArray) -> NDArray[Any]:
    picked: NDArray[Any] = np.take_along_axis(values, which[:, None], axis=1)[:, 0]
    return picked


def _on_surface(reference: Reference, candidate: Index, rows: IntArray, matches: IntArray, error: float) -> FloatArray:
    """(..., 3) candidate points, a share of the way along the normals to the reference's tangent planes."""
    places = candidate.points[rows]
    if not (reference.has_normals and error > 0):
        return places
    closest = matches[rows]
    known = closest >= 0
    at = closest[known]
    n = reference.surface.with_normals_at(at)[at]
    places[known] -= error * np.einsum("ni,ni->n", places[known] - reference.points[at], n)[:, None] * n
    return places


def _off_planes(reference: Reference, rows: IntArray, distances: FloatArray, seed: int) -> FloatArray:
    """(M,) how far the surface leaves the tangent planes at the reference's points `rows` (M,) at these distances (M,).

    That of each point's neighbours in the reference tells which is about as far away: in a sample of the reference
    where that is much denser. What is left of the distance is bridged by what all of them show together.
    """
    index, points = reference.index, reference.points
    near = around = _around(reference, rows)
    typical = float(np.median(distances))
    share = _THINNED * (reference.spacing / typical) ** 2 if typical > 0 else 1.0
    if 0 < share < 1:
        some = np.random.default_rng(seed).choice(len(points), max(2, int(share * len(points))), replace=False)
        index = Index(points[some])
        near = index.query(points[rows], k=min(around.shape[1], len(index))).indices
    apart = np.linalg.norm(index.points[near] - points[rows, None], axis=2)
    least = 1e-12 * float(apart.max()) or 1.0
    ratio = np.maximum(apart, least) / np.maximum(distances, least)[:, None]
    which = np.abs(np.log(ratio)).argmin(axis=1)
    closest, found = _picked(near, which), _picked(apart, which)
    normals = _normals_without(reference, rows, around, closest if index is reference.index else None)
    off = plane_distances(points, index.points, normals, query_rows=rows, closest_rows=closest)
    found = np.maximum(found, least)
    slope, curvature = _slope_and_curvature(np.square(off), np.square(found))
    wanted, there = (slope + curvature * np.square(lengths) for lengths in (distances, found))
    bridged: FloatArray = off * distances / found * np.sqrt(wanted / there)
    return bridged


def _slope_and_curvature(squares: FloatArray, lengths: FloatArray) -> tuple[float, float]:
    """a, b >= 0 of `squares` = a `lengths` + b `lengths`^2, both of them squared (M,), by moments."""
    m1, m2, m3 = (float(np.mean(lengths**power)) for power in (1, 2, 3))
    s0, s1 = float(np.mean(squares)), float(np.mean(squares * lengths))
    determinant = m1 * m3 - m2 * m2
    if not determinant > 0:
        return 1.0, 0.0
    slope, curvature = (s0 * m3 - s1 * m2) / determinant, (s1 * m1 - s0 * m2) / determinant
    if curvature <= 0 or s0 == 0:
        return 1.0, 0.0
    return (slope, curvature) if slope > 0 else (0.0, 1.0)


def _around(reference: Reference, rows: IntArray) -> IntArray:
    """(M, k + 1) the neighbours that normals are estimated from, themselves among them, and one more."""
    index = reference.index
    return index.query(reference.points[rows], k=min(1 + reference.surface.k, len(index))).indices


def _normals_without(reference: Reference, rows: IntArray, around: IntArray, others: IntArray | None) -> FloatArray:
    """(M, 3) normals at `rows` (M,), estimated as if the points `others` (M,) were not there: these pull at them.

    On a sphere, their mean square distance to the planes would be 1.3 times too large.
    """
    if others is None or reference.cloud.normals is not None or around.shape[1] <= 3:
        return reference.surface.normals(rows)
    out = around == others[:, None]
    out[~out.any(axis=1), -1] = True
    return plane_normals(reference.points, around[~out].reshape(len(rows), -1)).directions
