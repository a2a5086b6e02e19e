"""Axes along the edges of a box, with ticks and labels at round coordinates."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pcbench.geometry.arrays import FloatArray
from pcbench.report.plot.views import SOUTH_WEST, Viewpoint, round_length

_INTERVALS = 4  # at least this many between the labels of the longest axis
_MIN_INTERVAL_SHARE = 0.08  # of the longest axis, between labels; an axis that is too short for four has two
_MIN_AXIS_SHARE = 0.04  # of the longest axis, for an axis with labels
_TICK_SHARE, _LABEL_SHARE, _TITLE_SHARE = 0.015, 0.05, 0.13  # distances from the axis, as shares of the longest axis


class LabelledAxis(NamedTuple):
    """An axis of a box.

    Attributes:
        ends: (2, 3) its ends.
        values: (K,) coordinates of its ticks, which are round.
        ticks: (K, 2, 3) ends of the ticks.
        places: (K, 3) middles of the labels.
        title_place: (3,) middle of the title, beyond the labels.
    """

    ends: FloatArray
    values: FloatArray
    ticks: FloatArray
    places: FloatArray
    title_place: FloatArray


def axes_of(
    low: FloatArray, high: FloatArray, view: Viewpoint = SOUTH_WEST
) -> tuple[LabelledAxis, LabelledAxis, LabelledAxis]:
    """Return the axes of a box, placed at the edges that a view shows in front and on the left.

    Args:
        low: (3,) lower corner.
        high: (3,) upper corner.
        view: the view.
    """
    longest = float((high - low).max()) or 1.0
    vertical = int(np.argmax(np.abs(view.up)))
    right, up, _ = view.axes
    axes = []
    for k in range(3):
        # Among four parallel edges, the one at the border of the box's picture: on the left, or below.
        across = np.array([up[k], -right[k]])
        if across @ ((-1, 0) if k == vertical else (0, -1)) < 0:
            across = -across
        is_high = np.stack([right, up], axis=1) @ across > 0
        start = np.where(is_high, high, low)
        start[k] = low[k]
        beside = 3 - vertical - k  # the other horizontal axis
        outwards = -right if k == vertical else (1 if is_high[beside] else -1) * np.eye(3)[beside]
        axes.append(_axis(k, start, float(high[k]), outwards, longest, top=np.sign(up[k]) * (k == vertical)))
    return axes[0], axes[1], axes[2]


def _axis(k: int, start: FloatArray, end: float, outwards: FloatArray, longest: float, top: float) -> LabelledAxis:
    """Return an axis from its start (3,) to a coordinate; `top` is the sign of its upper end, 0 if it has none."""
    length = end - float(start[k])
    step = round_length(max(length / _INTERVALS, 1e-300))
    values = _multiples(step, float(start[k]), end)
    if step < _MIN_INTERVAL_SHARE * longest:
        values = values[[0, -1]] if length >= _MIN_AXIS_SHARE * longest and len(values) > 1 else values[:0]
    unit = np.eye(3)[k]
    at = start + (values[:, None] - start[k]) * unit
    stop = start + length * unit
    above = (stop if top > 0 else start) + top * _LABEL_SHARE * longest * unit
    beside = 0.5 * (start + stop) + _TITLE_SHARE * longest * outwards
    return LabelledAxis(
        ends=np.stack([start, stop]),
        values=values,
        ticks=np.stack([at, at + _TICK_SHARE * longest * outwards], axis=1),
        places=at + _LABEL_SHARE * longest * outwards,
        title_place=above if top else beside,
    )


def _multiples(step: float, low: float, high: float) -> FloatArray:
    """Return the multiples of a step from `low` to `high`."""
    multiples: FloatArray = (
        step * np.arange(np.ceil(low / step - 1e-9), np.floor(high / step + 1e-9) + 1) + 0.0
    )  # no -0
    return multiples
