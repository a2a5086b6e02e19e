"""The table of novel views: one row per scene, with means over training views and over held-out views."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

from pcbench.measure.images import ViewScores
from pcbench.measure.wording import pluralize
from pcbench.studies.views.scores import ScoredScene, ViewStudy, mean_scores

_DASH = "–"


class _Metric(NamedTuple):
    field: str
    header: str
    decimals: int


_METRICS = (
    _Metric("psnr", "PSNR", 2),
    _Metric("ssim", "SSIM", 3),
    _Metric("lpips", "LPIPS", 3),
    _Metric("flip", "FLIP", 3),
)


def table(study: ViewStudy) -> list[list[str]]:
    """Return the cells, the header first; only measured metrics have columns.

    If there are several scenes, the last row has their mean.
    """
    means = [(scene.mean(test=False), scene.mean(test=True)) for scene in study.scenes]
    metrics = [
        metric
        for metric in _METRICS
        if any(mean is not None and getattr(mean, metric.field) is not None for pair in means for mean in pair)
    ]
    several = len({scene.views.method for scene in study.scenes}) > 1
    head = ["scene", *(["method"] if several else []), "held out"]
    names = [f"{kind} {metric.header}" for kind in ("train", "test") for metric in metrics]
    rows = [[*head, "views", *names]]
    for scene, pair in zip(study.scenes, means, strict=True):
        counts = " + ".join(str(len(scene.select(test=test))) for test in (False, True))
        method = [scene.views.method] if several else []
        rows.append([scene.views.scene, *method, scene.views.split, counts, *_cells(pair, metrics, scene)])
    if len(study.scenes) > 1:
        over = [_mean_over_scenes([pair[k] for pair in means]) for k in (0, 1)]
        blank = [""] * (len(head) - 1)
        rows.append([f"mean of {len(study.scenes)}", *blank, "", *_cells(over, metrics)])
    return rows


def answer(study: ViewStudy) -> Iterator[str]:
    """Yield the PSNR of held-out and training views in words: of each scene, or the mean over several and the worst."""
    rows = {scene.views.scene: _psnr_text(scene) for scene in study.scenes}
    if len(study.scenes) > 1:
        means = [_mean_over_scenes([scene.mean(test=test) for scene in study.scenes]) for test in (True, False)]
        texts = [
            f"{_format(mean.psnr, _METRICS[0])} dB for {kind} views"
            for mean, kind in zip(means, ("held-out", "training"), strict=True)
            if mean is not None
        ]
        if texts:
            yield f"Mean PSNR over {len(study.scenes)} scenes: {', '.join(texts)}."
    yield from (f"{name}: {text}." for name, text in rows.items())


def _psnr_text(scene: ScoredScene) -> str:
    parts = []
    for test, kind in ((True, "held-out"), (False, "training")):
        if (mean := scene.mean(test=test)) is not None:
            error = scene.standard_error() if test else None
            around = "" if error is None else f" ± {error:.2f}"
            count = len(scene.select(test=test))
            parts.append(f"{_format(mean.psnr, _METRICS[0])}{around} dB for {pluralize(count, f'{kind} view')}")
    return f"PSNR of {', '.join(parts)}"


def sentences(study: ViewStudy) -> list[str]:
    """Return the notes on the table."""
    return [*legend(study), *(f"note: {text}" for text in warnings(study))]


def legend(study: ViewStudy) -> list[str]:
    """Return what the columns of the table mean."""
    perceptual = any(s.lpips is not None or s.flip is not None for scene in study.scenes for s in scene.scores)
    lines = [
        "means over views; PSNR in dB and SSIM: higher is better" + ("; LPIPS and FLIP: lower is better" * perceptual),
    ]
    if any(scene.standard_error() is not None for scene in study.scenes):
        lines.append("±: one standard error, from the means of blocks of held-out views")
    return lines


def warnings(study: ViewStudy) -> list[str]:
    """Return what was not held out, and what could not be measured."""
    lines = []
    if bare := [scene.views.scene for scene in study.scenes if not scene.select(test=True)]:
        lines.append(f"no view of {', '.join(bare)} was held out: scores of training views say little about new views")
    return [*lines, *(note.text for note in study.notes)]


def _cells(
    means: Sequence[ViewScores | None], metrics: Sequence[_Metric], scene: ScoredScene | None = None
) -> Iterator[str]:
    error = None if scene is None else scene.standard_error()
    for number, mean in enumerate(means):
        for metric in metrics:
            value = None if mean is None else getattr(mean, metric.field)
            of_error = error is not None and number == 1 and metric.field == "psnr"
            yield _format(value, metric) + (f" ± {error:.2f}" if of_error else "")


def _format(value: float | None, metric: _Metric) -> str:
    if value is None or math.isnan(value):
        return _DASH
    return "∞" if math.isinf(value) else f"{value:.{metric.decimals}f}"


def _mean_over_scenes(means: Sequence[ViewScores | None]) -> ViewScores | None:
    """Return the mean over scenes, or None if some scene has no such views."""
    there = [mean for mean in means if mean is not None]
    return mean_scores(there) if len(there) == len(means) else None
