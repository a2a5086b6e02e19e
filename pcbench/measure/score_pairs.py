"""Metrics of a pair of clouds alone: neither registration nor verdict, for thousands of small pairs.

`score` measures the given coordinates. `pcbench.compare` also registers, estimates sampling floors and intervals, and
says which numbers can be trusted.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, fields
from typing import Any, NamedTuple

import numpy as np

from pcbench.errors import InputError, did_you_mean
from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.neighbors import Index, Matches, match_both_directions
from pcbench.geometry.normals import Surface
from pcbench.geometry.units import check_same_unit
from pcbench.measure import metrics as definitions
from pcbench.measure.metrics import FScore, Points, split_thresholds
from pcbench.native import one_kernel_thread
from pcbench.systems import cpu_count

_PLANE_METRICS = ("d2_mse", "d2_rms")
_NORMAL_NEIGHBORS = 20  # as `Settings.normal_neighbors`
_WAITING_PAIRS = 2  # per thread, so that pairs of an iterator are not all in memory
_Pair = tuple[Points, Points]


class BothWays(NamedTuple):
    """Values of both directions: candidate to reference (accuracy), and reference to candidate (completeness)."""

    c2r: float
    r2c: float


@dataclass(frozen=True)
class CloudScore:
    """Metrics of a pair in the coordinates as given; None if a metric was not asked for.

    Attributes:
        mean_distance: mean distance to the nearest point.
        d1_mse: mean squared distance to the nearest point, in squared units.
        d1_rms: square root of `d1_mse`.
        d2_mse: mean squared distance to the reference's tangent planes, in squared units.
        d2_rms: square root of `d2_mse`.
        chamfer: sum of both mean distances; half of it if a paper's Chamfer distance is their mean.
        chamfer_squared: sum of both mean squared distances.
        hausdorff: largest distance of both directions.
        fscore: precision, recall and F-score at each threshold.
    """

    mean_distance: BothWays | None = None
    d1_mse: BothWays | None = None
    d1_rms: BothWays | None = None
    d2_mse: BothWays | None = None
    d2_rms: BothWays | None = None
    chamfer: float | None = None
    chamfer_squared: float | None = None
    hausdorff: float | None = None
    fscore: tuple[FScore, ...] | None = None

    def values(self) -> dict[str, float]:
        """Return all numbers by name, such as `d1_rms.c2r`, `chamfer` and `fscore@0.02`: a row of a data frame."""
        return dict(_named_values(self))


METRICS = tuple(item.name for item in fields(CloudScore))
"""Names of all metrics."""


def score(
    reference: Points, candidate: Points, metrics: Sequence[str] | str | None = None, thresholds: Sequence[float] = ()
) -> CloudScore:
    """Measure a candidate against a reference in the given coordinates, without registration and verdict.

    Args:
        reference: a cloud, an (N, 3) array of any real type, a torch tensor, or the path of a file that
            `pcbench.read_cloud` reads. Arrays of float64 and tensors on the CPU near the
            origin are not copied.
        candidate: the same.
        metrics: names of `METRICS`; None: all without tangent planes, whose normals take several times as long as the
            search. `d2_mse` and `d2_rms` use the normals of the reference, or estimate them from 20 neighbours.
            `fscore@0.05` is `fscore` with this threshold besides `thresholds`, and so are `precision@0.05` and
            `recall@0.05`, which are parts of it.
        thresholds: distance thresholds of `fscore`.

    Raises:
        InputError: an argument is not a cloud, the units of two clouds differ, a metric is unknown, or a threshold is
            missing or not positive.
    """
    names, thresholds = _checked_metrics(metrics, thresholds)
    reference, candidate = _read(reference), _read(candidate)
    if isinstance(reference, Cloud) and isinstance(candidate, Cloud):
        check_same_unit(reference.unit, candidate.unit)
    fixed, moving = _near_origin(_points_of(reference), _points_of(candidate))
    pair = MatchedPair.of(Index(fixed), Index(moving))
    values = point_metrics(pair.to_reference.distances, pair.to_candidate.distances, thresholds)
    if any(name in names for name in _PLANE_METRICS):
        given = reference.normals if isinstance(reference, Cloud) else None
        values |= plane_metrics(pair, normals_of(pair.reference, given))
    return CloudScore(**{name: values[name] for name in names})


def score_many(
    pairs: Iterable[tuple[Points, Points]],
    metrics: Sequence[str] | str | None = None,
    thresholds: Sequence[float] = (),
    *,
    threads: int | None = None,
) -> list[CloudScore]:
    """Return the `score` of each pair (reference, candidate), several pairs at the same time on all CPUs.

    Args:
        pairs: pairs of clouds; those of an iterator are read when they are needed.
        metrics: as for `score`.
        thresholds: as for `score`.
        threads: number of pairs at the same time; None: the number of CPUs.

    Raises:
        InputError: as `score`; the message starts with the number of the pair, from 0.
    """
    names, thresholds = _checked_metrics(metrics, thresholds)
    count = cpu_count() if threads is None else threads
    if count < 1:
        raise InputError(f"expected at least one thread, got {count}")

    def score_numbered(number: int, pair: _Pair) -> CloudScore:
        try:
            try:
                first, second = pair
            except (TypeError, ValueError):
                raise InputError("expected a reference and a candidate") from None
            return score(first, second, names, thresholds)
        except (InputError, TypeError, ValueError) as error:
            raise InputError(f"pair {number}: {error}") from error

    scores: list[CloudScore] = []
    running: deque[Future[CloudScore]] = deque()
    # Each pair is searched by one thread, because threads that share a small search mostly wait for each other.
    with ThreadPoolExecutor(count, "pcbench-score", initializer=one_kernel_thread) as pool:
        try:
            for number, pair in enumerate(pairs):
                running.append(pool.submit(score_numbered, number, pair))
                if len(running) >= _WAITING_PAIRS * count:
                    scores.append(running.popleft().result())
            scores += [future.result() for future in running]
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    return scores


class MatchedPair(NamedTuple):
    """Two clouds and the nearest points in both directions."""

    reference: Index
    candidate: Index
    to_reference: Matches
    to_candidate: Matches

    @classmethod
    def of(cls, reference: Index, candidate: Index) -> MatchedPair:
        """Match two clouds in both directions."""
        return cls(reference, candidate, *match_both_directions(reference, candidate))


def point_metrics(a: FloatArray, b: FloatArray, thresholds: Sequence[float]) -> dict[str, Any]:
    """Return the metrics of `CloudScore` for distances (N,) candidate to reference and (M,) in the other direction."""
    means = BothWays(_mean(a), _mean(b))
    squares = _mean_squares(a, b)
    return {
        "mean_distance": means,
        "d1_mse": squares,
        "d1_rms": _roots(squares),
        "chamfer": means.c2r + means.r2c,
        "chamfer_squared": squares.c2r + squares.r2c,
        "hausdorff": max(float(a.max()), float(b.max())),
        "fscore": tuple(definitions.fscore(a, b, float(threshold)) for threshold in thresholds),
    }


def normals_of(reference: Index, given: FloatArray | None) -> FloatArray:
    """Return unit normals (N, 3) of the reference: given ones, or estimated ones where these have no length.

    Raises:
        InputError: there are fewer than three points and no normals.
    """
    return Surface(reference, _NORMAL_NEIGHBORS, given, is_even=False).compute_normals(None)


def plane_metrics(
    pair: MatchedPair, normals: FloatArray, rows: IntArray | None = None, rows_back: IntArray | None = None
) -> dict[str, Any]:
    """Return D2 in both directions, to tangent planes along the reference's normals (N, 3).

    Args:
        pair: the pair.
        normals: unit normals of the reference.
        rows: indices of the candidate's points that count; None: all.
        rows_back: indices of the reference's points that count; None: all.
    """
    fixed, moving = pair.reference.points, pair.candidate.points
    nearest, nearest_back = pair.to_reference.indices, pair.to_candidate.indices
    nearest = nearest if rows is None else nearest[rows]
    nearest_back = nearest_back if rows_back is None else nearest_back[rows_back]
    to_planes = definitions.plane_distances
    forth = to_planes(moving, fixed, normals, query_rows=rows, closest_rows=nearest, normal_rows=nearest)
    back = to_planes(fixed, moving, normals, query_rows=rows_back, closest_rows=nearest_back, normal_rows=rows_back)
    squares = _mean_squares(forth, back)
    return {"d2_mse": squares, "d2_rms": _roots(squares)}


def _mean_squares(a: FloatArray, b: FloatArray) -> BothWays:
    return BothWays(_mean(np.square(a)), _mean(np.square(b)))


def _mean(values: FloatArray) -> float:
    """Return the mean of values (N,), as `numpy.mean` in half of its time for a few thousand values."""
    return float(np.add.reduce(values)) / len(values)


def _near_origin(points: FloatArray, others: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Move points near the origin if they are far from it: squares of large coordinates would lose digits."""
    origin = np.floor(points[0]) if len(points) else np.zeros(3)
    if not origin.any() or not np.isfinite(origin).all():  # `Index` names a coordinate that is not finite
        return points, others
    return _minus(points, origin), _minus(others, origin)


