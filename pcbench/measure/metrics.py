"""Distances between clouds as numbers: pure functions of one-way distances.

Let a be the distances candidate -> reference and b those reference -> candidate (each to the nearest point of the
whole other cloud). A bare "Chamfer distance" means nothing: every function names its variant.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pcbench.errors import InputError
from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.voxels import Cells
from pcbench.native import _core

NORMAL_MAD = 1.4826  # the standard deviation of a normal distribution over its median absolute deviation


class Distances(NamedTuple):
    """Of each query of one direction (M,): to the nearest point, and signed to tangent planes of the reference."""

    to_points: FloatArray
    to_planes: FloatArray | None  # None without normals


class FScore(NamedTuple):
    """Shares in [0, 1] at one threshold (in the clouds' unit)."""

    threshold: float
    precision: float
    recall: float
    fscore: float


def plane_distances(
    queries: FloatArray,
    closest: FloatArray,
    normals: FloatArray,
    *,
    query_rows: IntArray | None = None,
    closest_rows: IntArray | None = None,
    normal_rows: IntArray | None = None,
) -> FloatArray:
    """Signed distances (M,) of queries (M, 3) to tangent planes, along unit normals (M, 3) at closest points (M, 3).

    Each array is taken in order, or by rows (M,) into it: then none of it is copied.
    """
    distances = np.empty(len(queries) if query_rows is None else len(query_rows))
    arrays = [np.ascontiguousarray(array, np.float64) for array in (queries, closest, normals)]
    _core.plane_distances(arrays[0], query_rows, arrays[1], closest_rows, arrays[2], normal_rows, distances)
    return distances


def mean_square(distances: FloatArray) -> float:
    """Mean of the squares, in squared units: D1 of point-to-point, D2 of point-to-plane distances, one way.

    D1 and D2 as in Tian et al. 2017, eqs. 1-4 (MPEG's p2point and p2plane) before the maximum over directions.
    """
    _check_distances(distances)
    return float(np.mean(np.square(distances)))


def hausdorff(a: FloatArray, b: FloatArray) -> float:
    """Symmetric Hausdorff distance max(max a, max b), unsquared."""
    return max(one_way_hausdorff(a), one_way_hausdorff(b))


def one_way_hausdorff(distances: FloatArray) -> float:
    """Largest one-way distance."""
    _check_distances(distances)
    return float(distances.max())


def chamfer_unsquared(a: FloatArray, b: FloatArray) -> float:
    """mean a + mean b, in the clouds' unit (Open3D, point-cloud-utils)."""
    _check_distances(a)
    _check_distances(b)
    return float(np.mean(a)) + float(np.mean(b))


def chamfer_squared(a: FloatArray, b: FloatArray) -> float:
    """mean a^2 + mean b^2, in squared units (Fan et al. 2017 with means; most learning papers; `gao2025`)."""
    return mean_square(a) + mean_square(b)


def fscore(a: FloatArray, b: FloatArray, threshold: float) -> FScore:
    """Precision = share of a <= threshold, recall = share of b <= threshold, and their harmonic mean.

    Knapitsch et al. 2017 (Tanks and Temples), eqs. 1-5.
    """
    _check_distances(a)
    _check_distances(b)
    if not threshold > 0:
        raise InputError(f"expected a positive threshold, got {threshold}")
    precision, recall = float(np.mean(a <= threshold)), float(np.mean(b <= threshold))
    return FScore(threshold, precision, recall, harmonic_mean(precision, recall))


def harmonic_mean(precision: float, recall: float) -> float:
    """2pr / (p + r), 0 where both are 0."""
    return 2 * precision * recall / (precision + recall) if precision + recall > 0 else 0.0


def percentiles(distances: FloatArray, ranks: tuple[float, ...] = (5, 25, 50, 75, 90, 95, 99)) -> dict[str, float]:
    """Percentiles of one-way distances, as {"p5": ...}; linear interpolation between order statistics."""
    _check_distances(distances)
    return {f"p{rank:g}": float(v) for rank, v in zip(ranks, np.percentile(distances, ranks), strict=True)}


def nmad(values: FloatArray) -> float:
    """Normalised median absolute deviation of values (N,), in their unit: 1.4826 median |v - median v|.

    The standard deviation where errors are normal, and hardly moved by outliers where they are not: what Höhle & Höhle
    2009 ("Accuracy assessment of digital elevation models by means of robust statistical methods", ISPRS Journal 64)
    recommend to report beside it.
    """
    _check_distances(values)
    return NORMAL_MAD * float(np.median(np.abs(values - np.median(values))))


def area_weighted_mean(values: FloatArray, voxels: Cells) -> float:
    """Mean over occupied voxels of the voxel's mean of `values` (N,), so that a dense centre does not decide alone."""
    _check_distances(values)
    return float(np.mean(voxels.means(values)))


def psnr(mse: float, peak: float, factor: float = 3.0) -> float | None:
    """10 log10(factor peak^2 / mse) in dB (MPEG: factor 3 for geometry); None where it does not exist."""
    return float(10 * np.log10(factor * peak**2 / mse)) if 0 < mse < np.inf and peak > 0 else None


def _check_distances(distances: FloatArray) -> None:
    if np.ndim(distances) != 1:
        hint = ": pcbench.compare takes points" if np.ndim(distances) == 2 and np.shape(distances)[1] == 3 else ""
        raise InputError(f"expected one-way distances of shape (N,), got {np.shape(distances)}{hint}")
    if not len(distances):
        raise InputError("expected at least one distance, got none")
