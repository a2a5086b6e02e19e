"""Pictures of clouds: three views side by side at one scale, with title, scale bars and a colour bar."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import AbstractContextManager
from functools import partial
from pathlib import Path
from textwrap import wrap
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray
from pcbench.report.colors import Classes, Range
from pcbench.report.figures import Figures, ink
from pcbench.report.plot.outputs import METADATA
from pcbench.report.plot.rounding import round_length
from pcbench.report.plot.views import Frame, Viewpoint
from pcbench.report.words import printable

DPI = 120
# Lengths are in inches.
_MAX_WIDTH, _MAX_HEIGHT = 13.6, 6.6  # of all views together
_MIN_VIEW_WIDTH = 1.3  # fits the title of a view
_VIEW_GAP = 0.14
_SCALE_BAR_MARGIN, _TITLE_MARGIN = 0.42, 0.78
_BAR_WIDTH = 0.16
_MIN_BAR_HEIGHT, _MAX_BAR_HEIGHT = 1.9, 4.2
_LEGEND_ROW = 0.23
_TITLE_LETTER_WIDTH = 0.092  # mean of the title's letters
_MAX_SCALE_BAR_SHARE = 0.22  # of the widest view

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
    scale: Range | Classes | None = None,
    label: str = "",
    over: Over | None = None,
) -> None:
    """Draw the views of a frame side by side.

    Args:
        image: renders a view, for a window and a size in pixels.
        frame: the frame.
        title: title of the picture.
        unit: unit of lengths, for the scale bar.
        path: the file to write.
        look: appearance of the picture.
        scale: range of the colour bar, or colours of the legend; None: neither.
        label: label of the colour bar or the legend.
        over: draws over a view. It gets the axes, the viewpoint, a function that maps window positions (N, 2) to the
            picture in inches, and the inches per unit of length.
    """
    title, ground = printable(title), look.ground("dark")
    color = ink(ground)
    inches = min(_MAX_WIDTH / float(frame.sizes[:, 0].sum()), _MAX_HEIGHT / float(frame.sizes[:, 1].max()))
    drawn = frame.sizes * inches
    panels = np.maximum(drawn[:, 0], _MIN_VIEW_WIDTH)
    height = max(float(drawn[:, 1].max()), _MIN_BAR_HEIGHT if scale is not None else 0.5)
    bar: _Bar | _Legend | None = None
    if isinstance(scale, Classes):
        bar = _Legend(scale, printable(label))
        height = max(height, bar.height)
    elif scale is not None:
        bar = _Bar.of(scale, label, float(np.clip(height - 0.5, _MIN_BAR_HEIGHT - 0.5, _MAX_BAR_HEIGHT)))
    views, space = float(panels.sum()) + _VIEW_GAP * (len(frame.views) + 1), bar.space if bar is not None else 0.0
    width, total_height = (
        max(views + space, _TITLE_LETTER_WIDTH * len(title) + 2 * _VIEW_GAP),
        height + _SCALE_BAR_MARGIN + _TITLE_MARGIN,
    )
    figure, axis = _canvas(width, total_height, ground)
    axis.text(
        0.5 * width, total_height - 0.24, title, color=color, fontsize=14, ha="center", va="center", parse_math=False
    )
    length = round_length(_MAX_SCALE_BAR_SHARE * float(panels.max()) / inches)
    left = 0.5 * (width - views - space) + _VIEW_GAP
    for view, window, size, panel in zip(frame.views, frame.windows, drawn, panels, strict=True):
        corner = np.array([left + 0.5 * (panel - size[0]), _SCALE_BAR_MARGIN + 0.5 * (height - size[1])])
        pixels = max(1, round(size[0] * DPI)), max(1, round(size[1] * DPI))
        _show_image(axis, image(view, window, pixels), corner, size)
        if over is not None:
            over(axis, view, partial(_inches, corner, window, inches), inches)
        axis.text(
            left + 0.5 * panel, total_height - 0.58, view.title, color=color, fontsize=11, ha="center", va="center"
        )
        _scale_bar(axis, left, length, inches, unit, color)
        left += panel + _VIEW_GAP
    if bar is not None:
        bar.draw(axis, left, _SCALE_BAR_MARGIN + 0.5 * height, color)
    axis.set(xlim=(0, width), ylim=(0, total_height))
    save(figure, path)


def drawing_style(look: Figures) -> AbstractContextManager[None]:
    """Return a context with readable default colours on the chosen background, and text that can be edited."""
    import matplotlib

    ground = look.ground("white")
    dark = ink(ground)
    backgrounds = dict.fromkeys(("figure.facecolor", "axes.facecolor", "savefig.facecolor"), ground)
    inks = dict.fromkeys(("text.color", "axes.labelcolor", "axes.edgecolor", "xtick.color", "ytick.color"), dark)
    # Text stays text, which can be edited and searched; ids are the same in each run.
    files = {"svg.fonttype": "none", "pdf.fonttype": 42, "svg.hashsalt": "pcbench"}
    return matplotlib.rc_context({**backgrounds, **inks, **files})


def new_figure(width: float, height: float, dpi: float = DPI, **options: Any) -> Any:
    """Return a `matplotlib.figure.Figure` of a size in inches, which needs no display."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=dpi, **options)
    FigureCanvasAgg(figure)
    return figure