def _minus(points: FloatArray, origin: FloatArray) -> FloatArray:
    """Return points (N, 3) minus an origin (3,), axis by axis: numpy takes longer for rows of three numbers."""
    shifted = np.empty(points.shape)
    for axis in range(3):
        np.subtract(points[:, axis], origin[axis], out=shifted[:, axis])
    return shifted


def _checked_metrics(
    metrics: Sequence[str] | str | None, thresholds: Sequence[float]
) -> tuple[tuple[str, ...], Sequence[float]]:
    """Return the names of fields of `CloudScore`, and all thresholds."""
    if np.ndim(thresholds) != 1:
        raise InputError(f"expected thresholds as numbers such as (0.01, 0.02), got {thresholds!r}")
    if metrics is None:
        names = tuple(n for n in METRICS if n not in _PLANE_METRICS and (n != "fscore" or len(thresholds)))
        return names, thresholds
    names, named = split_thresholds((metrics,) if isinstance(metrics, str) else metrics)
    if named:
        names, thresholds = (*names, "fscore"), (*thresholds, *(t for t in named if t not in thresholds))
    if unknown := [name for name in names if name not in METRICS]:
        hint = did_you_mean(unknown[0], METRICS)
        raise InputError(f"unknown metric {unknown[0]!r}: expected one of {', '.join(METRICS)}{hint}")
    if "fscore" in names and not len(thresholds):
        raise InputError(
            "fscore: expected thresholds=(...), the distances within which points count, or one in the name such as"
            " fscore@0.05, got none"
        )
    return names, thresholds


