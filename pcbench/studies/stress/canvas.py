"""Styles of methods, rates and levels that all charts of the stress study share."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from pcbench.report.colors import SERIES
from pcbench.studies.frame.rates import Rate
from pcbench.studies.stress.descriptions import LadderInfo
from pcbench.studies.stress.limits import StressRow

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


def row_styles(rows: Sequence[StressRow[Any]]) -> dict[str, RowStyle]:
    """Return the style of each row by its name: solid lines for ours, dashed for others."""
    styles = {}
    for number, row in enumerate(rows):
        line = "-" if row.method.is_ours else "--" if number < len(SERIES) else ":"
        width = 2.0 if row.method.is_ours else 1.3
        styles[row.name] = RowStyle(SERIES[number % len(SERIES)], _MARKERS[number % len(_MARKERS)], line, width)
    return styles


def panel_legend(axis: Any) -> None:
    """Draw the legend of one panel to its right."""
    axis.legend(loc="center left", bbox_to_anchor=(1.01, 0.5), frameon=False, fontsize=9)


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


def level_labels(ladder: LadderInfo) -> list[str]:
    """Return the levels of a ladder as tick labels without unit; large numbers are abbreviated."""
    return [_short(level) for level in ladder.levels]


def _short(value: float) -> str:
    return f"{value:.0e}".replace("e+0", "e") if abs(value) >= 1e4 else f"{value:g}"