def save(figure: Any, path: Path) -> None:
    """Save a figure in the format of the path's extension; the same figure gives the same bytes.

    A link is replaced, and the file that it names is not changed.
    """
    if path.is_symlink():
        path.unlink()
    kind = path.suffix[1:]
    # Dots hardly compress: a higher level takes longer and saves little.
    quick: dict[str, Any] = {"pil_kwargs": {"compress_level": 2}} if kind == "png" else {}
    figure.savefig(path, facecolor=figure.get_facecolor(), metadata=METADATA[kind], **quick)


def _canvas(width: float, height: float, ground: str) -> tuple[Any, Any]:
    """Return a figure, and axes in inches that fill it; one set of axes is faster than one per view."""
    figure = new_figure(width, height, facecolor=ground)
    axis = figure.add_axes((0, 0, 1, 1))
    axis.set_axis_off()
    axis.set(xlim=(0, width), ylim=(0, height))
    return figure, axis


def _show_image(axis: Any, image: NDArray[np.uint8], corner: FloatArray, size: FloatArray) -> None:
    (x, y), (wide, high) = np.round(corner * DPI) / DPI, size  # aligned to pixels, which avoids smoothing
    axis.imshow(image, extent=(x, x + wide, y, y + high), aspect="auto", interpolation="nearest")


def _inches(corner: FloatArray, window: FloatArray, inches: float, positions: FloatArray) -> FloatArray:
    """Convert positions (N, 2) in a window to inches in the picture."""
    placed: FloatArray = corner + (positions - window[0]) * inches
    return placed


def _bar_label(length: float, unit: str) -> str:
    """Return a length with its unit, or with "units" if the unit's name is too long for a bar."""
    if len(unit) < 6:
        return f"{length:g} {unit}"
    return "1 unit" if length == 1 else f"{length:g} units"


def _scale_bar(axis: Any, left: float, length: float, inches: float, unit: str, color: str) -> None:
    """Draw a scale bar below a view; it applies to lengths parallel to it, in all views."""
    right = left + length * inches
    style = {"color": color, "linewidth": 1.3, "solid_capstyle": "butt", "solid_joinstyle": "miter"}
    axis.plot([left, left, right, right], [0.3, 0.24, 0.24, 0.3], **style)
    axis.text(right + 0.06, 0.26, _bar_label(length, unit), color=color, fontsize=9, ha="left", va="center")


