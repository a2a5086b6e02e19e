"""Named sets of definitions, locked: what another tool or paper would have printed for the same aligned pair.

All of them compare whole clouds that were cropped hard: both lose what lies outside the region.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench import metrics
from pcbench.neighbors import FloatArray, Index, IntArray, Matches
from pcbench.voxels import cell_means

NAMES = ("gao2025", "mpeg", "open3d", "pdal", "tnt")

_TIE = 1e-8  # pc_error takes squared distances this close as equal
_MOST_TIES = 30


class Side(NamedTuple):
    """One hard-cropped cloud and its two nearest neighbours in the other: (N, 2), nearest first."""

    points: FloatArray
    matches: Matches

    @property
    def distances(self) -> FloatArray:
        return self.matches.distances[:, 0]

    @property
    def indices(self) -> IntArray:
        return self.matches.indices[:, 0]


class Pair(NamedTuple):
    """Reference and candidate after a hard crop."""

    reference: Side
    candidate: Side
    normals: FloatArray | None  # (N, 3) of the reference, unit length
    raw_normals: FloatArray | None  # the same as they were given, where they were


def two_nearest(index: Index, queries: FloatArray) -> Matches:
    """The nearest and the second nearest point of each query, (N, 2); where there is one point only, Inf and 0."""
    if len(index) >= 2:
        return index.query(queries, k=2)
    matches = index.query(queries)
    return Matches(
        np.stack([matches.distances, np.full(len(queries), np.inf)], axis=1),
        np.stack([matches.indices, np.zeros(len(queries), np.int64)], axis=1),
    )


def crop_matches(queries: FloatArray, matches: Matches, points: FloatArray, kept: NDArray[np.bool_]) -> Matches:
    """Matches (N, 2) of queries against all `points`, as they are when only the `kept` points exist."""
    if kept.all():
        return matches
    inside = kept[matches.indices].all(axis=1)
    number = np.cumsum(kept) - 1
    distances, indices = matches.distances.copy(), number[matches.indices]
    if not inside.all():  # only queries near the cut have lost a neighbour
        again = two_nearest(Index(points[kept]), queries[~inside])
        distances[~inside], indices[~inside] = again
    return Matches(distances, indices)


def gao2025(pair: Pair, to_poisson: FloatArray | None = None) -> dict[str, Any]:
    """Gao et al. 2025, table 2, on one consistent reading of its definitions.

    D1 and D2 are one way, candidate to reference, mean squares; the Hausdorff distance is symmetric and unsquared;
    Chamfer is the sum of both mean squares. The paper's "point to surface" is read in two ways, both named: `d2_mse` to
    tangent planes of the reference, `d2_poisson_mse` to its Poisson mesh (None unless that was asked for).
    """
    a, b = pair.candidate, pair.reference
    d2 = None
    if pair.normals is not None:
        d2 = metrics.mean_square(metrics.plane_distances(a.points, b.points[a.indices], pair.normals[a.indices]))
    return {
        "d1_mse": metrics.mean_square(a.distances),
        "d2_mse": d2,
        "d2_poisson_mse": None if to_poisson is None else metrics.mean_square(to_poisson),
        "hausdorff": metrics.hausdorff(a.distances, b.distances),
        "chamfer": metrics.chamfer_squared(a.distances, b.distances),
    }


def open3d(pair: Pair, thresholds: tuple[float, ...]) -> dict[str, Any]:
    """What Open3D's `t.geometry.PointCloud.compute_metrics` returns: unsquared Chamfer sum, Hausdorff, F-scores."""
    a, b = pair.candidate.distances, pair.reference.distances
    return {
        "chamfer": metrics.chamfer_unsquared(a, b),
        "hausdorff": metrics.hausdorff(a, b),
        "fscore": [metrics.fscore(a, b, threshold)._asdict() for threshold in thresholds],
    }


def pdal(pair: Pair) -> dict[str, Any]:
    """What `pdal chamfer` and `pdal hausdorff` print: the SUM of squares both ways, and the largest distance."""
    a, b = pair.candidate.distances, pair.reference.distances
    return {
        "chamfer": float(np.sum(np.square(a))) + float(np.sum(np.square(b))),
        "hausdorff": metrics.hausdorff(a, b),
    }


def tnt(pair: Pair, thresholds: tuple[float, ...]) -> dict[str, Any]:
    """F-scores as in Tanks and Temples (Knapitsch et al. 2017): after cropping (give the selection volume as the crop),
    both clouds are thinned to one mean point a voxel of half the threshold.
    """
    rows = []
    for threshold in thresholds:
        reference, candidate = (_voxel_down(side.points, threshold / 2) for side in (pair.reference, pair.candidate))
        a, b = Index(reference).query(candidate).distances, Index(candidate).query(reference).distances
        rows.append(metrics.fscore(a, b, threshold)._asdict())
    return {"fscore": rows}


def _voxel_down(points: FloatArray, side: float) -> FloatArray:
    # The grid begins half a voxel below the lowest corner, as in Open3D, which the benchmark's code calls.
    return cell_means(points, side, points.min(axis=0) - side / 2)


