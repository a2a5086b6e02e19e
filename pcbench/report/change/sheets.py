"""Sheets of a change to hand in, as a PDF of A4 pages: the plan with its volumes first, then profiles and parts."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from textwrap import wrap
from typing import Any

from pcbench.report.change.charts import draw_profile, draw_series, draw_volumes, series_panels
from pcbench.report.change.document import ChangeDocument, ChangeRecord
from pcbench.report.change.layers import PlanLayers
from pcbench.report.change.plan import color_bar, draw_plan
from pcbench.report.change.tables import WHOLE, series_rows, short_rows, volume_rows
from pcbench.report.change.words import (
    epoch_text,
    error_sentences,
    headline,
    method_sentence,
    system_sentence,
    uncertainty_sentence,
)
from pcbench.report.colors import Range
from pcbench.report.plot.outputs import METADATA
from pcbench.report.plot.panels import new_figure
from pcbench.report.words import printable, shorten_name

_WIDTH, _HEIGHT = 8.27, 11.69  # of A4, in inches
_MARGIN = 0.7
_INK, _FAINT = "#1b1c1e", "#666666"
_LINE = 0.17  # height of a line of text
_MOST_ROWS = 26
_LETTER, _DIGIT = 0.535, 0.64  # mean widths of letters in texts and in tables, over the size of the font
_AXIS_TITLE, _FOOTER = 0.62, 0.65  # heights below a map and at the bottom
_ROW = 0.2  # height of a row of a table
_CHART_HEIGHT = 2.3  # of the chart of volumes, where a sheet has room for it


def write_sheets(document: ChangeDocument, layers: Callable[[str], PlanLayers], colors: Range, path: Path) -> bool:
    """Write the sheets of a change; the same change gives the same bytes.

    Args:
        document: the change.
        layers: returns the rasters of an epoch.
        colors: colour range of the changes.
        path: the PDF file.
    """
    import matplotlib
    from matplotlib.backends.backend_pdf import PdfPages

    # Sheets are for paper, whatever the background of the pictures.
    inks = dict.fromkeys(("text.color", "axes.labelcolor", "axes.edgecolor", "xtick.color", "ytick.color"), _INK)
    white = dict.fromkeys(("figure.facecolor", "axes.facecolor", "savefig.facecolor"), "#ffffff")
    title = f"Change from {epoch_text(document.epochs[0])} to {epoch_text(document.epochs[-1])}"
    with (
        matplotlib.rc_context({**inks, **white}),
        PdfPages(path, metadata={**METADATA["pdf"], "Title": printable(title)}) as pages,
    ):
        for figure in _sheets(document, layers, colors):
            pages.savefig(figure)
    return True


def _sheets(document: ChangeDocument, layers: Callable[[str], PlanLayers], colors: Range) -> Iterator[Any]:
    makers: list[Callable[[], Any]] = []
    for change in document.changes[::-1]:  # the latest epoch first
        makers.append(partial(_plan_sheet, document, change, layers(change.epoch), colors))
    makers += [partial(_profile_sheet, document, first) for first in range(0, len(document.profiles), 2)]
    if len(document.changes) > 1 or document.places:
        makers.append(partial(_series_sheet, document))
    if document.changes[-1].parts or document.changes[-1].zones:
        makers.append(partial(_parts_sheet, document, document.changes[-1]))
    for number, make in enumerate(makers, 1):
        figure = make()
        _footer(figure, document, number, len(makers))
        yield figure


def _plan_sheet(document: ChangeDocument, change: ChangeRecord, plan: PlanLayers, colors: Range) -> Any:
    figure = new_figure(_WIDTH, _HEIGHT)
    later = next(epoch for epoch in document.epochs[1:] if epoch.name == change.epoch)
    y = _heading(figure, f"Change of height and volumes, {epoch_text(document.epochs[0])} to {epoch_text(later)}")
    y = _paragraph(figure, y, headline(document, change, later), size=10)
    lines = [f"{_survey(each)}" for each in (document.epochs[0], later)]
    for text in (*lines, system_sentence(document)):
        y = _paragraph(figure, y, text, size=8.5, color=_FAINT)
    rows = short_rows(document, change)
    notes = [method_sentence(document), uncertainty_sentence(document), *list(error_sentences(document, change))[-1:]]
    legend = _legend(document)
    texts = sum(_paragraph_height(text, 8) for text in (legend, *notes))
    below = _AXIS_TITLE + texts + 0.24 + _table_height(rows) + _FOOTER
    high, wide = y - 0.2 - below, _WIDTH - 2 * _MARGIN - 1.25
    scale = min(wide / (plan.east - plan.west), high / (plan.north - plan.south))
    width, height = scale * (plan.east - plan.west), scale * (plan.north - plan.south)
    left, bottom = _MARGIN + 0.35 + 0.5 * (wide - width), y - 0.2 - height
    axis = figure.add_axes(_box(left, bottom, width, height))
    draw_plan(axis, document, plan, colors)
    bar = figure.add_axes(_box(left + width + 0.2, bottom + 0.1 * height, 0.16, 0.8 * height))
    unit = f" [{document.unit}]" if document.unit else ""
    level = None if change.errors is None else change.errors.median_level
    color_bar(bar, colors, f"change of height{unit}", level=level)
    y = _paragraph(figure, bottom - _AXIS_TITLE, legend, size=8, color=_FAINT)
    y = _table(figure, y - 0.12, rows)
    y -= 0.12
    for note in notes:
        y = _paragraph(figure, y, note, size=8)
    areas = min(len(change.zones) + len(change.parts), 8)
    tall = min(_CHART_HEIGHT, 0.2 + 0.3 * areas)
    if areas and y - tall > _FOOTER + 0.9:
        chart = figure.add_axes(_box(_MARGIN + 0.9, y - 0.3 - tall, _WIDTH - 2 * _MARGIN - 0.9, tall))
        draw_volumes(chart, document, change, most=areas)
    return figure


def _legend(document: ChangeDocument) -> str:
    text = "Red: raised, blue: lowered; grey: below the level of detection; black outlines: changed parts"
    return text + "; violet: zones" * bool(document.zone_rings) + "; green: profiles" * bool(document.profiles) + "."


def _survey(epoch: Any) -> str:
    day = f", {epoch.date}" if epoch.date else ""
    return f"{epoch.name}{day}: {epoch.points:,} points, {shorten_name(Path(epoch.path).name, 60)}"


def _profile_sheet(document: ChangeDocument, first: int) -> Any:
    figure = new_figure(_WIDTH, _HEIGHT)
    y = _heading(figure, "Profiles")
    for number in range(first + 1, min(first + 2, len(document.profiles)) + 1):
        above = figure.add_axes(_box(_MARGIN + 0.3, y - 2.9, _WIDTH - 2 * _MARGIN - 0.3, 2.5))
        below = figure.add_axes(_box(_MARGIN + 0.3, y - 4.55, _WIDTH - 2 * _MARGIN - 0.3, 1.5), sharex=above)
        above.tick_params(labelbottom=False)
        draw_profile((above, below), document, number)
        y -= 5.1
    return figure


def _series_sheet(document: ChangeDocument) -> Any:
    figure = new_figure(_WIDTH, _HEIGHT)
    y = _heading(figure, "Change against time")
    count = series_panels(document)
    axes = [
        figure.add_axes(_box(_MARGIN + 0.35, y - 0.2 - 2.9 * (k + 1) + 0.3, _WIDTH - 2 * _MARGIN - 0.35, 2.45))
        for k in range(count)
    ]
    draw_series(axes, document)
    for axis in axes[:-1]:
        axis.tick_params(labelbottom=False)
    _table(figure, y - 2.9 * count - 0.6, series_rows(document))
    return figure


def _parts_sheet(document: ChangeDocument, change: ChangeRecord) -> Any:
    figure = new_figure(_WIDTH, _HEIGHT)
    y = _heading(figure, f"Zones and changed parts, until {change.epoch}")
    rows = volume_rows(document, change)[:_MOST_ROWS]
    y = _table(figure, y - 0.1, rows) - 0.35
    most = min(len(change.zones) + len(change.parts), 14)
    height = min(0.3 + 0.36 * most, y - 1.4)
    axis = figure.add_axes(_box(_MARGIN + 0.9, y - height, _WIDTH - 2 * _MARGIN - 0.9, height))
    draw_volumes(axis, document, change, most=most)
    return figure


def _box(left: float, bottom: float, width: float, height: float) -> tuple[float, float, float, float]:
    """Return a rectangle in inches as shares of the sheet."""
    return left / _WIDTH, bottom / _HEIGHT, width / _WIDTH, height / _HEIGHT


def _heading(figure: Any, text: str) -> float:
    """Write the heading, and return the height of the line below it."""
    y = _HEIGHT - _MARGIN
    for line in wrap(printable(text), 62)[:2]:
        _write(figure, _MARGIN, y, line, size=15, weight="bold")
        y -= 0.3
    return y - 0.02


def _wrapped(text: str, size: float) -> list[str]:
    return wrap(printable(text), int((_WIDTH - 2 * _MARGIN) * 72 / (_LETTER * size)))


def _paragraph(figure: Any, y: float, text: str, *, size: float, color: str = _INK) -> float:
    """Write a paragraph, and return the height of the line below it."""
    for line in _wrapped(text, size):
        _write(figure, _MARGIN, y, line, size=size, color=color)
        y -= _LINE * max(size / 9, 0.85)
    return y - 0.05


def _paragraph_height(text: str, size: float) -> float:
    return len(_wrapped(text, size)) * _LINE * max(size / 9, 0.85) + 0.05


def _table_height(rows: Sequence[Sequence[str]]) -> float:
    return len(rows) * _ROW + 0.04 + _ROW


def _table(figure: Any, y: float, rows: Sequence[Sequence[str]]) -> float:
    """Write a table with its header between lines, and return the height of the line below it."""
    from matplotlib.lines import Line2D

    widths = [max(len(row[k]) for row in rows) + 1.5 for k in range(len(rows[0]))]
    widths[0] = max(min(widths[0], 24), 12)
    total = sum(widths)
    inner = _WIDTH - 2 * _MARGIN
    size = min(8.5, inner * 72 / (_DIGIT * total))
    rights = [_MARGIN + inner * sum(widths[: k + 1]) / total for k in range(len(widths))]

    def rule(height: float, weight: float) -> None:
        ends = [_MARGIN / _WIDTH, 1 - _MARGIN / _WIDTH]
        line = Line2D(ends, [height / _HEIGHT] * 2, color=_INK, linewidth=weight, transform=figure.transFigure)
        figure.add_artist(line)

    rule(y + 0.05, 1.0)
    for number, row in enumerate(rows):
        y -= _ROW
        for k, cell in enumerate(row):
            weight = "bold" if number == 0 or (row[0] == WHOLE and k <= 1) else "normal"
            text = shorten_name(cell, 26) if k == 0 else cell
            x, side = (_MARGIN, "left") if k == 0 else (rights[k], "right")
            _write(figure, x, y + 0.05, text, size=size, weight=weight, ha=side, va="baseline")
        if number == 0:
            rule(y - 0.02, 0.5)
            y -= 0.04
    rule(y - 0.03, 1.0)
    return y - _ROW


def _footer(figure: Any, document: ChangeDocument, number: int, count: int) -> None:
    made = document.provenance or {}
    left = f"pcbench {made.get('version', '')}, {str(made.get('created', ''))[:10]}"
    _write(figure, _MARGIN, 0.42, left, size=7.5, color=_FAINT)
    _write(figure, _WIDTH - _MARGIN, 0.42, f"sheet {number} of {count}", size=7.5, color=_FAINT, ha="right")


def _write(figure: Any, x: float, y: float, text: str, *, size: float, color: str = _INK, **how: Any) -> None:
    style = {"va": "top", "parse_math": False, **how}
    figure.text(x / _WIDTH, y / _HEIGHT, text, fontsize=size, color=color, **style)
