"""Pictures of clouds: three views at one scale beside each other, with a title, a scale bar each, and a colour bar."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from textwrap import wrap
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray
from pcbench.report.colors import Range
from pcbench.report.figures import Figures, ink
from pcbench.report.plot.views import VIEWS, Frame, View, round_length

DPI = 120
# All in inches.
_WIDTH, _MAX_HEIGHT = 13.6, 6.6  # that the views take together at most
_MIN_PANEL = 1.3  # of a view: room for its title
_GAP, _BELOW, _ABOVE = 0.14, 0.42, 0.78  # between views, for scale bars, for titles
_BAR_SPACE, _BAR_WIDTH = 1.25, 0.16  # of the colour bar with its words, and alone
_MIN_BAR, _MAX_BAR = 1.9, 4.2
_LETTER = 0.092  # of the title, on average
_SCALE_SHARE = 0.22  # of the widest view at most: the length of the scale bar

Image = Callable[[View, FloatArray, tuple[int, int]], NDArray[np.uint8]]
Over = Callable[[Any, View, Callable[[FloatArray], FloatArray], float], None]


def compose(
    image: Image,
    frame: Frame,
    title: str,
    unit: str,
    path: Path,
    look: Figures,
    *,
    scale: Range | None = None,
    label: str = "",
    over: Over | None = None,
) -> None:
    """Draw the views of a frame.

    Args:
        image: of a view, its window and a size in pixels.
        unit: of lengths, for the scale bar.
        scale, label: of the colour bar; None: there is none.
        over: draws into axes something of a view: given is what brings places (N, 2) of its window there, and the factor
            by which lengths change.
    """
    ground = look.ground("dark")
    color = ink(ground)
    inches = min(_WIDTH / float(frame.sizes[:, 0].sum()), _MAX_HEIGHT / float(frame.sizes[:, 1].max()))
    drawn = frame.sizes * inches
    panels = np.maximum(drawn[:, 0], _MIN_PANEL)
    height = max(float(drawn[:, 1].max()), _MIN_BAR if scale is not None else 0.5)
    views, bar = float(panels.sum()) + _GAP * (len(VIEWS) + 1), _BAR_SPACE if scale is not None else 0.0
    width, whole = max(views + bar, _LETTER * len(title)), height + _BELOW + _ABOVE
    figure, axis = _canvas(width, whole, ground)
    axis.text(0.5 * width, whole - 0.24, title, color=color, fontsize=14, ha="center", va="center")
    length = round_length(_SCALE_SHARE * float(panels.max()) / inches)
    left = 0.5 * (width - views - bar) + _GAP
    for view, window, size, panel in zip(VIEWS, frame.windows, drawn, panels, strict=True):
        corner = np.array([left + 0.5 * (panel - size[0]), _BELOW + 0.5 * (height - size[1])])
        pixels = max(1, round(size[0] * DPI)), max(1, round(size[1] * DPI))
        _place(axis, image(view, window, pixels), corner, size)
        if over is not None:
            over(axis, view, lambda at, corner=corner, window=window: corner + (at - window[0]) * inches, inches)
        axis.text(left + 0.5 * panel, whole - 0.58, view.title, color=color, fontsize=11, ha="center", va="center")
        _scale_bar(axis, left, length, inches, unit, color)
        left += panel + _GAP
    if scale is not None:
        _colour_bar(axis, left + 0.06, _BELOW + 0.5 * height, float(np.clip(height - 0.5, _MIN_BAR - 0.5, _MAX_BAR)),
                    scale, label, color)  # fmt: skip
    axis.set(xlim=(0, width), ylim=(0, whole))
    save(figure, path)


def save(figure: Any, path: Path) -> None:
    """In the format that the path's ending names; the same drawing gives the same file."""
    kind = path.suffix[1:]
    undated: dict[str, dict[str, Any]] = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}
    # Dots are noise to a compressor: more of its work takes long and saves little.
    quick: dict[str, Any] = {"pil_kwargs": {"compress_level": 3}} if kind == "png" else {}
    figure.savefig(path, facecolor=figure.get_facecolor(), metadata=undated.get(kind), **quick)


