"""Where a cloud is seen from, and which part of it: the same windows and scale for all pictures of a report."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray

_MARGIN = 0.05  # of a box, around the inner 99 % of the points: with it most of the rest is in the picture too
_BEYOND = 0.25  # of the reference's box: so far a candidate's own points may widen it
_MAX_LOOKED_AT = 200_000  # points that a box or a window is found from


@dataclass(frozen=True)
class Viewpoint:
    """A parallel camera: where it stands as a direction from the centre, and what is up."""

    title: str
    direction: tuple[float, float, float]
    up: tuple[float, float, float]

    @property
    def axes(self) -> FloatArray:
        """What is right, up and toward the viewer, as rows of a rotation (3, 3)."""
        toward = np.array(self.direction) / np.linalg.norm(self.direction)
        right = np.cross(self.up, toward)
        right /= np.linalg.norm(right)
        return np.stack([right, np.cross(toward, right), toward])


VIEWS = (
    Viewpoint("from above", (0, 0, 1), (0, 1, 0)),
    Viewpoint("from the south-west", (-1, -1, 1.1), (0, 0, 1)),
    Viewpoint("from the north-east", (1, 1, 1.1), (0, 0, 1)),
)


@dataclass(frozen=True, eq=False)
class AxisBox:
    """Corners (3,) along the axes."""

    low: FloatArray
    high: FloatArray

    @property
    def center(self) -> FloatArray:
        return 0.5 * (self.low + self.high)

    @classmethod
    def around(cls, points: FloatArray) -> AxisBox:
        """Of the inner 99 % of points (N, 3) along each axis, with a margin: strays do not decide."""
        low, high = np.percentile(some(points), [0.5, 99.5], axis=0)
        margin = _MARGIN * (high - low) + 1e-3 * float(np.linalg.norm(high - low))
        return cls(low - margin, high + margin)

    def grown(self) -> AxisBox:
        """A quarter of its own size larger to each side."""
        reach = _BEYOND * (self.high - self.low)
        return AxisBox(self.low - reach, self.high + reach)

    def widened(self, others: Iterable[AxisBox]) -> AxisBox:
        """With what of others lies beyond it, as far as it may grow."""
        low, high, most = self.low, self.high, self.grown()
        for other in others:
            low = np.minimum(low, np.maximum(other.low, most.low))
            high = np.maximum(high, np.minimum(other.high, most.high))
        return AxisBox(low, high)

    def holds(self, points: FloatArray) -> NDArray[np.bool_]:
        """Which of points (N, 3) lie inside."""
        inside: NDArray[np.bool_] = np.all((points >= self.low) & (points <= self.high), axis=1)
        return inside

    def share(self, points: FloatArray) -> float:
        """Of points (N, 3), how many lie inside."""
        return float(self.holds(points).mean())


@dataclass(frozen=True, eq=False)
class Frame:
    """What pictures show: a box, and of each view the window in its picture plane.

    Attributes:
        windows: (V, 2, 2): lower left and upper right corner of each view, in units of the scene from the box's centre.
    """

    box: AxisBox
    windows: FloatArray

    @classmethod
    def of(cls, box: AxisBox, clouds: Sequence[FloatArray]) -> Frame:
        """Around what of points (N, 3) is in the box."""
        shown = [points[box.holds(points)] for points in map(some, clouds)]
        inside = np.concatenate([*shown, *([np.stack([box.low, box.high])] if not any(map(len, shown)) else [])])
        windows = []
        for view in VIEWS:
            flat = (inside - box.center) @ view.axes[:2].T
            low, high = flat.min(axis=0), flat.max(axis=0)
            # What has no extent, such as a wall from above, still gets a strip of the picture.
            most = float((high - low).max()) or 1.0
            pad = 0.02 * most + np.maximum(0.0, 0.03 * most - (high - low))
            windows.append([low - pad, high + pad])
        return cls(box, np.array(windows))

    @property
    def sizes(self) -> FloatArray:
        """Width and height of each window (V, 2), in units of the scene."""
        sizes: FloatArray = self.windows[:, 1] - self.windows[:, 0]
        return sizes


def round_length(at_most: float) -> float:
    """The largest 1, 2 or 5 times a power of ten that is not more."""
    power = 10.0 ** np.floor(np.log10(at_most))
    return float(max(step * power for step in (1, 2, 5) if step * power <= at_most * (1 + 1e-9)))


def some(points: FloatArray) -> FloatArray:
    """Points (N, 3), evenly thinned where they are many."""
    thinned: FloatArray = points[:: max(1, len(points) // _MAX_LOOKED_AT)]
    return thinned
