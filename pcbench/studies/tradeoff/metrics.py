"""The numbers whose errors are studied, and the correction of mean distances by their sampling floors."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from pcbench.measure.results import CANDIDATE_TO_REFERENCE, REFERENCE_TO_CANDIDATE, Candidate, Metrics

MEANS, SHARES, PERCENTILES, EXTREMES, DEFORMATION = "means", "F-score", "95 %", "largest", "deformation"
GROUPS = (MEANS, SHARES, PERCENTILES, EXTREMES, DEFORMATION)
GROUP_NAMES = {
    MEANS: "every mean distance",
    SHARES: "the F-score",
    PERCENTILES: "the 95th percentiles",
    EXTREMES: "the largest distances",
    DEFORMATION: "the verdict on deformation",
}
CHAMFER = "Chamfer"
MEAN_DISTANCES = ("mean c→r", "mean r→c")
# Metrics that the floor corrects, with the power of the share of kept points to which their squared floor is
# inversely proportional. The spacing is proportional to share^(-1/2). Distances to points are proportional to it.
# Squared distances to tangent planes are proportional to its third power, because they arise near edges: in a share of
# the points that is proportional to the spacing.
CORRECTABLE = {"mean c→r": 1.0, "mean r→c": 1.0, "D2 RMS c→r": 1.5, "D2 RMS r→c": 1.5}


@dataclass(frozen=True)
class StudiedMetric:
    """A metric of the study.

    Attributes:
        name: key and column heading.
        title: title of its chart.
        group: group of the metrics that are recommended for together, of `GROUPS`.
        value_of: function that returns its value, or None.
        floor_of: function that returns its sampling floor, or None.
    """

    name: str
    title: str
    group: str
    value_of: Callable[[Metrics], float | None]
    floor_of: Callable[[Metrics], float | None] = lambda _: None


_Of = Callable[[Metrics, str], float | None]
ARROWS = {"c→r": CANDIDATE_TO_REFERENCE, "r→c": REFERENCE_TO_CANDIDATE}


def _directed(
    name: str, title: str, group: str, value_of: _Of, floor_of: _Of = lambda _, way: None
) -> list[StudiedMetric]:
    """Return a metric in both directions."""

    def one(arrow: str, way: str) -> StudiedMetric:
        return StudiedMetric(
            f"{name} {arrow}", f"{title} {arrow}", group, lambda m: value_of(m, way), lambda m: floor_of(m, way)
        )

    return [one(arrow, way) for arrow, way in ARROWS.items()]


METRICS = {
    metric.name: metric
    for metric in (
        *_directed(
            "mean",
            "mean distance",
            MEANS,
            lambda m, way: m.mean_distance[way].value,
            lambda m, way: m.mean_distance[way].floor,
        ),
        *_directed(
            "D2 RMS",
            "RMS off the surface (D2)",
            MEANS,
            lambda m, way: _root(m.d2_mse[way].value),
            lambda m, way: _root(m.d2_mse[way].floor),
        ),
        StudiedMetric(CHAMFER, "Chamfer, sum of means", MEANS, lambda m: m.chamfer.sum_unsquared.value),
        StudiedMetric("F-score", "F-score", SHARES, lambda m: m.fscores[0].fscore.value if m.fscores else None),
        *_directed("95 %", "95th percentile", PERCENTILES, lambda m, way: m.hausdorff[way].p95),
        *_directed("largest", "largest distance", EXTREMES, lambda m, way: m.hausdorff[way].largest),
    )
}
DEFORMATION_RMS = "deformation RMS"
NAMES = (*METRICS, DEFORMATION_RMS)
GROUP_OF = {**{name: metric.group for name, metric in METRICS.items()}, DEFORMATION_RMS: DEFORMATION}
TITLES = {**{name: metric.title for name, metric in METRICS.items()}, DEFORMATION_RMS: "RMS of the deformation"}


def metric_values(metrics: Metrics) -> dict[str, float | None]:
    """Return the value of each metric by name."""
    return {name: metric.value_of(metrics) for name, metric in METRICS.items()}


def deformation_rms(candidate: Candidate) -> float | None:
    """Return the RMS displacement of the non-affine part, or None if it was not found."""
    size = candidate.deformation.amplitude
    return None if size is None else size.rms


def metric_floors(metrics: Metrics) -> dict[str, float | None]:
    """Return the sampling floor of each metric that has one, by name."""
    floors = {name: METRICS[name].floor_of(metrics) for name in CORRECTABLE}
    return {name: floor for name, floor in floors.items() if floor is not None}


def corrected_values(
    values: Mapping[str, float | None], floors: Mapping[str, float | None], shares: Mapping[str, float]
) -> dict[str, float | None]:
    """Return metrics to thinned clouds, corrected to those of the complete clouds.

    Args:
        values: measured values by name.
        floors: their sampling floors, to the thinned clouds.
        shares: by direction, the share of the points that the searched cloud kept.
    """
    corrected = {
        name: correct_for_thinning(values.get(name), floors.get(name), shares[name.split()[-1]], power)
        for name, power in CORRECTABLE.items()
    }
    parts = [corrected[name] for name in MEAN_DISTANCES]
    known_parts = [part for part in parts if part is not None]
    return {**corrected, CHAMFER: sum(known_parts) if len(known_parts) == len(parts) else None}


def correct_for_thinning(value: float | None, floor: float | None, share: float, power: float = 1.0) -> float | None:
    """Return a distance to a complete cloud, from that to a share of its points; None without a value or a floor.

    Errors and spacing are independent and add in squares, as distances off a surface and along it do: d^2 = e^2 + f^2.
    The squared floor f^2 of a share s of the points of a surface is s^(-power) times that of the complete cloud, so
    the same error with the floor of the complete cloud gives d^2 - f^2 (1 - s^power).

    Args:
        value: mean distance or root mean square distance to the thinned cloud, in the clouds' unit.
        floor: its sampling floor.
        share: share of the points that the thinned cloud kept, above 0 and at most 1.
        power: see `CORRECTABLE`.
    """
    if value is None or floor is None:
        return None
    return math.sqrt(max(0.0, value**2 - floor**2 * (1 - share**power)))


def _root(value: float | None) -> float | None:
    return None if value is None else math.sqrt(value)
