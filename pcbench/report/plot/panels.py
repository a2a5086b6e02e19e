"""Pictures of clouds: three views at one scale beside each other, with a title, a scale bar each, and a colour bar."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from pathlib import Path
from textwrap import wrap
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray
from pcbench.report.colors import Range
from pcbench.report.figures import Figures, ink
from pcbench.report.plot.views import VIEWS, Frame, Viewpoint, round_length

DPI = 120
# All in inches.
_WIDTH, _MAX_HEIGHT = 13.6, 6.6  # that the views take together at most
_MIN_PANEL = 1.3  # of a view: room for its title
_GAP, _BELOW, _ABOVE = 0.14, 0.42, 0.78  # between views, for scale bars, for titles
_BAR_WIDTH = 0.16
_MIN_BAR, _MAX_BAR = 1.9, 4.2  # heights
_LETTER = 0.092  # of the title, on average
_SCALE_SHARE = 0.22  # of the widest view at most: the length of the scale bar

Image = Callable[[Viewpoint, FloatArray, tuple[int, int]], NDArray[np.uint8]]
Over = Callable[[Any, Viewpoint, Callable[[FloatArray], FloatArray], float], None]


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
        over: draws something of a view into axes: given is what brings places (N, 2) of its window there, and the
            factor by which lengths change.
    """
    ground = look.ground("dark")
    color = ink(ground)
    inches = min(_WIDTH / float(frame.sizes[:, 0].sum()), _MAX_HEIGHT / float(frame.sizes[:, 1].max()))
    drawn = frame.sizes * inches
    panels = np.maximum(drawn[:, 0], _MIN_PANEL)
    height = max(float(drawn[:, 1].max()), _MIN_BAR if scale is not None else 0.5)
    bar = None if scale is None else _Bar.of(scale, label, float(np.clip(height - 0.5, _MIN_BAR - 0.5, _MAX_BAR)))
    views, space = float(panels.sum()) + _GAP * (len(VIEWS) + 1), bar.space if bar is not None else 0.0
    width, whole = max(views + space, _LETTER * len(title) + 2 * _GAP), height + _BELOW + _ABOVE
    figure, axis = _canvas(width, whole, ground)
    axis.text(0.5 * width, whole - 0.24, title, color=color, fontsize=14, ha="center", va="center")
    length = round_length(_SCALE_SHARE * float(panels.max()) / inches)
    left = 0.5 * (width - views - space) + _GAP
    for view, window, size, panel in zip(VIEWS, frame.windows, drawn, panels, strict=True):
        corner = np.array([left + 0.5 * (panel - size[0]), _BELOW + 0.5 * (height - size[1])])
        pixels = max(1, round(size[0] * DPI)), max(1, round(size[1] * DPI))
        _place(axis, image(view, window, pixels), corner, size)
        if over is not None:
            over(axis, view, partial(_inches, corner, window, inches), inches)
        axis.text(left + 0.5 * panel, whole - 0.58, view.title, color=color, fontsize=11, ha="center", va="center")
        _scale_bar(axis, left, length, inches, unit, color)
        left += panel + _GAP
    if bar is not None:
        bar.draw(axis, left, _BELOW + 0.5 * height, color)
    axis.set(xlim=(0, width), ylim=(0, whole))
    save(figure, path)


def save(figure: Any, path: Path) -> None:
    """In the format that the path's ending names; the same drawing gives the same file."""
    kind = path.suffix[1:]
    undated: dict[str, dict[str, Any]] = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}
    # Dots are noise to a compressor: more of its work takes long and saves little.
    quick: dict[str, Any] = {"pil_kwargs": {"compress_level": 2}} if kind == "png" else {}
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


def _inches(corner: FloatArray, window: FloatArray, inches: float, at: FloatArray) -> FloatArray:
    """Where places (N, 2) of a window are in the picture."""
    places: FloatArray = corner + (at - window[0]) * inches
    return places


