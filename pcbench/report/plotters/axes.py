"""Axes along the edges of a box, with ticks and labels at round coordinates."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pcbench.geometry.arrays import FloatArray
from pcbench.report.plot.views import round_length

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


def axes_of(low: FloatArray, high: FloatArray) -> tuple[LabelledAxis, LabelledAxis, LabelledAxis]:
    """Return the axes of a box, placed at the edges that the view from the south-west shows in front and on the left.

    Args:
        low: (3,) lower corner.
        high: (3,) upper corner.
    """
    longest = float((high - low).max()) or 1.0
    left = np.array([low[0], high[1], low[2]])  # the corner of the vertical axis
    outwards = np.array([[0.0, -1, 0], [-1, 0, 0], [-(0.5**0.5), 0.5**0.5, 0]])
    starts = (low, low, left)
    return tuple(_axis(k, starts[k], float(high[k]), outwards[k], longest) for k in range(3))  # type: ignore[return-value]


def _axis(k: int, start: FloatArray, end: float, outwards: FloatArray, longest: float) -> LabelledAxis:
    length = end - float(start[k])
    step = round_length(max(length / _INTERVALS, 1e-300))
    values = _multiples(step, float(start[k]), end)
    if step < _MIN_INTERVAL_SHARE * longest:
        values = values[[0, -1]] if length >= _MIN_AXIS_SHARE * longest and len(values) > 1 else values[:0]
    unit = np.eye(3)[k]
    at = start + (values[:, None] - start[k]) * unit
    stop = start + length * unit
    middle = 0.5 * (start + stop)
    return LabelledAxis(
        ends=np.stack([start, stop]),
        values=values,
        ticks=np.stack([at, at + _TICK_SHARE * longest * outwards], axis=1),
        places=at + _LABEL_SHARE * longest * outwards,
        title_place=stop + _LABEL_SHARE * longest * unit if k == 2 else middle + _TITLE_SHARE * longest * outwards,
    )


def _multiples(step: float, low: float, high: float) -> FloatArray:
    """Return the multiples of a step from `low` to `high`."""
    multiples: FloatArray = (
        step * np.arange(np.ceil(low / step - 1e-9), np.floor(high / step + 1e-9) + 1) + 0.0
    )  # no -0
    return multiples
