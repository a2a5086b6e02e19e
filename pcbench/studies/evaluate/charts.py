"""The chart of an evaluation: mean scores against mean time of each method."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from statistics import fmean
from typing import Any

from pcbench.extras import require
from pcbench.report.colors import SERIES
from pcbench.report.figures import Figures
from pcbench.report.plot import Drawer, Picture
from pcbench.studies.evaluate.results import KIND, MethodComparison, ScoreColumn
from pcbench.studies.evaluate.table import heading
from pcbench.studies.frame.canvas import (
    GREY,
    canvas,
    chart_pictures,
    delete_former_charts,
    legend,
    plain_log_ticks,
    save_charts,
)

TIME = "time"
_MAX_PANELS = 6
_COLUMNS = 3
_MARKERS = "osD^v"  # of methods whose colours are the same

# Draws the chart of a study's folder.
PICTURES = Drawer(f"{__name__}:pictures", (KIND.document,))


def pictures(folder: Path, look: Figures) -> dict[str, Picture]:
    """Return the chart of a folder that `pcbench evaluate` wrote, if it has times."""
    study = KIND.read(folder)
    return chart_pictures(lambda: _charts(study), look)


def draw_charts(study: MethodComparison, folder: Path) -> list[Path]:
    """Draw the chart into `figures/` of a folder if there are times, and return the written files.

    Raises:
        MissingExtra: matplotlib is not installed.
        OSError: a file cannot be written.
    """
    if not has_times(study):
        delete_former_charts(folder, ())
        return []
    require("matplotlib.figure")
    files = save_charts(folder, _charts(study))
    delete_former_charts(folder, files)
    return files


def has_times(study: MethodComparison) -> bool:
    """Return whether a method has a time and a mean."""
    return any(mean.mean is not None and mean.method in mean_times(study) for mean in study.means)


def mean_times(study: MethodComparison) -> dict[str, float]:
    """Return the mean time of each method over its scenes, in seconds, without methods that have no time."""
    times = {m: [p.seconds for p in study.pairs if p.method == m and p.seconds is not None] for m in study.methods}
    return {method: fmean(values) for method, values in times.items() if values}


def panels(study: MethodComparison) -> list[ScoreColumn]:
    """Return the scores of the chart: the first chosen ones of which lower or higher values are better."""
    return [column for column in study.chosen_columns if column.better is not None][:_MAX_PANELS]


def _charts(study: MethodComparison) -> Iterator[tuple[str, Any]]:
    if has_times(study) and panels(study):
        yield TIME, time_chart(study)


def time_chart(study: MethodComparison) -> Any:
    """Return the chart of mean scores against mean seconds: one panel for each score, with its Pareto front."""
    columns = panels(study)
    width = min(_COLUMNS, len(columns))
    figure, axes = canvas(-(-len(columns) // width), width, (4.2, 3.2), extra=0.9)
    for axis in axes.ravel()[len(columns) :]:
        axis.set_axis_off()
    for axis, column in zip(axes.ravel(), columns, strict=False):
        _draw_panel(axis, study, column)
    legend(figure, axes.ravel(), note="means over scenes; line: best score for its time")
    return figure


def _draw_panel(axis: Any, study: MethodComparison, column: ScoreColumn) -> None:
    axis.set_xscale("log")
    times, sign = mean_times(study), 1 if column.better == "lower" else -1
    means = {mean.method: mean.mean for mean in study.means_of(column.name) if mean.mean is not None}
    points = {method: (times[method], means[method]) for method in study.methods if method in times and method in means}
    for number, method in enumerate(study.methods):
        if method in points:
            style = {"color": SERIES[number % len(SERIES)], "marker": _MARKERS[number // len(SERIES) % len(_MARKERS)]}
            axis.plot(*points[method], linestyle="none", markersize=7, label=method, **style)
    front: list[tuple[float, float]] = []
    for seconds, value in sorted(points.values(), key=lambda point: (point[0], sign * point[1])):
        if not front or sign * value < sign * front[-1][1]:
            front.append((seconds, value))
    if front:
        axis.step(*zip(*front, strict=True), where="post", color=GREY, linewidth=1.0, zorder=0)
    axis.set_title(heading(column), fontsize=10)
    axis.set_xlabel("seconds")
    axis.margins(0.12)
    axis.grid(alpha=0.25)
    plain_log_ticks(axis.xaxis)
    axis.tick_params(labelsize=8)
