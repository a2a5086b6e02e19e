"""Viewpoints that suit a scene, and frames: the same windows and scale for all pictures of a report."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray
from pcbench.report.viewing import ViewingCameras

_MARGIN_SHARE = 0.05  # of a box around the inner 99 % of the points, which then includes most of the others too
_MAX_GROWTH_SHARE = 0.25  # of the size of the reference's box, for candidates that extend beyond it
_MIN_SIZE_SHARE = 0.2  # of the diagonal: a wall is thinner than the deviations that its frame shows
_MAX_SAMPLE = 200_000  # points that determine a box or a window
_MAX_FLATNESS = 0.35  # ratio of the smallest to the middle standard deviation of a wall
_MIN_SLENDERNESS = 0.75  # ratio of height to horizontal size of an object, which is seen from the sides
# Heights of directions towards the viewer: to a side with a horizontal length of 1, and to corners of a wall and of a
# town with that of a square's diagonal.
_SIDE_HEIGHT, _WALL_HEIGHT, _CORNER_HEIGHT = 0.15, 0.35, 1.1
_MIN_SIDE_SHARE = 0.2  # mean horizontal part of viewing directions; with less, the cameras look down
_MIN_FRONT_SHARE = 0.5  # length of the mean of the cameras' sides, if they are all on one side of the scene
_MAX_LEVEL_DEG = 30.0  # mean angle to the horizontal plane of cameras that look at the front of a scene
_MIN_BEHIND_SHARE = 0.2  # of the cameras' sides along a wall's normal, for the wall's other side as its front
_MIN_ADVANTAGE = 1.2  # in the number of cameras, of other corners over the south-west and north-east
_COMPASS = ((0, -1), (1, -1), (1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0), (-1, -1))  # counter-clockwise from the south
_CORNERS = (((-1, -1), (1, 1)), ((0, -1), (0, 1)), ((1, -1), (-1, 1)), ((1, 0), (-1, 0)))  # opposite ones


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


_ABOVE = Viewpoint("from above", (0, 0, 1), (0, 1, 0))
SOUTH_WEST = Viewpoint("from the south-west", (-1, -1, _CORNER_HEIGHT), (0, 0, 1))


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
        cameras: the cameras that photographed the scene, if known.
    """

    box: AxisBox
    views: tuple[Viewpoint, ...]
    windows: FloatArray
    cameras: ViewingCameras | None = None

    @classmethod
    def of(
        cls,
        box: AxisBox,
        clouds: Sequence[FloatArray],
        *,
        has_north: bool = False,
        cameras: ViewingCameras | None = None,
    ) -> Frame:
        """Return the frame around the points (N, 3) inside a box, with views that suit their shape.

        Args:
            box: the box.
            clouds: points (N, 3) of each cloud.
            has_north: whether the second axis points north, as in a known coordinate system.
            cameras: the cameras that photographed the scene, in the coordinates of the points.
        """
        parts = [points[box.holds(points)] for points in map(thin_out, clouds)]
        inside = np.concatenate([*parts, *([np.stack([box.low, box.high])] if not any(map(len, parts)) else [])])
        views = suitable_views(inside, has_north=has_north, cameras=cameras)
        windows = []
        for view in views:
            flat = (inside - box.center) @ view.axes[:2].T
            low, high = flat.min(axis=0), flat.max(axis=0)
            # A view without extent, such as a wall from above, still gets a strip of the picture.
            size = float((high - low).max()) or 1.0
            pad = 0.02 * size + np.maximum(0.0, 0.03 * size - (high - low))
            windows.append([low - pad, high + pad])
        return cls(box, views, np.array(windows), cameras)

    @property
    def sizes(self) -> FloatArray:
        """Width and height of each window (V, 2), in units of the scene."""
        sizes: FloatArray = self.windows[:, 1] - self.windows[:, 0]
        return sizes