def _canvas(width: float, height: float, ground: str) -> tuple[Any, Any]:
    """A figure, and axes over all of it in inches: one pair is drawn far quicker than one a view."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=DPI, facecolor=ground)
    FigureCanvasAgg(figure)
    axis = figure.add_axes((0, 0, 1, 1))
    axis.set_axis_off()
    axis.set(xlim=(0, width), ylim=(0, height))
    return figure, axis


def _place(axis: Any, image: NDArray[np.uint8], corner: FloatArray, size: FloatArray) -> None:
    (x, y), (wide, high) = np.round(corner * DPI) / DPI, size  # on whole pixels: not smoothed
    axis.imshow(image, extent=(x, x + wide, y, y + high), aspect="auto", interpolation="nearest")


def _scale_bar(axis: Any, left: float, length: float, inches: float, unit: str, color: str) -> None:
    """Below a view: lengths along its width are true in every one of them."""
    right = left + length * inches
    style = {"color": color, "linewidth": 1.3, "solid_capstyle": "butt", "solid_joinstyle": "miter"}
    axis.plot([left, left, right, right], [0.3, 0.24, 0.24, 0.3], **style)
    word = f"{length:g} {unit if len(unit) < 6 else 'units'}"
    axis.text(right + 0.06, 0.26, word, color=color, fontsize=9, ha="left", va="center")


def _colour_bar(axis: Any, left: float, middle: float, tall: float, scale: Range, label: str, color: str) -> None:
    """With an arrow at each end that values reach beyond."""
    from matplotlib.patches import Polygon
    from matplotlib.ticker import MaxNLocator

    low, high, right, tip = middle - 0.5 * tall, middle + 0.5 * tall, left + _BAR_WIDTH, 0.14
    steps = scale.colors(np.linspace(scale.high, scale.low, 256))[:, None]
    axis.imshow(steps, extent=(left, right, low, high), aspect="auto", interpolation="nearest")
    outline = [(right, low), (right, high), (left + 0.5 * _BAR_WIDTH, high + tip), (left, high), (left, low)]
    ends = [(outline[1:4], steps[0, 0])]
    if scale.signed:
        outline.append((left + 0.5 * _BAR_WIDTH, low - tip))
        ends.append(([outline[4], outline[0], outline[5]], steps[-1, 0]))
    for corners, of in ends:
        axis.add_patch(Polygon(corners, facecolor=of / 255, edgecolor="none"))
    axis.add_patch(Polygon(outline, fill=False, edgecolor=color, linewidth=0.8))
    ticks = [t for t in MaxNLocator(max(3, int(2 * tall))).tick_values(scale.low, scale.high)]
    ticks = [0.0 if abs(t) < 1e-9 * scale.high else float(t) for t in ticks]
    for tick in ticks:
        if scale.low - 1e-9 * scale.high <= tick <= scale.high * (1 + 1e-9):
            y = low + tall * (tick - scale.low) / (scale.high - scale.low)
            axis.plot([right, right + 0.05], [y, y], color=color, linewidth=0.8)
            axis.text(right + 0.09, y, f"{tick:.4g}".replace("-", "−"), color=color, fontsize=9.5, va="center")
    letters = int(14 * (tall + 0.5))
    longest = max(len(f"{tick:.4g}") for tick in ticks)
    at = right + 0.2 + 0.078 * longest
    upright = {"rotation": 90, "color": color, "ha": "left", "va": "center"}
    lines = wrap(label, letters)
    axis.text(at, middle, "\n".join(lines), fontsize=10.5, **upright)
    if scale.note:
        axis.text(at + 0.185 * len(lines) + 0.03, middle, "\n".join(wrap(scale.note, int(1.25 * letters))), fontsize=8,
                  alpha=0.8, **upright)  # fmt: skip


def titled(*parts: str) -> str:
    """Parts of a title that are there, with semicolons."""
    return "; ".join(filter(None, parts))
