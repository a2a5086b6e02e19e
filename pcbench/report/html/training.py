"""The page of a training: what the model renders beside the photograph, and its PSNR and size over the steps."""

from __future__ import annotations

import base64
import math
from collections.abc import Sequence
from pathlib import Path

from pcbench.report.colors import SERIES
from pcbench.report.html.charts import CurveChart, Series, Tick
from pcbench.report.html.template import Opening, Origin, render
from pcbench.report.plot.rounding import round_length
from pcbench.scenes.previews import PHOTOGRAPH, RENDERING, Preview, Progress, SizeScore

REFRESH_S = 10
_HALF_MARK = 5  # half the length of the mark of a score, in SVG units
_DEGREE_SHIFT = 4  # between models of the same number of Gaussians


def training_page(preview: Preview, folder: Path, command: str, *, running: bool) -> str:
    """Return the page of a training.

    Args:
        preview: the training.
        folder: folder of the preview, with its pictures.
        command: command that shows the model in a window.
        running: whether the training goes on, so that the page is loaded again from time to time.

    Raises:
        OSError: a picture cannot be read.
    """
    last = "This page is loaded again every 10 s." if running else "The training has ended."
    sentences = [*filter(None, (preview.sentence, preview.decision)), f"{last} In a window: {command}"]
    note = "held out" if preview.is_held_out else "trained on"
    pictures = [
        {"title": title, "note": f"{preview.view}, {note}", "data": _data(folder / file)}
        for title, file in (("rendering", RENDERING), ("photograph", PHOTOGRAPH))
    ]
    return render(
        "training.html",
        Opening("Training", "Gaussian splatting", "", sentences),
        Origin(None),
        refresh_s=REFRESH_S if running else None,
        pictures=pictures,
        charts=_charts(preview.history),
        size_charts=_size_charts(preview.sizes),
    )


def _data(path: Path) -> str:
    return f"data:image/png;base64,{base64.b64encode(path.read_bytes()).decode()}"


def _charts(history: Sequence[Progress]) -> list[CurveChart]:
    """Return the charts of PSNR and of the number of Gaussians; none before the second state."""
    if len(history) < 2:
        return []
    scores = {"training photographs": [row.psnr for row in history]}
    if history[-1].held_out_psnr is not None:
        scores["held-out photographs"] = [row.held_out_psnr or 0.0 for row in history]
    steps = [row.done for row in history]
    label = "steps" if history[-1].done == history[-1].step else "steps, with those of models that were given up"
    return [
        _chart("PSNR", "dB", label, steps, scores),
        _chart(
            "Gaussians",
            "number",
            label,
            steps,
            {"Gaussians": [float(row.gaussians) for row in history]},
            from_zero=True,
        ),
    ]


def _size_charts(sizes: Sequence[SizeScore]) -> list[CurveChart]:
    """Return a chart of each score of the models that were tried, over their numbers of Gaussians."""
    return [
        _size_chart(metric, [s for s in sizes if s.metric == metric]) for metric in dict.fromkeys(s[2] for s in sizes)
    ]


def _size_chart(metric: str, sizes: Sequence[SizeScore]) -> CurveChart:
    """Return a chart with a cross for each model: its score, and the interval of its difference from the best."""
    name, _, unit = metric.partition(", ")
    counts = sorted({size.gaussians for size in sizes})
    y_ticks = _round_ticks(min(size.low for size in sizes), max(size.high for size in sizes))
    low, high = y_ticks[0], y_ticks[-1]
    span = math.log(counts[-1] / counts[0]) or 1.0

    def x(count: int) -> float:
        return CurveChart.left + (CurveChart.right - CurveChart.left) * (0.1 + 0.8 * math.log(count / counts[0]) / span)

    def y(value: float) -> float:
        return CurveChart.bottom - (CurveChart.bottom - CurveChart.top) * (value - low) / (high - low)

    paths: dict[str, str] = {}
    for size in sizes:
        label = "chosen" if size.chosen else f"degree {size.degree}"
        column = x(size.gaussians) + _DEGREE_SHIFT * size.degree
        interval = f"M{column:.1f} {y(size.low):.1f}V{y(size.high):.1f}"
        mean = f"M{column - _HALF_MARK:.1f} {y(size.score):.1f}H{column + _HALF_MARK:.1f}"
        paths[label] = paths.get(label, "") + interval + mean
    series = [Series(label, color, path) for (label, path), color in zip(paths.items(), SERIES, strict=False)]
    x_ticks = [Tick(x(count), _short(count)) for count in counts]
    title = f"{name} of held-out photographs, with 95 % intervals of the difference from the best"
    return CurveChart(
        title,
        "Gaussians",
        unit,
        series,
        x_ticks,
        [Tick(y(tick), f"{tick:g}".removeprefix("0") or "0") for tick in y_ticks],
        [],
    )


def _chart(
    title: str, unit: str, label: str, steps: Sequence[int], curves: dict[str, list[float]], *, from_zero: bool = False
) -> CurveChart:
    values = [value for curve in curves.values() for value in curve]
    x_ticks, y_ticks = _round_ticks(steps[0], steps[-1]), _round_ticks(0 if from_zero else min(values), max(values))
    low, high = y_ticks[0], y_ticks[-1]

    def x(step: float) -> float:
        return CurveChart.left + (CurveChart.right - CurveChart.left) * (step - steps[0]) / max(steps[-1] - steps[0], 1)

    def y(value: float) -> float:
        return CurveChart.bottom - (CurveChart.bottom - CurveChart.top) * (value - low) / (high - low)

    series = [
        Series(name, color, "M" + "L".join(f"{x(s):.1f} {y(v):.1f}" for s, v in zip(steps, curve, strict=True)))
        for (name, curve), color in zip(curves.items(), SERIES, strict=False)
    ]
    inside = [tick for tick in x_ticks if steps[0] <= tick <= steps[-1]]
    return CurveChart(
        title,
        label,
        unit,
        series,
        [Tick(x(tick), _short(tick)) for tick in inside],
        [Tick(y(tick), _short(tick)) for tick in y_ticks],
        [],
    )


def _round_ticks(low: float, high: float) -> list[float]:
    """Return evenly spaced round values that include both ends."""
    step = round_length(max(high - low, 1e-3 * max(abs(high), 1.0)) / 3)
    first = int(low // step)
    last = max(first + 1, -int(-high // step))
    return [k * step for k in range(first, last + 1)]


def _short(value: float) -> str:
    return f"{value / 1000:g}k" if value >= 1000 else f"{value:g}"
