"""Metrics of one-way distances, and of two clouds, as pure functions.

Let a be the distances candidate -> reference and b those reference -> candidate (each to the nearest point of the
complete other cloud). "Chamfer distance" alone is ambiguous: each function names its variant.

`chamfer_unsquared(a, b)` takes such distances, (N,) and (M,). `chamfer_unsquared_between(candidate, reference)` takes
the clouds themselves, and so does each function with that suffix. Nothing is registered, cropped or weighted: use
`pcbench.compare` for that.
"""

from __future__ import annotations

from collections.abc import Iterable
from os import PathLike
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from pcbench.errors import InputError
from pcbench.geometry import order_statistics
from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.cloud import Cloud, as_cloud
from pcbench.geometry.neighbors import Index, match_both_directions
from pcbench.geometry.voxels import Cells
from pcbench.measure.plane_sample import PlaneSample
from pcbench.native import _core

Points = Cloud | ArrayLike | str | PathLike[str]  # a cloud, its points (N, 3), or the path of its file
PERCENTILE_RANKS = (5.0, 25.0, 50.0, 75.0, 90.0, 95.0, 99.0)
_Named = TypeVar("_Named")


class Distances(NamedTuple):
    """Distances of the queries of one direction (M,): to the nearest point, and signed to the reference's planes."""

    to_points: FloatArray
    to_planes: FloatArray | PlaneSample | None  # None without normals

    @property
    def plane_squares(self) -> FloatArray | None:
        """Squared distances (M,) to planes, or values with the same expected means if they were sampled."""
        if isinstance(self.to_planes, PlaneSample):
            return self.to_planes.squares()
        return None if self.to_planes is None else np.square(self.to_planes)


class FScore(NamedTuple):
    """Precision, recall and F-score in [0, 1] at one distance threshold (in the clouds' unit)."""

    threshold: float
    precision: float
    recall: float
    fscore: float


def split_thresholds(metrics: Iterable[_Named]) -> tuple[tuple[_Named, ...], tuple[float, ...]]:
    """Return the metrics without those named `fscore@T`, `precision@T` or `recall@T`, and the thresholds T of these.

    Raises:
        InputError: a threshold is not a length above 0.
    """
    others, thresholds = list[_Named](), list[float]()
    for metric in metrics:
        name, separator, text = metric.partition("@") if isinstance(metric, str) else ("", "", "")
        if separator and name in FScore._fields[1:]:
            thresholds.append(_named_threshold(name, text))
        else:
            others.append(metric)
    return tuple(others), tuple(dict.fromkeys(thresholds))


def plane_distances(
    queries: FloatArray,
    closest: FloatArray,
    normals: FloatArray,
    *,
    query_rows: IntArray | None = None,
    closest_rows: IntArray | None = None,
    normal_rows: IntArray | None = None,
) -> FloatArray:
    """Compute signed distances (M,) of queries to tangent planes along unit normals at the closest points.

    Args:
        queries: (M, 3) queries, or any number with `query_rows`.
        closest: (M, 3) closest points, or any number with `closest_rows`.
        normals: (M, 3) unit normals, or any number with `normal_rows`.
        query_rows: (M,) rows into `queries`; None: all in order. Rows avoid copies.
        closest_rows: (M,) rows into `closest`; None: all in order.
        normal_rows: (M,) rows into `normals`; None: all in order.
    """
    distances = np.empty(len(queries) if query_rows is None else len(query_rows))
    arrays = [np.ascontiguousarray(array, np.float64) for array in (queries, closest, normals)]
    _core.plane_distances(arrays[0], query_rows, arrays[1], closest_rows, arrays[2], normal_rows, distances)
    return distances


def mean_square(distances: ArrayLike) -> float:
    """Mean of the squares, in squared units: D1 of point-to-point, D2 of point-to-plane distances, in one direction.

    D1 and D2 as in Tian et al. 2017, eqs. 1-4 (MPEG's p2point and p2plane) before the maximum over directions.
    """
    return float(np.mean(np.square(_distances(distances, "mean_square"))))