def suitable_views(
    points: FloatArray, *, has_north: bool, cameras: ViewingCameras | None = None
) -> tuple[Viewpoint, ...]:
    """Return three views of points (N, 3) whose third axis is up.

    A town or a landscape is seen from above and from two corners, a slender object from three sides, and a wall along
    its normal and from both sides. If cameras see the sides of the scene, the views are from where they are; a scene
    that they see from one side and about horizontally is shown from its front, from the left and from the right.
    Directions are named by the compass if the second axis points north, and else by the axes if these are the user's.

    Args:
        points: the points.
        has_north: whether the second axis points north, as in a known coordinate system.
        cameras: the cameras that photographed the scene, in the coordinates of the points.
    """
    sides = _sides(cameras)
    normal = _wall_normal(points, sides)
    if normal is not None:
        return _front_views(normal, _WALL_HEIGHT)
    low, high = np.percentile(points, [0.5, 99.5], axis=0)
    width, depth, height = high - low
    is_slender = height > _MIN_SLENDERNESS * max(width, depth)
    front = None if sides is None else _front(sides)
    if sides is not None and front is not None and (is_slender or _are_level(sides)):
        return _front_views(front, _WALL_HEIGHT, _SIDE_HEIGHT)
    if front is not None and not has_north:
        return (_ABOVE, *_front_views(front, _CORNER_HEIGHT)[1:])
    directions: tuple[tuple[int, int], ...] = ((0, -1), (1, 0), (0, 1))
    titles = ["front", "from the right", "from the back"]
    if not is_slender:
        directions = _corners(sides) if front is None else _corners_beside(front)
        titles = ["from one side", "from the other side"]
    if has_north or cameras is None or not cameras.is_rotated:
        titles = [_title(direction, has_north) for direction in directions]
    views = [
        Viewpoint(title, (x, y, _SIDE_HEIGHT) if is_slender else _to_corner((x, y)), (0, 0, 1))
        for title, (x, y) in zip(titles, directions, strict=True)
    ]
    return tuple(views) if is_slender else (_ABOVE, *views)


class SceneAxes(NamedTuple):
    """The axes along which a scene is mapped and cut.

    Attributes:
        rows: the axes as rows of a rotation (3, 3).
        names: their names.
        is_wall: whether the scene is a wall; its axes are right, up and towards the viewer of its front.
    """

    rows: FloatArray
    names: tuple[str, str, str]
    is_wall: bool = False


COORDINATES = SceneAxes(np.eye(3), ("x", "y", "z"))


def scene_axes(points: FloatArray, cameras: ViewingCameras | None = None) -> SceneAxes:
    """Return the axes that suit points (N, 3): those of a wall, or else of the coordinates, upright by the cameras.

    Args:
        points: the points.
        cameras: the cameras that photographed the scene, in the coordinates of the points.
    """
    rotation = np.eye(3)
    if cameras is not None and not cameras.is_upright:
        rotation = cameras.upright_rotation()
        cameras = cameras.rotated(rotation)
    normal = _wall_normal(thin_out(points) @ rotation.T, _sides(cameras)) if len(points) else None
    if normal is not None:
        front = _front_views(normal, _WALL_HEIGHT)[0]
        return SceneAxes(front.axes @ rotation, ("along", "height", "towards the viewer"), is_wall=True)
    is_rotated = cameras is not None and cameras.is_rotated
    return SceneAxes(rotation, ("right", "forward", "up") if is_rotated else ("x", "y", "z"))


def _wall_normal(points: FloatArray, sides: FloatArray | None) -> FloatArray | None:
    """Return the horizontal unit vector (2,) from a wall towards the viewer of its front; None if there is no wall.

    Args:
        points: (N, 3) points whose third axis is up.
        sides: horizontal directions (M, 2) towards the cameras, if known.
    """
    deviations = points - np.median(points, axis=0)
    variances, axes = np.linalg.eigh(deviations.T @ deviations / len(points))  # ascending
    x, y, z = axes[:, 0]
    if variances[0] > _MAX_FLATNESS**2 * variances[1] or abs(z) > np.sin(np.pi / 4) or not variances[1] > 0:
        return None
    sign = -1 if y > 0 or (y == 0 and x > 0) else 1  # towards the south, from where maps are read
    normal: FloatArray = sign * np.array([x, y]) / np.hypot(x, y)
    is_seen_from_behind = sides is not None and sides.mean(axis=0) @ normal < -_MIN_BEHIND_SHARE
    return -normal if is_seen_from_behind else normal


def oblique_view(cameras: ViewingCameras | None) -> Viewpoint:
    """Return a view from above and from a side: that of the cameras, in their coordinates, or the south-west."""
    if cameras is None:
        return SOUTH_WEST
    rotation = cameras.upright_rotation()
    sides = _sides(cameras.rotated(rotation))
    front = None if sides is None else _front(sides)
    view = (
        Viewpoint("", _to_corner(_corners(sides)[0]), (0, 0, 1))
        if front is None
        else _front_views(front, _CORNER_HEIGHT)[1]
    )
    direction, up = (np.array([view.direction, view.up]) @ rotation).tolist()
    return Viewpoint("from the side of the cameras", tuple(direction), tuple(up))


