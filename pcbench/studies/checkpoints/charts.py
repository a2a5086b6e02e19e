"""The pictures of `pcbench checkpoints`: errors by point with their histogram, and a map."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from pcbench.extras import require
from pcbench.geometry.arrays import FloatArray
from pcbench.measure.checkpoints import PointError
from pcbench.measure.wording import pluralize
from pcbench.report.colors import SERIES
from pcbench.report.figures import Figures, ink
from pcbench.report.plot import Drawer, Picture
from pcbench.report.plot.panels import drawing_style
from pcbench.report.plot.plan_marks import draw_north_arrow, draw_scale_bar
from pcbench.report.words import length_number, printable
from pcbench.studies.checkpoints.results import KIND, PLAN, CheckPointStudy
from pcbench.studies.frame.canvas import GREY, blank_figure, chart_pictures, open_frame, save_charts

# Draws the pictures of a study's folder.
PICTURES = Drawer(f"{__name__}:pictures", (KIND.document,))

_COLORS = {False: SERIES[0], True: SERIES[1]}
_LABELS = {False: "non-vegetated", True: "vegetated"}
_MAX_NAMES = 40  # beside points in the chart and on the map
_MAP_SIDE = 7.0  # of the longer side, in inches
_MAX_ASPECT = 3.0


def pictures(folder: Path, look: Figures) -> dict[str, Picture]:
    """Return the pictures of a folder that `pcbench checkpoints` wrote."""
    return chart_pictures(lambda: _charts(folder, look), look)


def draw_charts(folder: Path, look: Figures) -> list[Path]:
    """Draw the pictures of a study's folder, and return the files.

    Raises:
        MissingExtra: matplotlib is not installed.
        OSError: a file cannot be read or written.
    """
    require("matplotlib.figure")
    with drawing_style(look):
        return save_charts(folder, _charts(folder, look))


def _charts(folder: Path, look: Figures) -> Iterator[tuple[str, Any]]:
    study = KIND.read(folder)
    dark = ink(look.ground("white"))
    if study.accuracy.covered:
        yield "errors", _errors(study, dark)
    yield "map", _map(study, np.load(folder / PLAN, allow_pickle=False).astype(np.float64), dark)


def _errors(study: CheckPointStudy, dark: str) -> Any:
    """Draw the error at each point with bands of the RMSE of each class, and the histogram."""
    accuracy = study.accuracy
    points = sorted(accuracy.covered, key=lambda point: point.vegetated)
    unit = accuracy.unit or "units"
    figure = blank_figure((11, 4.6))
    axis, histogram = figure.subplots(1, 2, sharey=True, width_ratios=[3.4, 1])
    places = np.arange(1, len(points) + 1)
    errors = np.array([point.dz for point in points], dtype=np.float64)
    for vegetated, group in ((False, accuracy.nva), (True, accuracy.vva)):
        rows = np.array([k for k, point in enumerate(points) if point.vegetated == vegetated], dtype=int)
        if group is None:
            continue
        color, rmse = _COLORS[vegetated], group.errors.rmse
        low, high = places[rows[0]] - 0.5, places[rows[-1]] + 0.5
        axis.fill_between([low, high], -rmse, rmse, color=color, alpha=0.12, linewidth=0)
        axis.hlines(group.errors.mean, low, high, color=color, linestyle="--", linewidth=1)
        axis.vlines(places[rows], 0, errors[rows], color=color, linewidth=1.4)
        label = f"{_LABELS[vegetated]}: RMSE {length_number(rmse)}, bias {group.errors.mean:+.3g} (dashed)"
        axis.plot(places[rows], errors[rows], "o", color=color, markersize=5, label=label.replace("-0", "−0"))
    outliers = [k for k, point in enumerate(points) if point.is_outlier]
    if outliers:
        axis.plot(places[outliers], errors[outliers], "o", color=dark, markersize=11, fillstyle="none", label="outlier")
    names = [printable(point.name) for point in points]
    if len(points) <= _MAX_NAMES:
        axis.set_xticks(places, names, rotation=90, fontsize=8, parse_math=False)
    else:
        axis.set_xlabel("covered check point, in the order of the file and by class")
    axis.axhline(0, color=dark, linewidth=0.9)
    axis.set_ylabel(f"error of height, cloud − survey [{unit}]")
    axis.set_title("Error at each check point; shaded: ± RMSE", fontsize=11, loc="left")
    axis.margins(x=0.02)
    bins = np.histogram_bin_edges(errors, max(5, min(24, round(2 * len(errors) ** 0.5))))
    groups = [[p.dz for p in points if p.vegetated == vegetated] for vegetated in (False, True)]
    histogram.hist(groups, bins, stacked=True, orientation="horizontal", color=list(_COLORS.values()), alpha=0.85)
    histogram.axhline(0, color=dark, linewidth=0.9)
    histogram.set_xlabel("number of check points")
    histogram.set_title("Histogram", fontsize=11, loc="left")
    histogram.xaxis.get_major_locator().set_params(integer=True)
    for panel in (axis, histogram):
        panel.grid(axis="y", alpha=0.25)
        open_frame(panel)
    figure.legend(*axis.get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False, fontsize=9)
    return figure


def _map(study: CheckPointStudy, heights: FloatArray, dark: str) -> Any:
    """Draw the errors as coloured symbols on the shaded relief of the cloud, with a scale bar and north."""
    from matplotlib.colors import LightSource, Normalize

    accuracy, (west, south, east, north) = study.accuracy, study.extent
    points, unit = accuracy.points, study.accuracy.unit or "units"
    places = np.array([(point.x, point.y) for point in points])
    near = _near(places, study.extent)
    low = np.minimum([west, south], places[near].min(axis=0, initial=np.inf))
    high = np.maximum([east, north], places[near].max(axis=0, initial=-np.inf))
    margin = 0.04 * float((high - low).max()) or 1.0
    low, high = low - margin, high + margin
    size = high - low
    sides = np.clip(size / size.max(), 1 / _MAX_ASPECT, 1.0) * _MAP_SIDE
    figure = blank_figure((float(sides[0]) + 1.9, float(sides[1]) + 1.0))
    axis = figure.subplots()
    axis.set_facecolor("none")
    cell = (east - west) / heights.shape[1] or 1.0
    shade = LightSource(315, 45).hillshade(_filled(heights), dx=cell, dy=cell)
    grey = np.where(np.isnan(heights), np.nan, 0.45 + 0.5 * shade)
    extent = (west, east, south, north)
    axis.imshow(grey, cmap="gray", vmin=0, vmax=1, origin="lower", extent=extent, interpolation="nearest")
    covered = [k for k, point in enumerate(points) if point.dz is not None]
    errors = np.array([points[k].dz for k in covered], dtype=np.float64)
    limit = max(float(np.quantile(np.abs(errors), 0.95)) if covered else 0.0, 1e-9)
    for vegetated, marker in ((False, "o"), (True, "^")):
        rows = [k for k in range(len(covered)) if points[covered[k]].vegetated == vegetated]
        if rows:
            axis.scatter(
                *places[[covered[k] for k in rows]].T,
                c=errors[rows],
                cmap="coolwarm",
                norm=Normalize(-limit, limit),
                s=64,
                marker=marker,
                edgecolors=dark,
                linewidths=0.9,
                label=_LABELS[vegetated],
                zorder=3,
            )
    missing = [k for k in range(len(points)) if points[k].dz is None and near[k]]
    if missing:
        style = {"facecolors": "none", "edgecolors": dark, "linewidths": 1.1, "marker": "s", "s": 52, "zorder": 3}
        axis.scatter(*places[missing].T, label="not covered", **style)
    _name_points(axis, points, places, near, dark)
    if covered:
        from matplotlib.cm import ScalarMappable

        scale = ScalarMappable(Normalize(-limit, limit), "coolwarm")
        bar = figure.colorbar(scale, ax=axis, extend="both", aspect=30, pad=0.02)
        bar.set_label(f"error of height, cloud − survey [{unit}]")
    axis.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    axis.set_xlabel(f"x (east) [{unit}]")
    axis.set_ylabel(f"y (north) [{unit}]")
    axis.ticklabel_format(useOffset=False, style="plain")
    axis.tick_params(labelsize=8)
    axis.locator_params(nbins=5)
    draw_scale_bar(axis, unit)
    draw_north_arrow(axis)
    figure.legend(loc="outside lower center", ncols=3, frameon=False, fontsize=9)
    if not all(near):
        outside = pluralize(int((~near).sum()), "check point")
        axis.set_title(f"{outside} far from the cloud not shown", fontsize=9, color=GREY, loc="left")
    return figure


def _filled(heights: FloatArray) -> FloatArray:
    """Return heights (rows, columns) with the nearest height in each void, so that the relief has no walls there."""
    from scipy.ndimage import distance_transform_edt

    rows, columns = distance_transform_edt(np.isnan(heights), return_distances=False, return_indices=True)
    return np.asarray(heights[rows, columns])


def _near(places: FloatArray, extent: tuple[float, float, float, float]) -> Any:
    """Return which check points (N,) lie on the cloud, or at most half its size beside it."""
    low, high = np.array(extent[:2]), np.array(extent[2:])
    reach = 0.5 * float((high - low).max())
    return ((places >= low - reach) & (places <= high + reach)).all(axis=1)


def _name_points(axis: Any, points: tuple[PointError, ...], places: FloatArray, near: Any, dark: str) -> None:
    """Write the names of check points: of all, if they are few, otherwise of outliers and uncovered ones."""
    for point, place, is_near in zip(points, places, near, strict=True):
        if is_near and (len(points) <= _MAX_NAMES or point.is_outlier or point.dz is None):
            text = printable(point.name)
            style = {"xytext": (6, 5), "textcoords": "offset points", "fontsize": 7.5, "color": dark}
            axis.annotate(text, place, parse_math=False, zorder=4, **style)