def hausdorff(a: ArrayLike, b: ArrayLike) -> float:
    """Symmetric Hausdorff distance max(max a, max b), unsquared."""
    return max(float(_check_unsigned(each, "hausdorff").max()) for each in (a, b))


def one_way_hausdorff(distances: ArrayLike) -> float:
    """Largest one-way distance, in the clouds' unit."""
    return float(_check_unsigned(distances, "one_way_hausdorff").max())


def chamfer_unsquared(a: ArrayLike, b: ArrayLike) -> float:
    """Sum of the mean distances, mean a + mean b, in the clouds' unit (Open3D, point-cloud-utils)."""
    forth, back = (float(np.mean(_check_unsigned(each, "chamfer_unsquared"))) for each in (a, b))
    return forth + back


def chamfer_squared(a: ArrayLike, b: ArrayLike) -> float:
    """Sum of the mean squares, mean a^2 + mean b^2, in squared units (Fan et al. 2017 with means; `gao2025`)."""
    forth, back = (float(np.mean(np.square(_distances(each, "chamfer_squared")))) for each in (a, b))
    return forth + back


def fscore(a: ArrayLike, b: ArrayLike, threshold: float) -> FScore:
    """Precision (share of a <= threshold), recall (share of b <= threshold), and their harmonic mean.

    Knapitsch et al. 2017 (Tanks and Temples), eqs. 1-5.
    """
    forth, back = (_check_unsigned(each, "fscore", ", threshold") for each in (a, b))
    if not threshold > 0:
        raise InputError(f"expected a positive threshold, got {threshold}")
    precision, recall = float(np.mean(forth <= threshold)), float(np.mean(back <= threshold))
    return FScore(threshold, precision, recall, harmonic_mean(precision, recall))


def harmonic_mean(precision: float, recall: float) -> float:
    """Harmonic mean 2pr / (p + r); 0 if both are 0."""
    return 2 * precision * recall / (precision + recall) if precision + recall > 0 else 0.0


def percentiles(distances: ArrayLike, ranks: tuple[float, ...] = PERCENTILE_RANKS) -> dict[str, float]:
    """Percentiles of one-way distances, as {"p5": ...}, with linear interpolation between order statistics."""
    values = _distances(distances, "percentiles")
    values_at_ranks = order_statistics.percentiles(values, ranks)
    return {f"p{rank:g}": float(v) for rank, v in zip(ranks, values_at_ranks, strict=True)}


def nmad(values: ArrayLike) -> float:
    """Normalised median absolute deviation of values (N,), in their unit: 1.4826 median |v - median v|.

    It equals the standard deviation if errors are normal, and is robust against outliers. Höhle & Höhle 2009 ("Accuracy
    assessment of digital elevation models by means of robust statistical methods", ISPRS Journal 64) recommend it
    beside the standard deviation.
    """
    numbers = _distances(values, None)
    return order_statistics.NORMAL_MAD * order_statistics.median_distance(numbers, order_statistics.median(numbers))


def area_weighted_mean(values: ArrayLike, voxels: Cells) -> float:
    """Mean over occupied voxels of the mean of `values` (N,) in each voxel, so that dense areas do not dominate."""
    numbers = _distances(values, None)
    if len(numbers) != len(voxels.of_point):
        raise InputError(f"expected a value for each of {len(voxels.of_point)} points, got {len(numbers)}")
    return float(np.mean(voxels.means(numbers)))


def distances_between(candidate: Points, reference: Points) -> tuple[FloatArray, FloatArray]:
    """Distances a (N,) from each candidate point to the nearest reference point, and b (M,) in the other direction.

    Large coordinates lose no precision.

    Args:
        candidate: a cloud, an (N, 3) array, or the path of a file that `pcbench.read_cloud` reads.
        reference: the same.

    Raises:
        InputError: an argument is not a cloud.
    """
    points = _points(reference)
    origin = np.floor(points.mean(axis=0))  # far from zero, squared coordinates would exceed the precision
    forth, back = match_both_directions(Index(points - origin), Index(_points(candidate) - origin))
    return forth.distances, back.distances


