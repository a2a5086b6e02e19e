"""All metrics of one aligned pair: values in both directions, floors, area weighting and intervals."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import NamedTuple

import numpy as np

from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.voxels import Cells, cells
from pcbench.measure import intervals, metrics
from pcbench.measure.directions import MEAN_METRICS, Direction, MeanMetric
from pcbench.measure.results import (
    BACK,
    FORTH,
    Chamfer,
    DirectedMetric,
    Estimate,
    Extremes,
    Hausdorff,
    Metrics,
    ThresholdScores,
)


class Sampled(NamedTuple):
    """A mean, and what it is (R,) under each replicate of the bootstrap."""

    value: float
    replicates: FloatArray


class Measurement(NamedTuple):
    """Metrics of a candidate, and every mean among them with its replicates by name, as `Difference.metric` has it."""

    metrics: Metrics
    sampled: Mapping[str, Sampled]


def measure(
    forth: Direction,
    back: Direction,
    thresholds: tuple[float, ...],
    *,
    block_weights: FloatArray,
    voxel: float,
    corner: FloatArray,
    origin: FloatArray,
) -> Measurement:
    """Measure candidate → reference (`forth`) and reference → candidate (`back`).

    Args:
        thresholds: of the F-score.
        block_weights: (R, B) of the bootstrap's replicates.
        voxel, corner: side of the cells that area weighting averages over first, and where (3,) they are counted from.
        origin: (3,) added to the coordinates of the worst points.
    """
    means = {
        way: _means(direction, thresholds, block_weights, cells(direction.points, voxel, corner))
        for way, direction in ((FORTH, forth), (BACK, back))
    }
    sampled: dict[str, Sampled] = {}

    def estimate(name: str, value: float, replicates: FloatArray) -> Estimate:
        sampled[name] = Sampled(value, replicates)
        return Estimate(value, interval=intervals.interval(replicates))

    def directed(metric: MeanMetric) -> DirectedMetric:
        key = metric.name
        if not all(key in means[way] for way in (FORTH, BACK)):  # no normals, no distances to planes
            return DirectedMetric(symmetric_max=Estimate() if metric.has_symmetric_max else None)
        both: list[Estimate] = []
        for way, direction in ((FORTH, forth), (BACK, back)):
            mean = means[way][key]
            found = estimate(f"{key}/{way}", mean.value, mean.replicates)
            both.append(found._replace(floor=direction.floors[key], area_weighted=mean.area_weighted))
        if not metric.has_symmetric_max:
            return DirectedMetric(both[0], both[1])
        larger = np.maximum(means[FORTH][key].replicates, means[BACK][key].replicates)
        value = max(means[way][key].value for way in (FORTH, BACK))
        return DirectedMetric(both[0], both[1], estimate(f"{key}/symmetric_max", value, larger))

    def chamfer(name: str, key: str, value: float) -> Estimate:
        found = estimate(f"chamfer/{name}", value, means[FORTH][key].replicates + means[BACK][key].replicates)
        return found._replace(floor=_total((forth.floors[key], back.floors[key])))

    a, b = forth.distances.to_points, back.distances.to_points
    accuracy, completeness = metrics.percentiles(a), metrics.percentiles(b)
    return Measurement(
        Metrics(
            directed={metric.name: directed(metric) for metric in MEAN_METRICS},
            hausdorff=Hausdorff(_extremes(forth, accuracy, origin), _extremes(back, completeness, origin)),
            chamfer=Chamfer(
                sum_unsquared=chamfer("sum_unsquared", "mean_distance", metrics.chamfer_unsquared(a, b)),
                sum_squared=chamfer("sum_squared", "d1_mse", metrics.chamfer_squared(a, b)),
            ),
            fscores=tuple(_fscore(a, b, means, threshold, sampled) for threshold in thresholds),
            percentiles_accuracy=accuracy,
            percentiles_completeness=completeness,
        ),
        sampled,
    )


def _fscore(
    a: FloatArray,
    b: FloatArray,
    means: Mapping[str, Mapping[str, _Mean]],
    threshold: float,
    sampled: dict[str, Sampled],
) -> ThresholdScores:
    score = metrics.fscore(a, b, threshold)
    precision, recall = (means[way][_within(threshold)].replicates for way in (FORTH, BACK))
    both = np.array([metrics.harmonic_mean(p, r) for p, r in zip(precision, recall, strict=True)])
    sampled[f"fscore/{threshold!r}"] = Sampled(score.fscore, both)
    return ThresholdScores(
        threshold,
        precision=Estimate(score.precision, interval=intervals.interval(precision)),
        recall=Estimate(score.recall, interval=intervals.interval(recall)),
        fscore=Estimate(score.fscore, interval=intervals.interval(both)),
    )


def _extremes(direction: Direction, ranks: Mapping[str, float], origin: FloatArray) -> Extremes:
    distances = direction.distances.to_points
    worst = direction.points[int(np.argmax(distances))] + origin
    return Extremes(metrics.one_way_hausdorff(distances), ranks["p95"], ranks["p99"], worst)


class _Mean(NamedTuple):
    """Of one quantity of one direction."""

    value: float
    replicates: FloatArray  # (R,)
    area_weighted: float | None = None


def _means(direction: Direction, thresholds: tuple[float, ...], weights: FloatArray, voxels: Cells) -> dict[str, _Mean]:
    """Every mean of one direction; one quantity after the other, so that only one takes room."""
    count = intervals.replicate_sums(direction.blocks, None, weights)

    def mean(values: FloatArray) -> _Mean:
        return _Mean(float(np.mean(values)), intervals.replicate_sums(direction.blocks, values, weights) / count)

    means: dict[str, _Mean] = {}
    for metric in MEAN_METRICS:
        values = metric.of_each(direction.distances)
        if values is not None:
            means[metric.name] = mean(values)._replace(area_weighted=metrics.area_weighted_mean(values, voxels))
    for threshold in thresholds:
        means[_within(threshold)] = mean((direction.distances.to_points <= threshold).astype(np.float64))
    return means


def _within(threshold: float) -> str:
    return f"within/{threshold!r}"


def _total(values: Iterable[float | None]) -> float | None:
    total = 0.0
    for value in values:
        if value is None:
            return None
        total += value
    return total
