"""Axes along the edges of a box, with ticks and labels at round coordinates, laid out for a view of the box."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import count
from typing import NamedTuple

import numpy as np

from pcbench.geometry.arrays import FloatArray
from pcbench.report.plot.rounding import round_length
from pcbench.report.plot.views import Viewpoint

FONT_PX = 13
_CHARACTER_PX, _LINE_PX = 7.2, 14.0  # size of text of that font, rounded up
_TICK_PX, _LABEL_PX = 7.0, 18.0  # distances from the axis
_LABEL_GAP_PX, _TITLE_GAP_PX = (6.0, 2.0), (16.0, 14.0)  # beside and above a text
_TITLE_STEP_PX = 4.0  # by which a title moves away from other texts
_INTERVALS = (4, 2)  # at least this many between the labels of an axis; labels at its ends where these have no room
_MIN_SLOPE = 0.2  # of the direction away from the box, for a text that is wholly on that side of its point
_MIN_BOX_SHARE = 0.3  # of a small window, for the box
_LAYOUTS = 8  # rounds in which scale and labels are adapted to each other


class Text(NamedTuple):
    """A text beside an axis.

    Attributes:
        text: the text.
        place: (3,) a point at its edge, or at its middle.
        horizontal: where the point is in the text: `left`, `center` or `right`.
        vertical: where the point is in the text: `bottom`, `center` or `top`.
    """

    text: str
    place: FloatArray
    horizontal: str
    vertical: str

    def rectangle(self, view: Viewpoint, pixel: float) -> FloatArray:
        """Return the lower left and the upper right corner (2, 2) in the view's plane, in pixels."""
        shares = {"left": 0.0, "bottom": 0.0, "center": 0.5, "right": 1.0, "top": 1.0}
        size = np.array([_CHARACTER_PX * len(self.text), _LINE_PX])
        low = view.axes[:2] @ self.place / pixel - size * [shares[self.horizontal], shares[self.vertical]]
        return np.stack([low, low + size])


