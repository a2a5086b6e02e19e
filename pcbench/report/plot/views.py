"""Viewpoints that suit a scene, and frames: the same windows and scale for all pictures of a report."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray

_MARGIN_SHARE = 0.05  # of a box around the inner 99 % of the points, which then includes most of the others too
_MAX_GROWTH_SHARE = 0.25  # of the size of the reference's box, for candidates that extend beyond it
_MIN_SIZE_SHARE = 0.2  # of the diagonal: a wall is thinner than the deviations that its frame shows
_MAX_SAMPLE = 200_000  # points that determine a box or a window
_MAX_FLATNESS = 0.35  # ratio of the smallest to the middle standard deviation of a wall
_MIN_SLENDERNESS = 0.75  # ratio of height to horizontal size of an object, which is seen from the sides


@dataclass(frozen=True)
class Viewpoint:
    """A parallel camera.

    Attributes:
        title: title of the view.
        direction: direction from the centre towards the camera.
        up: the upward direction.
    """

    title: str
    direction: tuple[float, float, float]
    up: tuple[float, float, float]

    @property
    def axes(self) -> FloatArray:
        """The directions right, up and towards the viewer, as rows of a rotation (3, 3)."""
        toward = np.array(self.direction) / np.linalg.norm(self.direction)
        right = np.cross(self.up, toward)
        right /= np.linalg.norm(right)
        return np.stack([right, np.cross(toward, right), toward])


@dataclass(frozen=True, eq=False)
class AxisBox:
    """An axis-aligned box.

    Attributes:
        low: (3,) lower corner.
        high: (3,) upper corner.
    """

    low: FloatArray
    high: FloatArray

    @property
    def center(self) -> FloatArray:
        """Centre (3,) of the box."""
        return 0.5 * (self.low + self.high)

    @classmethod
    def around(cls, points: FloatArray) -> AxisBox:
        """Return the box of the inner 99 % of points (N, 3) along each axis, with a margin; outliers are ignored."""
        low, high = np.percentile(thin_out(points), [0.5, 99.5], axis=0)
        margin = _MARGIN_SHARE * (high - low) + 1e-3 * float(np.linalg.norm(high - low))
        return cls(low - margin, high + margin)

    def grown(self) -> AxisBox:
        """Return the box enlarged on each side by a quarter of its size, or of a fifth of its diagonal if flat."""
        size = self.high - self.low
        reach = _MAX_GROWTH_SHARE * np.maximum(size, _MIN_SIZE_SHARE * float(np.linalg.norm(size)))
        return AxisBox(self.low - reach, self.high + reach)

    def widen(self, others: Iterable[AxisBox]) -> AxisBox:
        """Return the box enlarged to include other boxes, at most to `grown`."""
        low, high, limit = self.low, self.high, self.grown()
        for other in others:
            low = np.minimum(low, np.maximum(other.low, limit.low))
            high = np.maximum(high, np.minimum(other.high, limit.high))
        return AxisBox(low, high)

    def holds(self, points: FloatArray) -> NDArray[np.bool_]:
        """Return which points (N, 3) lie inside, as (N,) booleans."""
        inside: NDArray[np.bool_] = np.all((points >= self.low) & (points <= self.high), axis=1)
        return inside

    def share(self, points: FloatArray) -> float:
        """Return the share of points (N, 3) inside."""
        return float(self.holds(points).mean())


@dataclass(frozen=True, eq=False)
class Frame:
    """The frame of pictures: a box, and the window of each view in its image plane.

    Attributes:
        box: the box.
        views: the viewpoints.
        windows: (V, 2, 2) lower left and upper right corner of each view, in units of the scene from the box's centre.
    """

    box: AxisBox
    views: tuple[Viewpoint, ...]
    windows: FloatArray

    @classmethod
    def of(cls, box: AxisBox, clouds: Sequence[FloatArray], *, has_north: bool = False) -> Frame:
        """Return the frame around the points (N, 3) inside a box, with views that suit their shape.

        Args:
            box: the box.
            clouds: points (N, 3) of each cloud.
            has_north: whether the second axis points north, as in a known coordinate system.
        """
        parts = [points[box.holds(points)] for points in map(thin_out, clouds)]
        inside = np.concatenate([*parts, *([np.stack([box.low, box.high])] if not any(map(len, parts)) else [])])
        views = suitable_views(inside, has_north=has_north)
        windows = []
        for view in views:
            flat = (inside - box.center) @ view.axes[:2].T
            low, high = flat.min(axis=0), flat.max(axis=0)
            # A view without extent, such as a wall from above, still gets a strip of the picture.
            size = float((high - low).max()) or 1.0
            pad = 0.02 * size + np.maximum(0.0, 0.03 * size - (high - low))
            windows.append([low - pad, high + pad])
        return cls(box, views, np.array(windows))

    @property
    def sizes(self) -> FloatArray:
        """Width and height of each window (V, 2), in units of the scene."""
        sizes: FloatArray = self.windows[:, 1] - self.windows[:, 0]
        return sizes


def suitable_views(points: FloatArray, *, has_north: bool) -> tuple[Viewpoint, ...]:
    """Return three views of points (N, 3) whose third axis is up.

    A town or a landscape is seen from above and from two corners, a slender object from three sides, and a wall along
    its normal and from both sides. Directions are named by the compass only if the second axis points north.
    """
    deviations = points - np.median(points, axis=0)
    variances, axes = np.linalg.eigh(deviations.T @ deviations / len(points))  # ascending
    x, y, z = axes[:, 0]
    if variances[0] <= _MAX_FLATNESS**2 * variances[1] and abs(z) < np.sin(np.pi / 4):
        sign = -1 if y > 0 or (y == 0 and x > 0) else 1  # towards the south, from where maps are read
        normal = sign * np.array([x, y, 0.0]) / np.hypot(x, y)
        along = np.array([-normal[1], normal[0], 0.0])
        front, left, right = ((*(normal + share * along)[:2], 0.35 * abs(share)) for share in (0.0, -1.0, 1.0))
        sides = {"front": front, "from the left": left, "from the right": right}
        return tuple(Viewpoint(title, (float(u), float(v), w), (0, 0, 1)) for title, (u, v, w) in sides.items())
    low, high = np.percentile(points, [0.5, 99.5], axis=0)
    width, depth, height = high - low
    if height > _MIN_SLENDERNESS * max(width, depth):
        directions: tuple[tuple[float, float, float], ...] = ((0, -1, 0.15), (1, 0, 0.15), (0, 1, 0.15))
    else:
        directions = ((0, 0, 1), (-1, -1, 1.1), (1, 1, 1.1))
    return tuple(
        Viewpoint(_title(direction, has_north), direction, (0, 1, 0) if direction == (0, 0, 1) else (0, 0, 1))
        for direction in directions
    )


def _title(direction: tuple[float, float, float], has_north: bool) -> str:
    x, y, _ = direction
    if not (x or y):
        return "from above"
    if has_north:
        north_south, east_west = {1: "north", -1: "south", 0: ""}[int(y)], {1: "east", -1: "west", 0: ""}[int(x)]
        return f"from the {'-'.join(filter(None, [north_south, east_west]))}"
    signs = {1: "+", -1: "−"}
    return f"from {', '.join(signs[int(value)] + axis for axis, value in (('x', x), ('y', y)) if value)}"


def round_length(at_most: float) -> float:
    """Return the largest 1, 2 or 5 times a power of ten that is at most `at_most`."""
    power = 10.0 ** np.floor(np.log10(at_most))
    return float(max(step * power for step in (1, 2, 5) if step * power <= at_most * (1 + 1e-9)))


def thin_out(points: FloatArray) -> FloatArray:
    """Return every k-th of points (N, 3), so that fewer than 400,000 remain."""
    thinned: FloatArray = points[:: max(1, len(points) // _MAX_SAMPLE)]
    return thinned
