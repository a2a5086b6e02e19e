"""Axes along the edges of a box, with ticks and labels at round coordinates, and a camera that shows them whole."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from pcbench.geometry.arrays import FloatArray
from pcbench.report.plot.views import Viewpoint, round_length

VIEW = Viewpoint("from the south-west", (-1, -1, 1.1), (0, 0, 1))
"""The view in which the axes lie in front and on the left, with their labels outside of the box."""

FONT_PX = 13
_CHARACTER_PX, _LINE_PX = 7.2, 14.0  # size of text of that font, rounded up
_TICK_PX, _LABEL_PX = 7.0, 18.0  # distances from the axis
_TITLE_GAP_PX = 24.0
_INTERVALS = 4  # at least this many between the labels of a long axis
_MIN_INTERVAL_PX = 36.0  # between labels, so that those of an inclined axis do not overlap
_MIN_BOX_SHARE = 0.3  # of a small window, for the box
_LAYOUTS = 4  # rounds in which size and labels are adapted to each other


class Text(NamedTuple):
    """A text beside an axis.

    Attributes:
        text: the text.
        place: (3,) the point at its edge.
        side: the side of the text on which the point is: `left` or `right`.
        below: whether the text hangs below the point, or is at its height.
    """

    text: str
    place: FloatArray
    side: str
    below: bool

    def rectangle(self, place: FloatArray) -> FloatArray:
        """Return the lower left and the upper right corner (2, 2), in pixels, for the point at `place` (2,)."""
        width = _CHARACTER_PX * len(self.text)
        left, top = -width if self.side == "right" else 0.0, 0.0 if self.below else 0.5 * _LINE_PX
        corners: FloatArray = place + np.array([[left, top - _LINE_PX], [left + width, top]])
        return corners


class LabelledAxis(NamedTuple):
    """An axis of a box.

    Attributes:
        ends: (2, 3) its ends.
        values: (K,) coordinates of its ticks, which are round.
        ticks: (K, 2, 3) ends of the ticks.
        labels: the labels of the ticks.
        title: the title, beyond the labels.
    """

    ends: FloatArray
    values: FloatArray
    ticks: FloatArray
    labels: tuple[Text, ...]
    title: Text


Axes = tuple[LabelledAxis, LabelledAxis, LabelledAxis]


class Layout(NamedTuple):
    """Axes, and what a camera shows.

    Attributes:
        axes: the axes.
        pixel: size of a pixel, in units of the scene.
        middle: (2,) middle of box and texts in the view's plane, in units of the scene.
    """

    axes: Axes
    pixel: float
    middle: FloatArray


def lay_out(low: FloatArray, high: FloatArray, titles: Sequence[str], size: FloatArray) -> Layout:
    """Return the axes of a box, with the largest scale at which box and texts fit into a part of the window.

    Args:
        low: (3,) lower corner.
        high: (3,) upper corner.
        titles: the titles of the axes.
        size: (2,) width and height of the part, in pixels.
    """
    flat = VIEW.axes[:2].T
    corners = np.stack(np.meshgrid(*zip(low, high, strict=True)), axis=-1).reshape(-1, 3) @ flat
    extent = corners.max(axis=0) - corners.min(axis=0)
    pixel = float((extent / size).max()) or 1.0
    for _ in range(_LAYOUTS):
        axes = axes_of(low, high, titles, pixel)
        texts = [text for axis in axes for text in (*axis.labels, axis.title)]
        shown = np.concatenate([corners / pixel, *(text.rectangle(text.place @ flat / pixel) for text in texts)])
        lowest, highest = shown.min(axis=0), shown.max(axis=0)
        layout = Layout(axes, pixel, 0.5 * (lowest + highest) * pixel)
        overhang = highest - lowest - extent / pixel
        pixel = float((extent / np.maximum(size - overhang, _MIN_BOX_SHARE * size)).max()) or 1.0
    return layout


def axes_of(low: FloatArray, high: FloatArray, titles: Sequence[str], pixel: float) -> Axes:
    """Return the axes of a box, placed at the edges that `VIEW` shows in front and on the left.

    Args:
        low: (3,) lower corner.
        high: (3,) upper corner.
        titles: the titles of the axes.
        pixel: size of a pixel, in units of the scene.
    """
    x, y, z = titles
    left = np.array([low[0], high[1], low[2]])  # the corner of the vertical axis
    return (
        _axis(0, x, low, float(high[0]), np.array([0.0, -1, 0]), pixel),
        _axis(1, y, low, float(high[1]), np.array([-1.0, 0, 0]), pixel),
        _axis(2, z, left, float(high[2]), np.array([-(0.5**0.5), 0.5**0.5, 0]), pixel),
    )


def _axis(k: int, title: str, start: FloatArray, end: float, outwards: FloatArray, pixel: float) -> LabelledAxis:
    length = end - float(start[k])
    step = round_length(max(length / _INTERVALS, 1e-300))
    values = _multiples(step, float(start[k]), end)
    if step < _MIN_INTERVAL_PX * pixel:
        values = (
            values[[0, -1]] if len(values) > 1 and values[-1] - values[0] >= _MIN_INTERVAL_PX * pixel else values[:0]
        )
    unit = np.eye(3)[k]
    at = start + (values[:, None] - start[k]) * unit
    stop = start + length * unit
    side, below = "left" if k == 0 else "right", k < 2
    labels = [
        Text(f"{value:.6g}", place + _LABEL_PX * pixel * outwards, side, below)
        for value, place in zip(values, at, strict=True)
    ]
    # Labels and title of an inclined axis are at different heights, so that the title need not be beyond all labels.
    width = _CHARACTER_PX * max((len(label.text) for label in labels), default=0)
    beyond = _LABEL_PX + (0.75 * (width + _TITLE_GAP_PX) if labels else 0.0)
    place = 0.5 * (start + stop) + beyond * pixel * outwards if below else stop + _TITLE_GAP_PX * pixel * unit
    return LabelledAxis(
        ends=np.stack([start, stop]),
        values=values,
        ticks=np.stack([at, at + _TICK_PX * pixel * outwards], axis=1),
        labels=tuple(labels),
        title=Text(title, place, side, below),
    )


def _multiples(step: float, low: float, high: float) -> FloatArray:
    """Return the multiples of a step from `low` to `high`."""
    multiples: FloatArray = (
        step * np.arange(np.ceil(low / step - 1e-9), np.floor(high / step + 1e-9) + 1) + 0.0
    )  # no -0
    return multiples