class _Bar(NamedTuple):
    """A colour bar with its texts, in inches."""

    scale: Range
    height: float
    ticks: list[float]
    label: list[str]
    note: list[str]

    @classmethod
    def of(cls, scale: Range, label: str, height: float) -> _Bar:
        """Return the bar of a colour range with its ticks and wrapped texts."""
        from matplotlib.ticker import MaxNLocator

        rounding = 1e-9 * scale.high
        candidates = MaxNLocator(max(3, int(2 * height)), steps=(1, 2, 5, 10)).tick_values(scale.low, scale.high)
        ticks = [float(t) for t in candidates if scale.low - rounding <= t <= scale.high + rounding]
        ticks = [0.0 if abs(t) < rounding else t for t in ticks]
        return cls(
            scale, height, ticks, _lines(printable(label), 14 * (height + 0.5)), _lines(scale.note, 17 * (height + 0.5))
        )

    @property
    def label_at(self) -> float:
        """Distance of the label from the left side of the bar."""
        return _BAR_WIDTH + 0.2 + 0.078 * max(len(_number(tick)) for tick in self.ticks)

    @property
    def note_at(self) -> float:
        """Distance of the note from the left side of the bar."""
        return self.label_at + 0.18 * len(self.label) + 0.04

    @property
    def space(self) -> float:
        """Width of the bar with its texts."""
        return self.note_at + 0.135 * len(self.note) + 0.15

    def draw(self, axis: Any, left: float, middle: float, color: str) -> None:
        """Draw the bar, with an arrow at each end that stands for values beyond it."""
        from matplotlib.patches import Polygon

        scale, center = self.scale, left + 0.5 * _BAR_WIDTH
        tip = 0.0 if scale.is_closed else 0.14
        low, high, right = middle - 0.5 * self.height, middle + 0.5 * self.height, left + _BAR_WIDTH
        steps = scale.colors(np.linspace(scale.high, scale.low, 256))[:, None]
        axis.imshow(steps, extent=(left, right, low, high), aspect="auto", interpolation="nearest")
        outline = [(right, low), (right, high), (center, high + tip), (left, high), (left, low)]
        ends = [(outline[1:4], steps[0, 0])]
        if scale.signed:
            outline.append((center, low - tip))
            ends.append(([outline[4], outline[0], outline[5]], steps[-1, 0]))
        for corners, end_color in ends:
            axis.add_patch(Polygon(corners, facecolor=end_color / 255, edgecolor="none"))
        axis.add_patch(Polygon(outline, fill=False, edgecolor=color, linewidth=0.8))
        for tick in self.ticks:
            y = low + self.height * (tick - scale.low) / (scale.high - scale.low)
            axis.plot([right, right + 0.05], [y, y], color=color, linewidth=0.8)
            axis.text(right + 0.09, y, _number(tick), color=color, fontsize=9.5, va="center")
        upright: dict[str, Any] = {"rotation": 90, "color": color, "ha": "left", "va": "center", "parse_math": False}
        axis.text(left + self.label_at, middle, "\n".join(self.label), fontsize=10.5, **upright)
        axis.text(left + self.note_at, middle, "\n".join(self.note), fontsize=8, alpha=0.8, **upright)


class _Legend(NamedTuple):
    """A legend of few values, in inches."""

    classes: Classes
    label: str

    @property
    def height(self) -> float:
        """Height of the label and all rows."""
        return _LEGEND_ROW * (len(self.classes.names) + 1.5)

    @property
    def space(self) -> float:
        """Width of the legend with its texts."""
        return max(0.34 + 0.08 * max(map(len, self.classes.names)), 0.09 * len(self.label)) + 0.15

    def draw(self, axis: Any, left: float, middle: float, color: str) -> None:
        """Draw the label, then a box with its name for each value."""
        from matplotlib.patches import Rectangle

        text: dict[str, Any] = {"color": color, "va": "center", "parse_math": False}
        y = middle + 0.5 * self.height - 0.5 * _LEGEND_ROW
        axis.text(left, y, self.label, fontsize=10.5, **text)
        y -= 0.25 * _LEGEND_ROW
        for name, fill in zip(self.classes.names, self.classes.table / 255, strict=True):
            y -= _LEGEND_ROW
            box = Rectangle((left, y - 0.07), 0.22, 0.14, facecolor=fill, edgecolor=color, linewidth=0.6)
            axis.add_patch(box)
            axis.text(left + 0.32, y, name, fontsize=9.5, **text)


def _lines(text: str, letters: float) -> list[str]:
    """Wrap a text into lines of about equal length."""
    count = max(1, math.ceil(len(text) / letters))
    return wrap(text, len(text) // count + (6 if count > 1 else 1))


def _number(value: float) -> str:
    return f"{value:.4g}".replace("-", "−")


def join_title(*parts: str) -> str:
    """Join the non-empty parts of a title with semicolons."""
    return "; ".join(filter(None, parts))