def mean_square_between(candidate: Points, reference: Points) -> float:
    """D1 candidate -> reference: `mean_square` of the one-way distances; clouds as for `distances_between`."""
    return mean_square(_one_way(candidate, reference))


def one_way_hausdorff_between(candidate: Points, reference: Points) -> float:
    """Largest distance candidate -> reference; clouds as for `distances_between`."""
    return one_way_hausdorff(_one_way(candidate, reference))


def percentiles_between(
    candidate: Points, reference: Points, ranks: tuple[float, ...] = PERCENTILE_RANKS
) -> dict[str, float]:
    """`percentiles` of the distances candidate -> reference; clouds as for `distances_between`."""
    return percentiles(_one_way(candidate, reference), ranks)


def hausdorff_between(candidate: Points, reference: Points) -> float:
    """`hausdorff` of two clouds, symmetric; clouds as for `distances_between`."""
    return hausdorff(*distances_between(candidate, reference))


def chamfer_unsquared_between(candidate: Points, reference: Points) -> float:
    """`chamfer_unsquared` of two clouds, symmetric; clouds as for `distances_between`."""
    return chamfer_unsquared(*distances_between(candidate, reference))


def chamfer_squared_between(candidate: Points, reference: Points) -> float:
    """`chamfer_squared` of two clouds, symmetric; clouds as for `distances_between`."""
    return chamfer_squared(*distances_between(candidate, reference))


def fscore_between(candidate: Points, reference: Points, threshold: float) -> FScore:
    """`fscore` of two clouds at one threshold; clouds as for `distances_between`."""
    return fscore(*distances_between(candidate, reference), threshold)


def psnr(mse: float, peak: float, factor: float = 3.0) -> float | None:
    """Peak signal-to-noise ratio 10 log10(factor peak^2 / mse) in dB (MPEG: factor 3); None if undefined."""
    return float(10 * np.log10(factor * peak**2 / mse)) if 0 < mse < np.inf and peak > 0 else None


def _named_threshold(name: str, text: str) -> float:
    try:
        threshold = float(text)
    except ValueError:
        threshold = np.nan
    if not 0 < threshold < np.inf:
        raise InputError(f"expected a length above 0 behind {name}@, such as {name}@0.05, got {name + '@' + text!r}")
    return threshold


def _one_way(candidate: Points, reference: Points) -> FloatArray:
    points = _points(reference)
    origin = np.floor(points.mean(axis=0))
    return Index(points - origin).query(_points(candidate) - origin).distances


def _points(given: Points) -> FloatArray:
    if isinstance(given, str | PathLike):
        from pcbench.io import read_cloud  # its readers are not needed for arrays

        return read_cloud(given).points
    return as_cloud(given).points


def _distances(given: ArrayLike, name: str | None, further: str = "") -> FloatArray:
    """Return distances (N,) as float64; points are refused with a hint to the function that takes them."""
    values = np.asarray(given, dtype=np.float64)
    if values.ndim != 1:
        hint = ""
        if name is not None and values.ndim == 2 and values.shape[1] == 3:
            hint = f": for points, metrics.{name}_between(candidate, reference{further})"
        raise InputError(f"expected one-way distances of shape (N,), got {values.shape}{hint}")
    if not len(values):
        raise InputError("expected at least one distance, got none")
    if bad := int(np.count_nonzero(np.isnan(values))):
        raise InputError(f"expected distances, got NaN in {bad} of {len(values)}")
    return values


def _check_unsigned(given: ArrayLike, name: str, further: str = "") -> FloatArray:
    """Return distances (N,) as float64; signed ones are refused, because they would cancel."""
    values = _distances(given, name, further)
    if bad := int(np.count_nonzero(values < 0)):
        raise InputError(f"expected unsigned distances, got {bad} of {len(values)} below 0: take np.abs of them")
    return values