def _read(given: Points) -> Points:
    """Return the cloud of a file; anything else is returned as it is."""
    if not isinstance(given, str | os.PathLike):
        return given
    from pcbench.io import read_cloud  # its readers are not needed for arrays

    return read_cloud(given)


def _points_of(given: Points) -> FloatArray:
    """Return points (N, 3) as float64, without a copy if possible; `Index` checks them."""
    if isinstance(given, Cloud):
        return given.points
    if hasattr(given, "detach"):  # a tensor, perhaps with gradients, on a GPU, or of a type that numpy lacks
        tensor: Any = given.detach().cpu()
        given = tensor.float() if str(tensor.dtype) == "torch.bfloat16" else tensor
    if np.ma.is_masked(given):
        raise InputError("expected points without a mask, got masked coordinates: remove such points first")
    array: Any = np.asarray(given)
    if array.ndim != 2 or array.shape[1] != 3 or array.dtype.kind not in "fiu":
        raise InputError(f"expected points as real numbers of shape (N, 3), got {array.dtype} {array.shape}")
    return np.asarray(array, np.float64)


def _roots(squares: BothWays) -> BothWays:
    return BothWays(*(value**0.5 for value in squares))


def _named_values(result: CloudScore) -> Iterator[tuple[str, float]]:
    for name in METRICS:
        value = getattr(result, name)
        if isinstance(value, BothWays):
            yield f"{name}.c2r", value.c2r
            yield f"{name}.r2c", value.r2c
        elif name == "fscore":
            for at_threshold in value or ():
                for part in ("precision", "recall", "fscore"):
                    yield f"{part}@{at_threshold.threshold:g}", getattr(at_threshold, part)
        elif value is not None:
            yield name, value
