"""All metrics of one aligned pair: values in both directions, sampling floors, area weighting and intervals."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from typing import NamedTuple

from pcbench.errors import Notice
from pcbench.geometry.arrays import FloatArray
from pcbench.measure import intervals, metrics
from pcbench.measure.directions import MEAN_METRICS
from pcbench.measure.intervals import LinearizedScore, ScoreUncertainty
from pcbench.measure.results import (
    ARROWS,
    CANDIDATE_TO_REFERENCE,
    REFERENCE_TO_CANDIDATE,
    Chamfer,
    DirectedMetric,
    DirectedSpread,
    Estimate,
    Hausdorff,
    Metrics,
    ThresholdScores,
)
from pcbench.measure.summaries import CellSums, DirectionSummary, within_key
from pcbench.measure.wording import pluralize

MIN_INDEPENDENT_REGIONS = 10  # with fewer, the correlation length is poorly known
_CHAMFER = {"sum_unsquared": "mean_distance", "sum_squared": "d1_mse"}  # mean that each variant adds over directions


class Measurement(NamedTuple):
    """Metrics of a candidate, with the data for its differences from other candidates.

    Attributes:
        metrics: values, floors and intervals.
        sampled: linearised scores by the names of `Difference.metric`.
        shares: (B,) share of the queries of both directions in each cell.
        warnings: warnings about the intervals.
    """

    metrics: Metrics
    sampled: Mapping[str, LinearizedScore]
    shares: FloatArray
    warnings: tuple[Notice, ...]


def measure(
    forth: DirectionSummary,
    back: DirectionSummary,
    thresholds: tuple[float, ...],
    *,
    cells: intervals.CorrelationCells,
) -> Measurement:
    """Compute all metrics of an aligned pair.

    Args:
        forth: summary of the distances candidate → reference.
        back: summary of the distances reference → candidate.
        thresholds: distance thresholds of the F-score, those of both summaries.
        cells: correlation cells of the intervals, those of both summaries.
    """
    ways = {CANDIDATE_TO_REFERENCE: forth, REFERENCE_TO_CANDIDATE: back}
    shares = {way: direction.cell_counts / direction.count for way, direction in ways.items()}
    uneven = shares[CANDIDATE_TO_REFERENCE] - shares[REFERENCE_TO_CANDIDATE]
    means = {way: _linearized_means(direction, thresholds, shares[way], uneven) for way, direction in ways.items()}
    compared = _linearized_scores(means, thresholds)
    within = {f"{way}/{within_key(t)}": means[way][within_key(t)] for way in ways for t in thresholds}
    both = 0.5 * (shares[CANDIDATE_TO_REFERENCE] + shares[REFERENCE_TO_CANDIDATE])
    table = _ScoreTable({**compared, **within}, intervals.spreads({**compared, **within}, cells, both))

    values = Metrics(
        directed=_directed_metrics(ways, table),
        hausdorff=Hausdorff(forth.extremes, back.extremes),
        chamfer=Chamfer(**{name: _chamfer(name, ways, table) for name in _CHAMFER}),
        fscores=tuple(_threshold_scores(threshold, table) for threshold in thresholds),
        percentiles_accuracy=forth.spreads["distance"].percentiles or {},
        percentiles_completeness=back.spreads["distance"].percentiles or {},
        spreads={
            kind: DirectedSpread(spread, back.spreads[kind])
            for kind, spread in forth.spreads.items()
            if kind in back.spreads
        },
        d2_samples={way: d.d2_sample for way, d in ways.items() if d.d2_sample is not None},
    )
    doubts = _interval_warnings({name: table.spreads[name] for name in compared}, compared, forth.rounding)
    return Measurement(values, compared, both, tuple(doubts))


class _ScoreTable(NamedTuple):
    """Linearised scores and their uncertainties by name."""

    sampled: Mapping[str, LinearizedScore]
    spreads: Mapping[str, ScoreUncertainty]

    def estimate(self, name: str) -> Estimate:
        """The value and its interval; no values without a score."""
        if name not in self.sampled:
            return Estimate()
        score = self.sampled[name]
        return Estimate(score.value, interval=intervals.interval(score, self.spreads[name]))


def _directed_metrics(ways: Mapping[str, DirectionSummary], table: _ScoreTable) -> dict[str, DirectedMetric]:
    """Return the mean metrics by name, with floors and area-weighted means."""
    directed = {}
    for metric in MEAN_METRICS:
        key = metric.name
        forth, back = (
            table.estimate(f"{key}/{way}")._replace(
                floor=direction.floors[key], area_weighted=direction.area_weighted[key]
            )
            if key in direction.means
            else Estimate()
            for way, direction in ways.items()
        )
        larger = table.estimate(f"{key}/symmetric_max") if metric.has_symmetric_max else None
        directed[key] = DirectedMetric(forth, back, larger)
    return directed


def _chamfer(name: str, ways: Mapping[str, DirectionSummary], table: _ScoreTable) -> Estimate:
    floor = _total(direction.floors[_CHAMFER[name]] for direction in ways.values())
    return table.estimate(f"chamfer/{name}")._replace(floor=floor)


def _threshold_scores(threshold: float, table: _ScoreTable) -> ThresholdScores:
    return ThresholdScores(
        threshold,
        precision=table.estimate(f"{CANDIDATE_TO_REFERENCE}/{within_key(threshold)}"),
        recall=table.estimate(f"{REFERENCE_TO_CANDIDATE}/{within_key(threshold)}"),
        fscore=table.estimate(f"fscore/{threshold!r}"),
    )


def _linearized_scores(
    means: Mapping[str, Mapping[str, LinearizedScore]], thresholds: tuple[float, ...]
) -> dict[str, LinearizedScore]:
    """Linearise each score that is compared between candidates: means, symmetric maxima, sums and F-scores."""
    linearized: dict[str, LinearizedScore] = {}
    forth, back = means[CANDIDATE_TO_REFERENCE], means[REFERENCE_TO_CANDIDATE]
    for metric in MEAN_METRICS:
        key = metric.name
        linearized |= {f"{key}/{way}": direction[key] for way, direction in means.items() if key in direction}
        if metric.has_symmetric_max and key in forth and key in back:
            linearized[f"{key}/symmetric_max"] = max(forth[key], back[key], key=lambda mean: mean.value)
    for name, key in _CHAMFER.items():
        a, b = forth[key], back[key]
        linearized[f"chamfer/{name}"] = LinearizedScore(a.value + b.value, a.influence + b.influence)
    for threshold in thresholds:
        p, r = forth[within_key(threshold)], back[within_key(threshold)]
        total = p.value + r.value
        slopes = (2 * (r.value / total) ** 2, 2 * (p.value / total) ** 2) if total > 0 else (0.0, 0.0)
        influence = slopes[0] * p.influence + slopes[1] * r.influence
        linearized[f"fscore/{threshold!r}"] = LinearizedScore(
            metrics.harmonic_mean(p.value, r.value), influence, 1.0, min(p.queries, r.queries)
        )
    return linearized


def _interval_warnings(
    spreads: Mapping[str, ScoreUncertainty], scores: Mapping[str, LinearizedScore], rounding: float
) -> Iterator[Notice]:
    """Warn if the scene is too small for reliable intervals of the mean distances; mere rounding is exempt."""
    least = {"mean_distance": rounding, "d2_mse": rounding**2}
    tested = {
        name: spread
        for name, spread in spreads.items()
        if (metric := name.split("/")[0]) in least and scores[name].value > least[metric]
    }
    if not tested:
        return
    name, worst = min(tested.items(), key=lambda item: item[1].independent_regions)
    if worst.independent_regions < MIN_INDEPENDENT_REGIONS:
        over = f"errors are correlated over {worst.reach:.3g}, which leaves" if worst.reach > 0 else "the scene holds"
        metric, _, way = name.partition("/")
        regions = pluralize(round(worst.independent_regions), "independent region")
        yield Notice(
            "few-pieces",
            f"intervals are approximate: {over} about {regions}; reliable intervals need at least"
            f" {MIN_INDEPENDENT_REGIONS} ({metric.replace('_', ' ')} {ARROWS.get(way, way)})",
        )


def _linearized_means(
    direction: DirectionSummary, thresholds: tuple[float, ...], shares: FloatArray, uneven: FloatArray
) -> dict[str, LinearizedScore]:
    """Linearise each mean of one direction.

    The number of points per cell is random, but the total is fixed. Cells with more points of one cloud than of the
    other (`uneven`, which sums to 0) are balanced by other cells, so that component of the influence is removed.
    """
    square = float(uneven @ uneven)
    shares_within = {within_key(threshold) for threshold in thresholds}

    def linearize(name: str, cells: CellSums) -> LinearizedScore:
        influence = cells.sums / direction.count - cells.mean * shares
        if square > 0:
            influence = influence - float(uneven @ influence) / square * uneven
        is_share = name in shares_within
        largest, queries = (1.0, direction.count) if is_share else (math.inf, math.inf)
        return LinearizedScore(cells.mean, influence, largest, queries)

    return {name: linearize(name, cells) for name, cells in direction.means.items()}


def _total(values: Iterable[float | None]) -> float | None:
    total = 0.0
    for value in values:
        if value is None:
            return None
        total += value
    return total
