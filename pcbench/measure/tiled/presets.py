"""Presets that follow from the metrics of a tiled comparison."""

from __future__ import annotations

from collections.abc import Iterator

from pcbench.geometry.regions import Region
from pcbench.measure.metrics import FScore
from pcbench.measure.presets import Gao2025, Open3d, Pdal, Preset
from pcbench.measure.results import Metrics, ThresholdScores
from pcbench.measure.settings import Settings


def presets_of(
    metrics: Metrics, settings: Settings, region: Region | None, counts: tuple[int, int]
) -> Iterator[tuple[str, Preset]]:
    """Yield the presets that follow from the metrics; with a region they would need a search in cropped clouds.

    Args:
        metrics: the metrics.
        settings: the settings, which name the presets.
        region: the measured region.
        counts: number of queries c→r and r→c.
    """
    if region is not None:
        return
    d1, d2 = metrics.d1_mse, metrics.d2_mse
    forth, back = (float(way.value or 0.0) for way in (d1.accuracy, d1.completeness))
    largest = metrics.hausdorff.symmetric_max
    for name in settings.presets:
        if name == "gao2025":
            yield name, Gao2025(forth, d2.accuracy.value, None, largest, forth + back, back)
        elif name == "open3d":
            chamfer = float(metrics.chamfer.sum_unsquared.value or 0.0)
            yield name, Open3d(chamfer, largest, tuple(_fscore(scores) for scores in metrics.fscores))
        elif name == "pdal":
            yield name, Pdal(counts[0] * forth + counts[1] * back, largest)


def _fscore(scores: ThresholdScores) -> FScore:
    return FScore(
        scores.threshold, *(float(part.value or 0.0) for part in (scores.precision, scores.recall, scores.fscore))
    )
