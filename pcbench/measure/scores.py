"""All metrics of one aligned pair: values in both directions, floors, area weighting and intervals."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from typing import NamedTuple

import numpy as np

from pcbench.errors import Notice
from pcbench.geometry import voxels
from pcbench.geometry.arrays import FloatArray, rounding_of
from pcbench.measure import deviation, intervals, metrics
from pcbench.measure.directions import MEAN_METRICS, Direction, MeanMetric
from pcbench.measure.intervals import Sampled, ScoreUncertainty
from pcbench.measure.results import (
    ARROWS,
    BACK,
    FORTH,
    Chamfer,
    DirectedMetric,
    DirectedSpread,
    Estimate,
    Extremes,
    Hausdorff,
    Metrics,
    ThresholdScores,
)

MIN_PIECES = 10  # independent ones, of the scene: fewer do not show how far distances are alike
_CHAMFER = {"sum_unsquared": "mean_distance", "sum_squared": "d1_mse"}  # of which mean in both directions


class Measurement(NamedTuple):
    """Metrics of a candidate, with what their differences from those of other candidates need.

    Attributes:
        sampled: every score by name, as `Difference.metric` has it.
        shares: (B,) of the queries of both directions in each cell.
        warnings: on the intervals.
    """

    metrics: Metrics
    sampled: Mapping[str, Sampled]
    shares: FloatArray
    warnings: tuple[Notice, ...]


def measure(
    forth: Direction,
    back: Direction,
    thresholds: tuple[float, ...],
    *,
    cells: intervals.CorrelationCells,
    voxel: float,
    corner: FloatArray,
    origin: FloatArray,
) -> Measurement:
    """Measure candidate → reference (`forth`) and reference → candidate (`back`).

    Args:
        thresholds: of the F-score.
        cells: of the intervals.
        voxel, corner: side of the cells that area weighting averages over first, and where (3,) they are counted from.
        origin: (3,) added to the coordinates of the worst points.
    """
    ways = {FORTH: forth, BACK: back}
    shares = {way: np.bincount(d.cells, minlength=cells.number) / len(d.cells) for way, d in ways.items()}
    uneven = shares[FORTH] - shares[BACK]
    means = {way: _means(direction, thresholds, shares[way], uneven) for way, direction in ways.items()}
    whole = _sampled(means, thresholds)
    parts = {f"{way}/{_within(t)}": means[way][_within(t)] for way in ways for t in thresholds}
    both = 0.5 * (shares[FORTH] + shares[BACK])
    spreads = intervals.spreads({**whole, **parts}, cells, both)

    def estimate(name: str) -> Estimate:
        score = whole.get(name) or parts[name]
        return Estimate(score.value, interval=intervals.interval(score, spreads[name]))

    weighted = {way: voxels.cells(direction.points, voxel, corner) for way, direction in ways.items()}

    def directed(metric: MeanMetric) -> DirectedMetric:
        key = metric.name
        if f"{key}/{FORTH}" not in whole:  # no normals, no distances to planes
            return DirectedMetric(symmetric_max=Estimate() if metric.has_symmetric_max else None)
        found = {}
        for way, direction in ways.items():
            values = metric.of_each(direction.distances)
            assert values is not None
            area_weighted = metrics.area_weighted_mean(values, weighted[way])
            floor = direction.floors[key]
            found[way] = estimate(f"{key}/{way}")._replace(floor=floor, area_weighted=area_weighted)
        larger = estimate(f"{key}/symmetric_max") if metric.has_symmetric_max else None
        return DirectedMetric(found[FORTH], found[BACK], larger)

    def chamfer(name: str) -> Estimate:
        floor = _total(direction.floors[_CHAMFER[name]] for direction in ways.values())
        return estimate(f"chamfer/{name}")._replace(floor=floor)

    rounding = rounding_of(forth.points, origin)
    distributed = {"distance": _distributions(forth.distances.to_points, back.distances.to_points)}
    if forth.distances.to_planes is not None and back.distances.to_planes is not None:
        distributed["plane_distance"] = _distributions(forth.distances.to_planes, back.distances.to_planes)
    accuracy = distributed["distance"].accuracy.percentiles or {}
    completeness = distributed["distance"].completeness.percentiles or {}
    return Measurement(
        Metrics(
            directed={metric.name: directed(metric) for metric in MEAN_METRICS},
            hausdorff=Hausdorff(_extremes(forth, accuracy, origin), _extremes(back, completeness, origin)),
            chamfer=Chamfer(**{name: chamfer(name) for name in _CHAMFER}),
            fscores=tuple(
                ThresholdScores(
                    threshold,
                    precision=estimate(f"{FORTH}/{_within(threshold)}"),
                    recall=estimate(f"{BACK}/{_within(threshold)}"),
                    fscore=estimate(f"fscore/{threshold!r}"),
                )
                for threshold in thresholds
            ),
            percentiles_accuracy=accuracy,
            percentiles_completeness=completeness,
            spreads=distributed,
        ),
        whole,
        both,
        tuple(_doubts({name: spread for name, spread in spreads.items() if name in whole}, whole, rounding)),
    )


def _distributions(forth: FloatArray, back: FloatArray) -> DirectedSpread:
    return DirectedSpread(deviation.Spread.of(forth), deviation.Spread.of(back))


def _sampled(means: Mapping[str, Mapping[str, Sampled]], thresholds: tuple[float, ...]) -> dict[str, Sampled]:
    """Every score that candidates are told apart by: means, the larger of both directions, sums, and F-scores."""
    found: dict[str, Sampled] = {}
    forth, back = means[FORTH], means[BACK]
    for metric in MEAN_METRICS:
        key = metric.name
        if key in forth and key in back:
            found[f"{key}/{FORTH}"], found[f"{key}/{BACK}"] = forth[key], back[key]
            if metric.has_symmetric_max:
                found[f"{key}/symmetric_max"] = max(forth[key], back[key], key=lambda mean: mean.value)
    for name, key in _CHAMFER.items():
        a, b = forth[key], back[key]
        found[f"chamfer/{name}"] = Sampled(a.value + b.value, a.influence + b.influence)
    for threshold in thresholds:
        p, r = forth[_within(threshold)], back[_within(threshold)]
        total = p.value + r.value
        slopes = (2 * (r.value / total) ** 2, 2 * (p.value / total) ** 2) if total > 0 else (0.0, 0.0)
        influence = slopes[0] * p.influence + slopes[1] * r.influence
        found[f"fscore/{threshold!r}"] = Sampled(metrics.harmonic_mean(p.value, r.value), influence, 1.0)
    return found


def _doubts(
    spreads: Mapping[str, ScoreUncertainty], scores: Mapping[str, Sampled], rounding: float
) -> Iterator[Notice]:
    """Whether the scene is too small to know how well the mean distances are known; of rounding there is no doubt."""
    least = {"mean_distance": rounding, "d2_mse": rounding**2}
    found = {
        name: spread
        for name, spread in spreads.items()
        if (metric := name.split("/")[0]) in least and scores[name].value > least[metric]
    }
    if not found:
        return
    name, worst = min(found.items(), key=lambda item: item[1].pieces)
    if worst.pieces < MIN_PIECES:
        over = f"distances are alike over about {worst.reach:.3g}: " if worst.reach > 0 else ""
        metric, _, way = name.partition("/")
        yield Notice(
            "few-pieces",
            f"intervals are rough: {over}the scene holds about {worst.pieces:.0f} independent pieces, and fewer than"
            f" {MIN_PIECES} do not show how scores vary ({metric.replace('_', ' ')} {ARROWS.get(way, way)})",
        )


def _extremes(direction: Direction, ranks: Mapping[str, float], origin: FloatArray) -> Extremes:
    distances = direction.distances.to_points
    worst = direction.points[int(np.argmax(distances))] + origin
    return Extremes(metrics.one_way_hausdorff(distances), ranks["p95"], ranks["p99"], worst)


def _means(
    direction: Direction, thresholds: tuple[float, ...], shares: FloatArray, uneven: FloatArray
) -> dict[str, Sampled]:
    """Every mean of one direction; one quantity after the other, so that only one takes room.

    How many points of either cloud fall into a cell is chance, but how many there are in all is not: what cells with
    more of the one and less of the other (`uneven`, 0 in sum) add to the mean is made up for elsewhere.
    """
    square = float(uneven @ uneven)

    def mean(values: FloatArray, largest: float = math.inf) -> Sampled:
        value = float(np.mean(values))
        influence = np.bincount(direction.cells, values, len(shares)) / len(values) - value * shares
        if square > 0:
            influence = influence - float(uneven @ influence) / square * uneven
        return Sampled(value, influence, largest)

    means: dict[str, Sampled] = {}
    for metric in MEAN_METRICS:
        values = metric.of_each(direction.distances)
        if values is not None:
            means[metric.name] = mean(values)
    for threshold in thresholds:
        means[_within(threshold)] = mean((direction.distances.to_points <= threshold).astype(np.float64), 1.0)
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
