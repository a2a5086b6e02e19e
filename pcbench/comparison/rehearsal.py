"""A comparison of two small clouds, whose document shows the names of a real one before that is computed."""

from __future__ import annotations

from typing import Any

import numpy as np

from pcbench.comparison.in_memory import compare_in_memory
from pcbench.geometry.cloud import Cloud
from pcbench.measure.own_metrics import metric_name
from pcbench.measure.settings import Settings
from pcbench.report.document import candidate_values, document

_POINTS = 100
_POISSON = "poisson"  # maps whose names begin with it take long


def rehearse(settings: Settings) -> dict[str, Any]:
    """Return what comparison.json says about a candidate, with the keys that it has for these settings.

    The values are those of two small clouds. Entries whose keys depend on the compared clouds are null or empty.
    """
    maps = tuple(name for name in settings.maps if not name.startswith(_POISSON))
    small = Settings(thresholds=settings.thresholds, presets=settings.presets, maps=maps)
    rng = np.random.default_rng(0)
    plan = [rng.random((_POINTS, 2)) for _ in range(2)]
    reference, candidate = (Cloud(np.column_stack([xy, np.sin(3 * xy @ [1.0, 0.5])])) for xy in plan)
    (subject,) = candidate_values(document(compare_in_memory(reference, {"": candidate}, small, lambda _: None)))
    values = {**subject.values, "changes": [], "timings_s": None, "censored": None, "map_samples": None}
    metrics = values["metrics"]
    if settings.thresholds is None:
        for scores in (metrics, *metrics["presets"].values()):
            if "fscore" in scores:
                scores["fscore"] = []
    metrics["own"] = {metric_name(metric): None for metric in settings.own_metrics}
    if settings.tolerance is not None:
        metrics["d2_mse"]["sample"] = None
    if maps != settings.maps:
        values["deviation"]["maps"] = None
    return values
