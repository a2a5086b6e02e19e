"""The page of a training: what the model renders beside the photograph, and its PSNR and size over the steps."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from pathlib import Path

from pcbench.report.colors import SERIES
from pcbench.report.html.charts import CurveChart, Series, Tick
from pcbench.report.html.template import Opening, Origin, render
from pcbench.report.plot.rounding import round_length
from pcbench.scenes.previews import PHOTOGRAPH, RENDERING, Preview, Progress

REFRESH_S = 10


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
    note = "held out" if preview.is_held_out else "trained on"
    pictures = [
        {"title": title, "note": f"{preview.view}, {note}", "data": _data(folder / file)}
        for title, file in (("rendering", RENDERING), ("photograph", PHOTOGRAPH))
    ]
    return render(
        "training.html",
        Opening("Training", "Gaussian splatting", "", [preview.sentence, f"{last} In a window: {command}"]),
        Origin(None),
        refresh_s=REFRESH_S if running else None,
        pictures=pictures,
        charts=_charts(preview.history),
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
