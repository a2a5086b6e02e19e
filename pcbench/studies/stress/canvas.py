"""Figures, colours and axes that all charts of the stress study share."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from textwrap import fill
from typing import Any, NamedTuple

from pcbench.report.colors import SERIES
from pcbench.studies.stress.limits import SUCCESS, StressRow
from pcbench.studies.stress.results import (
    CHANGES,
    METRICS,
    RECONSTRUCTION,
    REGISTRATION,
    VERDICTS,
    LadderInfo,
    Rate,
    Tally,
)

DPI = 110
GREY = "#777777"
SUCCESS_LABELS = {
    REGISTRATION: "right poses [% of runs]",
    METRICS: "right or explained [% of runs]",
    VERDICTS: "right verdicts [% of runs]",
    CHANGES: "rightly named changes [% of runs]",
    RECONSTRUCTION: "half of the F-score kept [% of runs]",
}
_LETTERS_PER_INCH = 13.0  # at the size of legends
_LEGEND_KEY_LETTERS = 8  # width of a legend's symbol with its margins
_MAX_SUBDIVIDED_RATIO = 500.0
_MARKERS = ("o", "s", "^", "D", "v", "P", "X", "<", ">", "h", "p", "*", "d")


class RowStyle(NamedTuple):
    """Colour, marker, line style and line width of a row."""

    color: str
    marker: str
    line: str
    width: float

    def line_style(self) -> dict[str, Any]:
        """Return the arguments of a curve."""
        return {"color": self.color, "linestyle": self.line, "linewidth": self.width}


def row_styles(rows: Sequence[StressRow]) -> dict[str, RowStyle]:
    """Return the style of each row by its name: solid lines for ours, dashed for others."""
    styles = {}
    for number, row in enumerate(rows):
        line = "-" if row.method.is_ours else "--" if number < len(SERIES) else ":"
        width = 2.0 if row.method.is_ours else 1.3
        styles[row.name] = RowStyle(SERIES[number % len(SERIES)], _MARKERS[number % len(_MARKERS)], line, width)
    return styles


def canvas(rows: int, columns: int, size: tuple[float, float], *, extra: float = 0.6) -> tuple[Any, Any]:
    """Return a figure and its axes (rows, columns).

    Args:
        rows: number of rows.
        columns: number of columns.
        size: width and height of each panel, in inches.
        extra: height beyond the panels, for titles and legends, in inches.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    shape = (columns * size[0], rows * size[1] + extra)
    figure = Figure(figsize=shape, dpi=DPI, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(rows, columns, squeeze=False)
    for axis in axes.ravel():
        axis.spines[["top", "right"]].set_visible(False)
    return figure, axes


def legend(figure: Any, axes: Iterable[Any], *, note: str = "") -> None:
    """Draw one entry per label below all panels, with a note as its title."""
    named: dict[str, Any] = {}
    for axis in axes:
        handles, labels = axis.get_legend_handles_labels()
        named |= dict(zip(labels, handles, strict=True))
    if named:
        letters = int(figure.get_figwidth() * _LETTERS_PER_INCH)
        title = {"title": fill(note, letters), "title_fontsize": 9} if note else {}
        columns = max(1, min(len(named), letters // (max(map(len, named)) + _LEGEND_KEY_LETTERS)))
        style = {"ncols": columns, "frameon": False, "fontsize": 9}
        figure.legend(named.values(), named.keys(), loc="outside lower center", **style, **title)


def panel_legend(axis: Any) -> None:
    """Draw the legend of one panel to its right."""
    axis.legend(loc="center left", bbox_to_anchor=(1.01, 0.5), frameon=False, fontsize=9)


def plain_log_ticks(axis: Any, which: str = "x") -> None:
    """Write plain numbers at 1, 2 and 5 times powers of ten, or at powers alone if the axis covers many."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    low, high = axis.get_xlim() if which == "x" else axis.get_ylim()
    subs = (1.0, 2.0, 5.0) if high / low < _MAX_SUBDIVIDED_RATIO else (1.0,)
    scale = axis.xaxis if which == "x" else axis.yaxis
    scale.set_major_locator(LogLocator(subs=subs, numticks=20))
    scale.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    scale.set_minor_formatter(NullFormatter())


def success(tally: Tally, subject: str) -> Rate:
    """Return the share of successful runs."""
    return tally.rate(*SUCCESS[subject])


def draw_rate(
    axis: Any, x: float, rate: Rate, style: RowStyle, *, size: float = 5.0, filled: bool = True, bars: bool = True
) -> None:
    """Draw a share in percent at x, with its Wilson interval as a bar, if `bars`; wrong results make it hollow."""
    y = 100 * rate.share
    low, high = rate.interval if bars else (rate.share, rate.share)
    axis.errorbar(
        x, y, [[max(0.0, y - 100 * low)], [max(0.0, 100 * high - y)]], color=style.color, marker=style.marker,
        markersize=size, markerfacecolor=style.color if filled else "white", elinewidth=0.9, capsize=2 if bars else 0,
        linestyle="none",
    )  # fmt: skip


def percent_axis(axis: Any) -> None:
    """Set the y axis of shares: 0 to 100 %, with a grid."""
    axis.set_ylim(-4, 104)
    axis.set_yticks(range(0, 101, 20))
    axis.grid(axis="y", alpha=0.3)


def level_labels(ladder: LadderInfo) -> list[str]:
    """Return the levels of a ladder as tick labels without unit; large numbers are abbreviated."""
    return [_short(level) for level in ladder.levels]


def _short(value: float) -> str:
    return f"{value:.0e}".replace("e+0", "e") if abs(value) >= 1e4 else f"{value:g}"
