"""The pictures of a change, drawn from its folder: plan views, errors, volumes, profiles and series."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial
from operator import attrgetter
from pathlib import Path
from typing import Any

from pcbench.report.change.article import SHEETS
from pcbench.report.change.charts import draw_profile, draw_series, draw_volumes, series_panels
from pcbench.report.change.document import ChangeDocument, ChangeRecord
from pcbench.report.change.layers import PlanLayers, change_range, read_document, read_layers, trend_layers
from pcbench.report.change.plan import color_bar, draw_plan, draw_raster
from pcbench.report.change.sheets import write_sheets
from pcbench.report.change.words import epoch_text
from pcbench.report.colors import Range, robust_maximum
from pcbench.report.figures import Figures
from pcbench.report.plot import Picture
from pcbench.report.plot.panels import new_figure, save
from pcbench.report.words import printable

_LONG_EDGE, _MIN_EDGE = 8.2, 2.6  # of a plan view, in inches
_LEFT, _RIGHT, _BELOW, _ABOVE = 0.75, 1.15, 0.65, 0.5  # margins of a plan view, in inches


PlanReader = Callable[[str], PlanLayers]


def pictures(folder: Path, look: Figures) -> dict[str, Picture]:
    """Return the pictures of a folder that `pcbench change` wrote."""
    document = read_document(folder)
    layers = cache(partial(read_layers, folder))
    # Each epoch has the same colours, so that their maps can be compared.
    colors = max(
        (change_range(layers(change.epoch), look.range) for change in document.changes), key=attrgetter("high")
    )
    result: dict[str, Picture] = {}
    for change in document.changes:
        result[f"plan_{change.epoch}"] = Picture(partial(_plan, document, change, layers, look, colors))
        result[f"volumes_{change.epoch}"] = Picture(partial(_volumes, document, change), "there are no parts or zones")
        result[f"sigma_{change.epoch}"] = Picture(partial(_sigma, document, change, layers, look))
    for number in range(1, len(document.profiles) + 1):
        result[f"profile_{number}"] = Picture(partial(_profile, document, number))
    if len(document.changes) > 1 or document.places:
        result["series"] = Picture(partial(_series, document))
    if document.trend is not None:
        result["trend"] = Picture(partial(_trend, document, folder, look))
    result["sheets"] = Picture(partial(write_sheets, document, layers, colors), file=SHEETS)
    return result


def _plan(
    document: ChangeDocument, change: ChangeRecord, layers: PlanReader, look: Figures, scale: Range, path: Path
) -> bool:
    plan = layers(change.epoch)
    figure, axis, bar = _map_figure(plan)
    draw_plan(axis, document, plan, scale, ground=look.ground("white"))
    axis.set_title(_title(document, change), fontsize=11, parse_math=False)
    unit = f" [{document.unit}]" if document.unit else ""
    level = None if change.errors is None else change.errors.median_level
    color_bar(bar, scale, f"change of height{unit}; red: raised, blue: lowered", level=level)
    save(figure, path)
    return True


def _sigma(document: ChangeDocument, change: ChangeRecord, layers: PlanReader, look: Figures, path: Path) -> bool:
    plan = layers(change.epoch)
    values = plan.sigma[plan.sigma == plan.sigma]
    if not len(values):
        return False
    low, high = float(values.min()), robust_maximum(values)
    scale = Range(low, max(high, low * (1 + 1e-6), low + 1e-12))
    figure, axis, bar = _map_figure(plan)
    draw_raster(axis, plan.sigma, plan, scale, document.unit, ground=look.ground("white"))
    axis.set_title(f"Standard deviation of the change to {printable(change.epoch)}", fontsize=11, parse_math=False)
    color_bar(bar, scale, "standard deviation of a cell" + (f" [{document.unit}]" if document.unit else ""))
    save(figure, path)
    return True


def _trend(document: ChangeDocument, folder: Path, look: Figures, path: Path) -> bool:
    assert document.trend is not None
    plan = trend_layers(folder)
    scale = change_range(plan, None)
    figure, axis, bar = _map_figure(plan)
    draw_plan(axis, document, plan, scale, ground=look.ground("white"))
    per = "year" if document.trend.is_per_year else "epoch"
    axis.set_title(f"Trend over {len(document.epochs)} epochs", fontsize=11)
    color_bar(bar, scale, f"rate [{document.unit or 'units'} per {per}]; red: rising, blue: falling")
    save(figure, path)
    return True


def _volumes(document: ChangeDocument, change: ChangeRecord, path: Path) -> bool:
    rows = min(len(change.zones) + len(change.parts), 14)
    if not rows:
        return False
    figure = new_figure(8.6, 1.1 + 0.34 * rows)
    height = figure.get_figheight()
    axis = figure.add_axes((0.16, 0.62 / height, 0.81, 1 - 1.05 / height))
    draw_volumes(axis, document, change, most=rows)
    axis.set_title(_title(document, change), fontsize=11, loc="left", parse_math=False)
    save(figure, path)
    return True


def _profile(document: ChangeDocument, number: int, path: Path) -> bool:
    figure = new_figure(9.2, 4.4)
    axes = figure.subplots(
        2, 1, sharex=True,
        gridspec_kw={"height_ratios": (3, 2), "left": 0.09, "right": 0.97, "top": 0.92, "bottom": 0.12, "hspace": 0.08},
    )  # fmt: skip
    draw_profile(axes, document, number)
    save(figure, path)
    return True


def _series(document: ChangeDocument, path: Path) -> bool:
    count = series_panels(document)
    figure = new_figure(8.6, 0.5 + 2.9 * count)
    height = figure.get_figheight()
    axes = figure.subplots(
        count, 1, squeeze=False, sharex=True,
        gridspec_kw={"left": 0.11, "right": 0.97, "top": 1 - 0.35 / height, "bottom": 0.6 / height, "hspace": 0.1},
    )[:, 0]  # fmt: skip
    draw_series(list(axes), document)
    save(figure, path)
    return True


def _title(document: ChangeDocument, change: ChangeRecord) -> str:
    later = next(epoch for epoch in document.epochs[1:] if epoch.name == change.epoch)
    return printable(f"{epoch_text(document.epochs[0])} → {epoch_text(later)}")


def _map_figure(plan: PlanLayers) -> tuple[Any, Any, Any]:
    """Return a figure with axes for a map in its proportions, and axes for its colour bar."""
    width, height = plan.east - plan.west, plan.north - plan.south
    scale = _LONG_EDGE / max(width, height)
    wide, high = max(width * scale, _MIN_EDGE), max(height * scale, _MIN_EDGE)
    total, tall = wide + _LEFT + _RIGHT, high + _BELOW + _ABOVE
    figure = new_figure(total, tall)
    axis = figure.add_axes((_LEFT / total, _BELOW / tall, wide / total, high / tall))
    bar_height = min(high, 4.2)
    bar = figure.add_axes(
        ((_LEFT + wide + 0.22) / total, (_BELOW + 0.5 * (high - bar_height)) / tall, 0.2 / total, bar_height / tall)
    )
    return figure, axis, bar