class LabelledAxis(NamedTuple):
    """An axis of a box.

    Attributes:
        ends: (2, 3) its ends.
        values: (K,) coordinates of its ticks, which are round.
        ticks: (K, 2, 3) ends of the ticks.
        labels: the labels of the ticks, except those that would overlap a label of another axis.
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


def lay_out(low: FloatArray, high: FloatArray, titles: Sequence[str], view: Viewpoint, size: FloatArray) -> Layout:
    """Return the axes of a box, with a large scale at which box and texts fit into a part of the window.

    Args:
        low: (3,) lower corner.
        high: (3,) upper corner.
        titles: the titles of the axes.
        view: the view.
        size: (2,) width and height of the part, in pixels.
    """
    corners = np.stack(np.meshgrid(*zip(low, high, strict=True)), axis=-1).reshape(-1, 3) @ view.axes[:2].T
    extent = corners.max(axis=0) - corners.min(axis=0)
    pixel = float((extent / size).max()) or 1.0
    for _ in range(_LAYOUTS):
        axes = axes_of(low, high, titles, view, pixel)
        texts = [text.rectangle(view, pixel) for axis in axes for text in (*axis.labels, axis.title)]
        outline = np.concatenate([corners / pixel, *texts])
        lowest, highest = outline.min(axis=0), outline.max(axis=0)
        layout = Layout(axes, pixel, 0.5 * (lowest + highest) * pixel)
        if (highest - lowest < size + 1).all():
            break
        overhang = highest - lowest - extent / pixel
        pixel = float((extent / np.maximum(size - overhang, _MIN_BOX_SHARE * size)).max()) or 1.0
    return layout


def axes_of(low: FloatArray, high: FloatArray, titles: Sequence[str], view: Viewpoint, pixel: float) -> Axes:
    """Return the axes of a box at the border of its picture, with texts that overlap neither it nor each other.

    The axis closest to the upward direction is on the left, and its title above its upper end. The others are below.

    Args:
        low: (3,) lower corner.
        high: (3,) upper corner.
        titles: the titles of the axes.
        view: the view.
        pixel: size of a pixel, in units of the scene.
    """
    edges = [_Edge.of(k, low, high, view) for k in range(3)]
    values = [edge.round_coordinates(pixel) for edge in edges]
    rectangles: list[FloatArray] = []  # of the texts
    labels: list[list[Text]] = [[], [], []]
    for k, edge in enumerate(edges):
        for label in edge.labels(values[k], pixel):
            rectangle = label.rectangle(view, pixel)
            if _has_room(rectangle, rectangles, _LABEL_GAP_PX):
                labels[k].append(label)
                rectangles.append(rectangle)
    axes = []
    for k, edge in enumerate(edges):
        places = (edge.title(titles[k], _LABEL_PX + n * _TITLE_STEP_PX, pixel) for n in count())
        title = next(title for title in places if _has_room(title.rectangle(view, pixel), rectangles, _TITLE_GAP_PX))
        rectangles.append(title.rectangle(view, pixel))
        axes.append(LabelledAxis(edge.ends, values[k], edge.ticks(values[k], pixel), tuple(labels[k]), title))
    return axes[0], axes[1], axes[2]


class _Edge(NamedTuple):
    """An edge of a box, at the border of the box's picture.

    Attributes:
        axis: the number of its axis.
        ends: (2, 3) its ends.
        slope: (2,) movement in the view's plane per unit of its coordinate.
        outwards: (3,) unit vector away from the box: in the view's plane, and perpendicular to the edge.
        upwards: (3,) unit vector along the edge in the view's plane, for the axis closest to the upward direction.
        horizontal: where texts have their points, see `Text`.
        vertical: where texts have their points, see `Text`.
    """

    axis: int
    ends: FloatArray
    slope: FloatArray
    outwards: FloatArray
    upwards: FloatArray | None
    horizontal: str
    vertical: str

    @classmethod
    def of(cls, axis: int, low: FloatArray, high: FloatArray, view: Viewpoint) -> _Edge:
        """Return the edge of a box for an axis: among four parallel ones, that on the left or below in the picture."""
        flat = view.axes[:2]
        slope = flat[:, axis]
        length = float(np.linalg.norm(slope))
        along = slope / length if length > 0 else np.array([0.0, 1.0])
        is_upright = axis == int(np.argmax(np.abs(view.up)))
        right, up = along[1], -along[0]  # perpendicular to the edge
        if (right > 0) if is_upright else (up > 0):
            right, up = -right, -up
        outwards = np.array([right, up]) @ flat
        start = np.where(outwards > 0, high, low)
        start[axis] = low[axis]
        stop = start.copy()
        stop[axis] = high[axis]
        return cls(
            axis=axis,
            ends=np.stack([start, stop]),
            slope=slope,
            outwards=outwards,
            upwards=(along if along[1] >= 0 else -along) @ flat if is_upright else None,
            horizontal="left" if right > _MIN_SLOPE else "right" if right < -_MIN_SLOPE else "center",
            vertical="bottom" if up > _MIN_SLOPE else "top" if up < -_MIN_SLOPE else "center",
        )

    def round_coordinates(self, pixel: float) -> FloatArray:
        """Return round coordinates (K,) along the edge whose labels do not overlap; none if only one has room."""
        low, high = self.ends[:, self.axis].tolist()
        fine, coarse = (_multiples(round_length(max((high - low) / n, 1e-300)), low, high) for n in _INTERVALS)
        first_and_last = fine[:: max(len(fine) - 1, 1)]
        return next((values for values in (fine, coarse, first_and_last) if self._holds(values, pixel)), fine[:0])

    def labels(self, values: FloatArray, pixel: float) -> list[Text]:
        """Return the labels of coordinates (K,)."""
        places = self._points(values) + _LABEL_PX * pixel * self.outwards
        return [self._text(_label(value), place) for value, place in zip(values, places, strict=True)]

    def ticks(self, values: FloatArray, pixel: float) -> FloatArray:
        """Return the ends (K, 2, 3) of ticks at coordinates (K,)."""
        starts = self._points(values)
        return np.stack([starts, starts + _TICK_PX * pixel * self.outwards], axis=1)

    def title(self, text: str, distance_px: float, pixel: float) -> Text:
        """Return the title at a distance from the edge: above its upper end, or beside its middle."""
        if self.upwards is None:
            return self._text(text, self.ends.mean(axis=0) + distance_px * pixel * self.outwards)
        top = self.ends[int(np.argmax(self.ends @ self.upwards))]
        return self._text(text, top + (_LABEL_PX * self.outwards + distance_px * self.upwards) * pixel)

    def _points(self, values: FloatArray) -> FloatArray:
        """Return the points (K, 3) of the edge at coordinates (K,)."""
        points = np.repeat(self.ends[:1], len(values), axis=0)
        points[:, self.axis] = values
        return points

    def _holds(self, values: FloatArray, pixel: float) -> bool:
        """Return whether there are at least two coordinates (K,), with room for their labels."""
        if len(values) < 2:
            return False
        size = _CHARACTER_PX * max(len(_label(value)) for value in values), _LINE_PX
        interval = np.abs(self.slope) * (values[1] - values[0]) / pixel
        return bool((interval >= np.add(size, _LABEL_GAP_PX)).any())

    def _text(self, text: str, place: FloatArray) -> Text:
        return Text(text, place, self.horizontal, self.vertical)


def _has_room(rectangle: FloatArray, others: list[FloatArray], gap: tuple[float, float]) -> bool:
    """Return whether a rectangle (2, 2) has a gap to each of the others, beside or above it."""
    low, high = rectangle
    return all((low >= other[1] + gap).any() or (other[0] >= high + gap).any() for other in others)


def _label(value: float) -> str:
    return f"{value:.6g}"


def _multiples(step: float, low: float, high: float) -> FloatArray:
    """Return the multiples of a step from `low` to `high`."""
    multiples: FloatArray = (
        step * np.arange(np.ceil(low / step - 1e-9), np.floor(high / step + 1e-9) + 1) + 0.0
    )  # no -0
    return multiples
