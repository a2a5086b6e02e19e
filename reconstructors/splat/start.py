"""Random points at which training starts."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pcbench.errors import ReconstructionError
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cameras import Camera
from pcbench.geometry.visibility import in_frame
from pcbench.geometry.voxels import robust_bounds
from reconstructors.splat.model import LocalFrame

_MIN_VIEWS = 3  # cameras that see a point
_NEAREST, _FARTHEST = 0.1, 1.5  # depths of the points in a camera, in units of the cameras' spread
_BATCH = 20_000  # points that are drawn at once
_MIN_SHARE = 1e-3  # of these, which at least three cameras must see


def points_in_bounds(points: FloatArray, count: int, seed: int) -> FloatArray:
    """Return random points (count, 3) in the box around the inner 98 % of points (N, 3) along each axis."""
    lower, upper = robust_bounds(points)
    return np.random.default_rng([seed, 2]).uniform(lower, upper, (count, 3))


def points_in_view(cameras: Sequence[Camera], count: int, seed: int) -> FloatArray:
    """Return random points (count, 3) in front of pinhole cameras, where at least three look; distortion is ignored.

    The depth of a point has the same probability at each scale, from 0.1 to 1.5 of the unit of the frame of training. A
    point is kept with a probability that grows with the square of the number of cameras that see it.

    Raises:
        ReconstructionError: hardly any point is seen by three cameras.
    """
    unit, rng = LocalFrame.of(list(cameras)).unit, np.random.default_rng([seed, 4])
    parts, kept_count = list[FloatArray](), 0
    while kept_count < count:
        depths = unit * np.exp(rng.uniform(np.log(_NEAREST), np.log(_FARTHEST), _BATCH))
        pixels, owners = rng.random((_BATCH, 2)), rng.integers(len(cameras), size=_BATCH)
        points = np.concatenate(
            [_unproject(c, pixels[owners == k], depths[owners == k]) for k, c in enumerate(cameras)]
        )
        views = np.zeros(_BATCH, dtype=np.int64)
        for camera in cameras:
            views += in_frame(camera, points)
        kept = (views >= _MIN_VIEWS) & (rng.random(_BATCH) < (views / len(cameras)) ** 2)
        if np.mean(kept) < _MIN_SHARE:
            raise ReconstructionError(
                f"expected cameras that look at the same place, got {np.mean(kept):.2%} of points that {_MIN_VIEWS} of"
                f" {len(cameras)} see: check the cameras"
            )
        parts.append(points[kept])
        kept_count += int(kept.sum())
    return rng.permutation(np.concatenate(parts))[:count]


def _unproject(camera: Camera, pixels: FloatArray, depths: FloatArray) -> FloatArray:
    """Return the points (N, 3) at pixels (N, 2), as shares of the sides of the image, and depths (N,) of a pinhole."""
    k, motion = camera.intrinsics, camera.cam_from_world
    rays = np.column_stack([(pixels * (k.width, k.height) - (k.cx, k.cy)) / (k.fx, k.fy), np.ones(len(pixels))])
    points: FloatArray = motion.inverse().apply(rays * depths[:, None])
    return points