def _to_corner(direction: tuple[int, int]) -> tuple[float, float, float]:
    """Return the direction towards a viewer above a corner or a side of a town, with the slope of `_CORNER_HEIGHT`."""
    x, y = direction
    return (x, y, _CORNER_HEIGHT) if x and y else (2**0.5 * x, 2**0.5 * y, _CORNER_HEIGHT)


def _sides(cameras: ViewingCameras | None) -> FloatArray | None:
    """Return the horizontal parts (N, 2) of the directions towards cameras; None if these look down, or are unknown."""
    if cameras is None or cameras.up is None:
        return None
    sides: FloatArray = -cameras.directions[:, :2]
    return sides if np.linalg.norm(sides, axis=1).mean() > _MIN_SIDE_SHARE else None


def _are_level(sides: FloatArray) -> bool:
    """Return whether cameras look about horizontally, from the horizontal parts (N, 2) of their unit directions."""
    return bool(np.linalg.norm(sides, axis=1).mean() > np.cos(np.radians(_MAX_LEVEL_DEG)))


def _front(sides: FloatArray) -> FloatArray | None:
    """Return the horizontal direction (2,) towards cameras that are all on one side; None if they are all around."""
    mean: FloatArray = sides.sum(axis=0) / np.linalg.norm(sides, axis=1).sum()
    length = float(np.linalg.norm(mean))
    return mean / length if length > _MIN_FRONT_SHARE else None


def _front_views(front: FloatArray, height: float, front_height: float = 0.0) -> tuple[Viewpoint, ...]:
    """Return the views from a horizontal unit vector (2,), and from 45 degrees to the left and to the right of it.

    Args:
        front: the direction towards the viewer.
        height: height of the directions to the left and to the right, whose horizontal length is the root of two.
        front_height: height of the direction to the front.
    """
    along = np.array([-front[1], front[0]])
    views = []
    for title, share in (("front", 0.0), ("from the left", -1.0), ("from the right", 1.0)):
        u, v = (front + share * along).tolist()
        views.append(Viewpoint(title, (u, v, height if share else front_height), (0, 0, 1)))
    return tuple(views)


def _corners(sides: FloatArray | None) -> tuple[tuple[int, int], tuple[int, int]]:
    """Return two opposite corners: south-west and north-east, or others with clearly more cameras.

    Args:
        sides: horizontal directions (N, 2) towards the cameras, if known.
    """
    if sides is None:
        return _CORNERS[0]
    counts = [min(_cameras_near(sides, corner) for corner in pair) for pair in _CORNERS]
    best = int(np.argmax(counts))
    return _CORNERS[best if counts[best] > _MIN_ADVANTAGE * counts[0] else 0]


def _corners_beside(front: FloatArray) -> tuple[tuple[int, int], tuple[int, int]]:
    """Return the points of the compass 45 degrees to the left and to the right of a horizontal direction (2,)."""
    nearest = int(np.argmax([front @ point / np.hypot(*point) for point in _COMPASS]))
    return _COMPASS[nearest - 1], _COMPASS[(nearest + 1) % len(_COMPASS)]


def _cameras_near(sides: FloatArray, direction: tuple[int, int]) -> float:
    """Return the number of cameras in about a direction, from directions (N, 2) to them."""
    cosines = sides @ np.array(direction) / np.hypot(*direction)
    return float((np.maximum(cosines, 0) ** 4).sum())


def _title(direction: tuple[int, int], has_north: bool) -> str:
    x, y = direction
    if has_north:
        north_south, east_west = {1: "north", -1: "south", 0: ""}[y], {1: "east", -1: "west", 0: ""}[x]
        return f"from the {'-'.join(filter(None, [north_south, east_west]))}"
    signs = {1: "+", -1: "−"}
    return f"from {', '.join(signs[value] + axis for axis, value in (('x', x), ('y', y)) if value)}"


def thin_out(points: FloatArray) -> FloatArray:
    """Return every k-th of points (N, 3), so that fewer than 400,000 remain."""
    thinned: FloatArray = points[:: max(1, len(points) // _MAX_SAMPLE)]
    return thinned
