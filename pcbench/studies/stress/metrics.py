"""Metrics behind one call: ours, Open3D's and point-cloud-utils', each against the exact distances to the surface."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pcbench.comparison.run import compare
from pcbench.extras import installed_versions, require
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.mesh import MeshIndex
from pcbench.measure.results import Estimate
from pcbench.measure.settings import Settings
from pcbench.studies.stress.methods import missing_method
from pcbench.studies.stress.results import (
    MAX_METRIC_ERROR,
    METRICS,
    RIGHT,
    SAID,
    SILENT,
    MethodInfo,
    MissingMethod,
)
from pcbench.studies.stress.scenes import StressPair

MEAN_DISTANCE, RMS_OFF_SURFACE = "mean distance", "RMS off the surface"
NAMES = (MEAN_DISTANCE, RMS_OFF_SURFACE)


@dataclass(frozen=True)
class MeasuredValue:
    """A metric from the candidate to the reference, in the clouds' unit, with floor and 95 % interval if there are."""

    value: float | None
    floor: float | None = None
    interval: tuple[float, float] | None = None


Measure = Callable[[StressPair, int], dict[str, MeasuredValue]]


@dataclass(frozen=True)
class MetricMethod:
    """A library that measures distances: its name, its module (empty for ours) and its function."""

    name: str
    modules: tuple[str, ...]
    library: str
    run: Measure

    def info(self) -> MethodInfo:
        """Return the description for results."""
        version = installed_versions([self.library]).get(self.library, "")
        return MethodInfo(self.name, METRICS, "", self.library, version)

    def missing(self) -> MissingMethod | None:
        """Return why the method cannot run, or None if its library is installed."""
        return missing_method(self.name, self.modules)


def exact_values(pair: StressPair) -> dict[str, float]:
    """Return the metrics of the exact distances from the candidate's points to the true surface, by name."""
    assert pair.surface is not None
    distances = MeshIndex(pair.surface).query(pair.points).distances
    return {
        MEAN_DISTANCE: float(distances.mean()),
        RMS_OFF_SURFACE: float(np.sqrt(np.square(distances).mean())),
    }


def judge(value: MeasuredValue, exact: float) -> str:
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
    found = compare(pair.reference, pair.points, Settings(register="none", seed=seed))
    metrics = next(iter(found)).metrics
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


METRIC_METHODS = {
    method.name: method
    for method in (
        MetricMethod("pcbench", (), "pcbench", _ours),
        MetricMethod("Open3D", ("open3d",), "open3d", _open3d),
        MetricMethod("point-cloud-utils", ("point_cloud_utils",), "point-cloud-utils", _point_cloud_utils),
    )
}
