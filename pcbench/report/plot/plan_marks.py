"""The scale bar and the north arrow of maps in plan view, readable on any ground."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from pcbench.geometry.arrays import FloatArray
from pcbench.report.plot.rounding import round_length

DARK = "#111111"
_PAPER_WIDTH = 2.2
_ARROW_CORNER = (0.92, 0.8)  # lower left corner of the room of the north arrow, as fractions of the axes


def paper() -> list[Any]:
    """Return the effect that keeps texts and lines readable on any map: an edge of the colour of paper."""
    from matplotlib.patheffects import withStroke

    return [withStroke(linewidth=_PAPER_WIDTH, foreground="white")]


def draw_scale_bar(axis: Any, unit: str | None) -> None:
    """Draw a scale bar at the lower left of axes, whose limits are those of the map."""
    from matplotlib.patches import Rectangle

    (west, east), (south, north) = axis.get_xlim(), axis.get_ylim()
    width, height = east - west, north - south
    length = round_length(0.22 * width)
    x, y, thick = west + 0.03 * width, south + 0.035 * height, 0.012 * max(height, 0.5 * width)
    corner = (x - 0.015 * width, y - thick)
    ground: Any = {"color": "white", "alpha": 0.75, "lw": 0, "zorder": 5}
    axis.add_patch(Rectangle(corner, length + 0.03 * width, 5.2 * thick, **ground))
    for part, color in ((0, DARK), (1, "white")):
        half = (x + 0.5 * part * length, y)
        axis.add_patch(Rectangle(half, 0.5 * length, thick, facecolor=color, edgecolor=DARK, lw=0.8, zorder=5))
    label = f"{length:g} {unit or 'units'}"
    axis.text(x + 0.5 * length, y + 1.5 * thick, label, fontsize=8, ha="center", va="bottom", color=DARK, zorder=5)


def draw_north_arrow(axis: Any) -> None:
    """Draw an arrow to the north at the upper right of axes."""
    axis.annotate(
        "N", xy=(0.965, 0.97), xytext=(0.965, 0.86), xycoords="axes fraction", ha="center", va="center", fontsize=11,
        fontweight="bold", color=DARK, path_effects=paper(), zorder=5,
        arrowprops={"arrowstyle": "-|>", "color": DARK, "linewidth": 1.8, "path_effects": paper()},
    )  # fmt: skip


def left_of_arrow(place: Sequence[float] | FloatArray, extent: tuple[float, float, float, float]) -> float:
    """Return the x at which a text at a place (x, y) leaves the north arrow free: its own, or that left of the arrow.

    Args:
        place: the place.
        extent: west, east, south and north of the axes.
    """
    west, east, south, north = extent
    left, low = west + _ARROW_CORNER[0] * (east - west), south + _ARROW_CORNER[1] * (north - south)
    x, y = place
    return float(min(x, left) if y > low else x)
