"""Metrics against the exact distances to the surface: ours, Open3D's and point-cloud-utils'."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from pcbench.comparison.run import compare
from pcbench.extras import require
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.mesh import MeshIndex
from pcbench.measure.results import Estimate
from pcbench.measure.settings import Settings
from pcbench.studies.stress.scenes import StressPair
from pcbench.studies.stress.subject import (
    COST_LEGEND,
    ENDS,
    RIGHT,
    SAID,
    SILENT,
    Group,
    Outcome,
    PairSubject,
    RunResult,
    StressCell,
    StressMethod,
    by_name,
)

MEAN_DISTANCE, RMS_OFF_SURFACE = "mean distance", "RMS off the surface"
NAMES = (MEAN_DISTANCE, RMS_OFF_SURFACE)

MAX_METRIC_ERROR = 0.1
"""Relative error up to which the value of a metric is right."""

MAX_FLOOR_SHARE = 0.3
"""Floor over value up to which point spacing hardly contributes to the value: less than 5 % of an RMS."""


@dataclass(frozen=True)
class MetricCell(StressCell):
    """Result of one metric.

    A value within 10 % of the exact one is right. Any other is said if the exact value lies in its interval, or below
    it by at most the sampling floor, which states how much the point spacing may add; otherwise it is silent.

    Attributes:
        metric: name of the metric, such as `RMS off the surface`.
        value: measured value, in the clouds' unit.
        exact: exact value, from the distances to the true surface, in the clouds' unit.
        floor: sampling floor; None if the method has none.
        interval: 95 % confidence interval of `value`; None if the method has none.
    """

    metric: str = ""
    value: float | None = None
    exact: float = math.nan
    floor: float | None = None
    interval: tuple[float, float] | None = None

    @property
    def covers(self) -> bool | None:
        """Return whether the interval contains the exact value; None without an interval.

        It is None also where the floor exceeds 30 % of the value: an interval covers random errors, not the spacing.
        """
        if self.interval is None or self.value is None or (self.floor or 0.0) > MAX_FLOOR_SHARE * self.value:
            return None
        return self.interval[0] <= self.exact <= self.interval[1]


class MeasuredValue(NamedTuple):
    """A metric from the candidate to the reference, in the clouds' unit, with floor and 95 % interval if there are."""

    value: float | None
    floor: float | None = None
    interval: tuple[float, float] | None = None


Measure = Callable[[StressPair, int], dict[str, MeasuredValue]]


def exact_values(pair: StressPair) -> dict[str, float]:
    """Return the metrics of the exact distances from the candidate's points to the true surface, by name."""
    assert pair.surface is not None
    distances = MeshIndex(pair.surface).query(pair.points).distances
    return {
        MEAN_DISTANCE: float(distances.mean()),
        RMS_OFF_SURFACE: float(np.sqrt(np.square(distances).mean())),
    }


def outcome_of(value: MeasuredValue, exact: float) -> str:
    """Return the outcome of a metric: right, said or silent; see `MetricCell`.

    The floor beside a value states how much of it the point spacing may be.
    """
    if value.value is None:
        return SAID
    if abs(value.value - exact) <= MAX_METRIC_ERROR * exact:
        return RIGHT
    low, high = value.interval or (value.value, value.value)
    return SAID if low - (value.floor or 0.0) <= exact <= high else SILENT


def _ours(pair: StressPair, seed: int) -> dict[str, MeasuredValue]:
    comparison = compare(pair.reference, pair.points, Settings(register="none", seed=seed))
    metrics = next(iter(comparison)).metrics
    return {
        MEAN_DISTANCE: _value(metrics.mean_distance.accuracy),
        RMS_OFF_SURFACE: _value(metrics.d2_mse.accuracy, root=True),
    }


def _open3d(pair: StressPair, _: int) -> dict[str, MeasuredValue]:
    geometry, utility = require("open3d.geometry"), require("open3d.utility")
    reference, candidate = (geometry.PointCloud(utility.Vector3dVector(p)) for p in (pair.reference, pair.points))
    return _nearest_values(np.asarray(candidate.compute_point_cloud_distance(reference)))


def _point_cloud_utils(pair: StressPair, _: int) -> dict[str, MeasuredValue]:
    library = require("point_cloud_utils")
    distances, _indices = library.k_nearest_neighbors(pair.points, pair.reference, 1, num_threads=1)
    return _nearest_values(np.asarray(distances))


def _nearest_values(distances: FloatArray) -> dict[str, MeasuredValue]:
    """Return the metrics of distances to the nearest points: no library but ours measures to the surface."""
    return {
        MEAN_DISTANCE: MeasuredValue(float(distances.mean())),
        RMS_OFF_SURFACE: MeasuredValue(float(np.sqrt(np.square(distances).mean()))),
    }


def _value(estimate: Estimate, *, root: bool = False) -> MeasuredValue:
    def plain(value: float | None) -> float | None:
        return None if value is None else math.sqrt(max(0.0, value)) if root else value

    interval = None
    if estimate.interval is not None:
        low, high = (math.sqrt(max(0.0, end)) if root else end for end in estimate.interval)
        interval = (low, high)
    return MeasuredValue(plain(estimate.value), plain(estimate.floor), interval)


METRIC_METHODS: dict[str, StressMethod[Callable[[StressPair, int], dict[str, MeasuredValue]]]] = by_name(
    StressMethod("pcbench", _ours),
    StressMethod("Open3D", _open3d, "open3d", ("open3d",)),
    StressMethod("point-cloud-utils", _point_cloud_utils, "point-cloud-utils", ("point_cloud_utils",)),
)


def _judge(answer: Mapping[str, MeasuredValue], pair: StressPair, values: Mapping[str, Any]) -> RunResult:
    """Compare each metric with its exact value."""
    exact = exact_values(pair)
    return RunResult(
        tuple(
            MetricCell(
                **values,
                outcome=outcome_of(measured, exact[name]),
                metric=name,
                exact=exact[name],
                **measured._asdict(),
            )
            for name, measured in answer.items()
        )
    )


METRICS = PairSubject(
    name="metrics",
    title="Metrics and their intervals",
    noun="metric value",
    key="metrics",
    cell=MetricCell,
    outcomes=(
        Outcome(RIGHT, "right", Group.SUCCESS),
        Outcome(SAID, "off, but explained by floor or interval", Group.SUCCESS),
        Outcome(SILENT, "silently wrong", Group.CONFIDENT),
        *ENDS,
    ),
    legend=f"said: wrong, but explained by the floor or the interval; silent: wrong and not explained; {COST_LEGEND}",
    success="right or explained [% of runs]",
    charts=("outcomes", "matrix", "coverage", "severity"),
    row=lambda cell: f"{cell.method}, {cell.metric}",
    methods=METRIC_METHODS,
    ask=lambda method, pair, seed: METRIC_METHODS[method].run(pair, seed),
    judge=_judge,
    warm_up=lambda pair: _ours(pair, 0),
    cells_of=lambda method: [{"method": method, "metric": name} for name in NAMES],
)