def mpeg(pair: Pair, peak: float) -> dict[str, Any]:
    """MPEG's pc_error (mpeg-pcc-dmetric 0.14.2), a = reference, b = candidate; Hausdorff distances are SQUARED.

    Duplicate points are merged first. D2 takes the target's normals; the candidate's are averaged from the
    reference's, neither oriented nor scaled to length one again. Ties are averaged. Coordinate differences are rounded
    to float32 as in pc_error, for its printed digits; the coordinates are not, where its float32 loses up to several
    per cent at UTM offsets.
    """
    pair = _merge_duplicates(pair)
    a, b = pair.reference, pair.candidate
    d1 = [_float32_squares(a.points, b.points[a.indices]), _float32_squares(b.points, a.points[b.indices])]
    d2: list[FloatArray] = []
    if pair.raw_normals is not None:
        ties_ab, ties_ba = _ties(a, b.points), _ties(b, a.points)
        normals_b = _averaged_normals(pair.raw_normals, ties_ab, ties_ba, len(b.points))
        d2 = [
            _tied_plane_squares(a.points, b.points, normals_b, ties_ab),
            _tied_plane_squares(b.points, a.points, pair.raw_normals, ties_ba),
        ]

    def both_ways(squares: list[FloatArray]) -> dict[str, float | None]:
        if not squares:
            return {"a_to_b": None, "b_to_a": None, "symmetric": None}
        forth, back = (float(np.mean(s)) for s in squares)
        return {"a_to_b": forth, "b_to_a": back, "symmetric": max(forth, back)}

    d1_mse, d2_mse = both_ways(d1), both_ways(d2)
    return {
        "d1_mse": d1_mse,
        "d2_mse": d2_mse,
        "d1_psnr": metrics.psnr(d1_mse["symmetric"] or 0.0, peak),
        "d2_psnr": metrics.psnr(d2_mse["symmetric"] or 0.0, peak),
        "hausdorff_squared_d1": max(float(s.max()) for s in d1),
        "hausdorff_squared_d2": max((float(s.max()) for s in d2), default=None),
        "peak": peak,
    }


def _float32_squares(queries: FloatArray, feet: FloatArray) -> FloatArray:
    """Squared distances (N,) from differences that were rounded to float32."""
    difference = (queries - feet).astype(np.float32).astype(np.float64)
    squares: FloatArray = np.einsum("ni,ni->n", difference, difference)
    return squares


class _Ties(NamedTuple):
    """All nearest points of every query: parallel lists of query rows and point indices."""

    rows: IntArray
    indices: IntArray


def _ties(side: Side, others: FloatArray) -> _Ties:
    squared = np.square(side.matches.distances)
    tied = np.flatnonzero(squared[:, 1] - squared[:, 0] < _TIE)
    single = np.ones(len(squared), dtype=bool)
    single[tied] = False
    rows, indices = np.flatnonzero(single), side.indices[single]
    if len(tied):
        found = Index(others).query(side.points[tied], k=min(_MOST_TIES, len(others)))
        near = np.square(found.distances)
        which, column = np.nonzero(near - near[:, :1] < _TIE)
        rows = np.concatenate([rows, tied[which]])
        indices = np.concatenate([indices, found.indices[which, column]])
    return _Ties(rows, indices)


def _averaged_normals(normals_a: FloatArray, ab: _Ties, ba: _Ties, count: int) -> FloatArray:
    """Each b point's mean of the normals of the a points that chose it; if none did, of the a points nearest to it."""
    result = _row_means(normals_a[ab.rows], ab.indices, count)
    nearest = _row_means(normals_a[ba.indices], ba.rows, count)
    chosen = np.bincount(ab.indices, minlength=count) > 0
    return np.where(chosen[:, None], result, nearest)


def _tied_plane_squares(queries: FloatArray, others: FloatArray, normals: FloatArray, ties: _Ties) -> FloatArray:
    distances = metrics.plane_distances(queries[ties.rows], others[ties.indices], normals[ties.indices])
    return _row_means(np.square(distances)[:, None], ties.rows, len(queries))[:, 0]


def _row_means(values: FloatArray, rows: IntArray, count: int) -> FloatArray:
    """Mean (count, C) of the values (M, C) that belong to each row; 0 where none does."""
    number = np.maximum(np.bincount(rows, minlength=count), 1)
    return np.stack([np.bincount(rows, column, minlength=count) / number for column in values.T], axis=1)


def _merge_duplicates(pair: Pair) -> Pair:
    if not (_has_duplicates(pair.reference.points) or _has_duplicates(pair.candidate.points)):
        return pair
    reference, first = np.unique(pair.reference.points, axis=0, return_index=True)
    candidate = np.unique(pair.candidate.points, axis=0)
    return Pair(
        Side(reference, two_nearest(Index(candidate), reference)),
        Side(candidate, two_nearest(Index(reference), candidate)),
        None if pair.normals is None else pair.normals[first],
        None if pair.raw_normals is None else pair.raw_normals[first],
    )


def _has_duplicates(points: FloatArray) -> bool:
    """Whether two points agree in all bits; rarely says so of points that do not (a 64-bit hash each)."""
    bits = (points + 0.0).view(np.uint64)  # + 0.0: the two zeros become one
    key = bits[:, 0] * np.uint64(0x9E3779B97F4A7C15)
    key ^= (bits[:, 1] + np.uint64(0x7F4A7C15)) * np.uint64(0xC2B2AE3D27D4EB4F)
    key ^= key >> np.uint64(29)
    key ^= bits[:, 2] * np.uint64(0x165667B19E3779F9)
    key.sort()
    return bool((key[1:] == key[:-1]).any())
