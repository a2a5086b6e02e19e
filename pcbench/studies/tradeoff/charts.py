"""The charts of the trade-off study: error beside CPU seconds by metric, and bias against the share of kept points."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from pcbench.extras import require
from pcbench.report.colors import SERIES
from pcbench.report.figures import Figures
from pcbench.report.plot import Drawer, Picture
from pcbench.studies.frame.canvas import (
    GREY,
    canvas,
    chart_pictures,
    delete_former_charts,
    legend,
    plain_log_ticks,
    save_charts,
)
from pcbench.studies.tradeoff.approximations import (
    BOTH,
    CANDIDATE,
    DECIMATION,
    DISK,
    FLOAT32,
    ICP,
    NORMALS,
    RANDOM,
    REFERENCE,
    SEARCH,
    THINNING,
    VOXEL,
)
from pcbench.studies.tradeoff.errors import front
from pcbench.studies.tradeoff.metrics import NAMES, TITLES
from pcbench.studies.tradeoff.results import KIND, Tradeoff, TradeoffRow

_COLORS = dict(zip((RANDOM, VOXEL, DISK, FLOAT32, SEARCH, NORMALS, ICP, DECIMATION), (*SERIES, "#000000"), strict=True))
_MARKERS = {CANDIDATE: "o", REFERENCE: "s", BOTH: "D", "": "^"}
_SIDE_LABELS = {CANDIDATE: "candidate thinned", REFERENCE: "reference thinned", BOTH: "both thinned"}
_COLUMNS = 3
# Cloud to which each mean distance is measured: thinning it makes the distance larger.
_SEARCHED = {"mean c→r": REFERENCE, "mean r→c": CANDIDATE}
_LINEAR_PERCENT = 10  # biases below it are drawn on a linear scale, larger ones on a logarithmic one
_BIAS_TICKS = (-100.0, -50.0, -20.0, -10.0, -5.0, 0.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0, 500.0, 1000.0)
_LEAST_ERROR = 1e-5  # 0.001 %: smaller errors are drawn there


# Draws the charts of a study's folder.
PICTURES = Drawer(f"{__name__}:pictures", (KIND.document,))


def pictures(folder: Path, look: Figures) -> dict[str, Picture]:
    """Return the charts of a folder that `pcbench tradeoff` wrote."""
    study = KIND.read(folder)
    return chart_pictures(lambda: _charts(study), look)


def draw_charts(study: Tradeoff, folder: Path) -> list[Path]:
    """Draw all charts of a study into `figures/` of its folder, and return the written files.

    Raises:
        MissingExtra: matplotlib is not installed.
        OSError: a file cannot be written.
    """
    require("matplotlib.figure")
    files = save_charts(folder, _charts(study))
    delete_former_charts(folder, files)
    return files


def _charts(study: Tradeoff) -> Iterator[tuple[str, Any]]:
    if any(error for row in study.rows for error in row.errors.values()):
        yield "errors", errors_chart(study)
    if any(_thinned_rows(study, name, side, kind) for name, side in _SEARCHED.items() for kind in THINNING):
        yield "bias", bias_chart(study)


def errors_chart(study: Tradeoff) -> Any:
    """Return the chart of error bounds beside CPU seconds: one panel per metric, with its Pareto front."""
    names = [name for name in NAMES if study.exact.values.get(name) and any(row.errors.get(name) for row in study.rows)]
    figure, axes = canvas(-(-len(names) // _COLUMNS), _COLUMNS, (4.2, 2.9), extra=1.1)
    for axis in axes.ravel()[len(names) :]:
        axis.set_axis_off()
    for axis, name in zip(axes.ravel(), names, strict=False):
        _error_panel(axis, study, name)
    figure.supylabel("relative error [%], which one run exceeds in 5 % of cases", fontsize=10)
    legend(figure, axes.ravel(), note="large markers: more points kept")
    return figure


def _error_panel(axis: Any, study: Tradeoff, name: str) -> None:
    axis.set_xscale("log")
    axis.set_yscale("log")
    for row in study.rows:
        if (error := row.errors.get(name)) is None:
            continue
        size = 3.5 + 4.5 * row.level if row.family in THINNING or row.family == DECIMATION else 6
        marker = _MARKERS[row.side] if row.family in THINNING else _MARKERS[""]
        y = 100 * max(error.bound, _LEAST_ERROR)
        style = {"color": _COLORS[row.family], "markersize": size, "linestyle": "none", "alpha": 0.85}
        axis.plot(row.cpu_s, y, marker=marker, **style)
    for family in dict.fromkeys(row.family for row in study.rows):
        marker = _MARKERS[CANDIDATE if family in THINNING else ""]
        axis.plot([], [], marker=marker, color=_COLORS[family], linestyle="none", label=family)
    for side, text in _SIDE_LABELS.items():
        axis.plot([], [], marker=_MARKERS[side], color=GREY, linestyle="none", markerfacecolor="white", label=text)
    best = front(study.rows, name)
    bounds = [100 * max(error.bound, _LEAST_ERROR) for row in best if (error := row.errors[name]) is not None]
    axis.step(
        [row.cpu_s for row in best], bounds, where="post", color=GREY, linewidth=1.0, zorder=0, label="Pareto front"
    )
    axis.axhline(100 * study.settings.tolerance, color=GREY, linestyle=":", linewidth=1.2, label="tolerance")
    axis.axvline(study.exact.cpu_s, color=GREY, linestyle="--", linewidth=1.2, label="exact comparison")
    axis.set_title(TITLES[name], fontsize=10)
    axis.grid(alpha=0.25)
    low, high = axis.get_ylim()
    axis.set_ylim(max(low, 60 * _LEAST_ERROR), high)
    axis.set_xlabel("CPU seconds", fontsize=9)
    plain_log_ticks(axis.xaxis)
    plain_log_ticks(axis.yaxis)
    axis.tick_params(labelsize=8)


def bias_chart(study: Tradeoff) -> Any:
    """Return the chart of the signed error of mean distances against the share of kept points, one panel for each."""
    figure, axes = canvas(1, 2, (5.2, 3.6), extra=0.9)
    for axis, (name, side) in zip(axes[0], _SEARCHED.items(), strict=True):
        axis.axhline(0, color=GREY, linewidth=1)
        axis.set_xscale("log")
        for number, kind in enumerate(THINNING):
            rows = _thinned_rows(study, name, side, kind)
            for errors, line, fill, label in (
                ("errors", "-", True, kind),
                ("corrected", "--", False, f"{kind}, corrected"),
            ):
                _bias_curve(axis, rows, errors, name, (line, fill, _COLORS[kind], 1 + 0.03 * (number - 1)), label)
        axis.set_title(f"{TITLES[name]}, {side} thinned", fontsize=10)
        axis.set_xlabel("points kept [%]")
        axis.set_ylabel("error [%]")
        axis.set_yscale("symlog", linthresh=_LINEAR_PERCENT)
        _set_ticks(axis.yaxis, [tick for tick in _BIAS_TICKS if axis.get_ylim()[0] <= tick <= axis.get_ylim()[1]], "+g")
        _set_ticks(axis.xaxis, [100 * level for level in study.settings.levels], "g")
        axis.grid(alpha=0.25)
    legend(figure, axes.ravel(), note="bars: 95 % prediction interval of one run")
    return figure


def _set_ticks(axis: Any, ticks: list[float], form: str) -> None:
    axis.set_ticks(ticks, labels=[format(tick, form) if tick else "0" for tick in ticks])
    axis.set_ticks([], minor=True)


def _bias_curve(
    axis: Any, rows: list[TradeoffRow], kind: str, name: str, style: tuple[str, bool, str, float], label: str
) -> None:
    line, is_filled, color, shift = style
    points = [(row.level, error) for row in rows if (error := getattr(row, kind).get(name)) is not None]
    if not points:
        return
    x = [100 * shift * level for level, _ in points]
    y = [100 * error.mean for _, error in points]
    bars = [[100 * (e.mean - e.low) for _, e in points], [100 * (e.high - e.mean) for _, e in points]]
    fill = {"markerfacecolor": color if is_filled else "white"}
    axis.errorbar(x, y, bars, color=color, linestyle=line, marker="o", markersize=5, capsize=2, label=label, **fill)


def _thinned_rows(study: Tradeoff, name: str, side: str, kind: str) -> list[TradeoffRow]:
    """Return the thinnings of one cloud alone, or of both if there are none, by level."""
    for which in (side, BOTH):
        rows = [row for row in study.rows if row.family == kind and row.side == which and row.errors.get(name)]
        if rows:
            return sorted(rows, key=lambda row: row.level)
    return []