def _bar_label(length: float, unit: str) -> str:
    """A length with its unit; a unit that is not known is described by several words, too long for a bar."""
    if len(unit) < 6:
        return f"{length:g} {unit}"
    return "1 unit" if length == 1 else f"{length:g} units"


def _scale_bar(axis: Any, left: float, length: float, inches: float, unit: str, color: str) -> None:
    """Below a view: lengths along its width are true in every one of them."""
    right = left + length * inches
    style = {"color": color, "linewidth": 1.3, "solid_capstyle": "butt", "solid_joinstyle": "miter"}
    axis.plot([left, left, right, right], [0.3, 0.24, 0.24, 0.3], **style)
    axis.text(right + 0.06, 0.26, _bar_label(length, unit), color=color, fontsize=9, ha="left", va="center")


class _Bar(NamedTuple):
    """A colour bar and its words, in inches."""

    scale: Range
    height: float
    ticks: list[float]
    label: list[str]
    note: list[str]

    @classmethod
    def of(cls, scale: Range, label: str, height: float) -> _Bar:
        from matplotlib.ticker import MaxNLocator

        rounding = 1e-9 * scale.high
        wanted = MaxNLocator(max(3, int(2 * height)), steps=(1, 2, 5, 10)).tick_values(scale.low, scale.high)
        ticks = [float(t) for t in wanted if scale.low - rounding <= t <= scale.high + rounding]
        ticks = [0.0 if abs(t) < rounding else t for t in ticks]
        return cls(scale, height, ticks, _lines(label, 14 * (height + 0.5)), _lines(scale.note, 17 * (height + 0.5)))

    @property
    def label_at(self) -> float:
        """From its left side."""
        return _BAR_WIDTH + 0.2 + 0.078 * max(len(_number(tick)) for tick in self.ticks)

    @property
    def note_at(self) -> float:
        return self.label_at + 0.18 * len(self.label) + 0.04

    @property
    def space(self) -> float:
        return self.note_at + 0.135 * len(self.note) + 0.15

    def draw(self, axis: Any, left: float, middle: float, color: str) -> None:
        """With an arrow at each end that values reach beyond."""
        from matplotlib.patches import Polygon

        scale, tip, center = self.scale, 0.14, left + 0.5 * _BAR_WIDTH
        low, high, right = middle - 0.5 * self.height, middle + 0.5 * self.height, left + _BAR_WIDTH
        steps = scale.colors(np.linspace(scale.high, scale.low, 256))[:, None]
        axis.imshow(steps, extent=(left, right, low, high), aspect="auto", interpolation="nearest")
        outline = [(right, low), (right, high), (center, high + tip), (left, high), (left, low)]
        ends = [(outline[1:4], steps[0, 0])]
        if scale.signed:
            outline.append((center, low - tip))
            ends.append(([outline[4], outline[0], outline[5]], steps[-1, 0]))
        for corners, of in ends:
            axis.add_patch(Polygon(corners, facecolor=of / 255, edgecolor="none"))
        axis.add_patch(Polygon(outline, fill=False, edgecolor=color, linewidth=0.8))
        for tick in self.ticks:
            y = low + self.height * (tick - scale.low) / (scale.high - scale.low)
            axis.plot([right, right + 0.05], [y, y], color=color, linewidth=0.8)
            axis.text(right + 0.09, y, _number(tick), color=color, fontsize=9.5, va="center")
        upright = {"rotation": 90, "color": color, "ha": "left", "va": "center"}
        axis.text(left + self.label_at, middle, "\n".join(self.label), fontsize=10.5, **upright)
        axis.text(left + self.note_at, middle, "\n".join(self.note), fontsize=8, alpha=0.8, **upright)


def _lines(text: str, letters: float) -> list[str]:
    """As many as it takes, of about one length."""
    number = max(1, math.ceil(len(text) / letters))
    return wrap(text, len(text) // number + (6 if number > 1 else 1))


def _number(value: float) -> str:
    return f"{value:.4g}".replace("-", "−")


def titled(*parts: str) -> str:
    """Parts of a title that are there, with semicolons."""
    return "; ".join(filter(None, parts))
