"""The up direction of cameras in an arbitrary frame, such as the gauge of structure from motion.

People and most rigs hold a camera so that the image rows are horizontal, whatever its pitch: up is orthogonal to the x
axes of all cameras. A consensus finds this direction if fewer than half of the images are rolled. If all photographs
were rotated by 90 degrees, the image columns are horizontal instead. In a survey whose images all look in the same
direction, neither determines up. Up is then opposite to the mean viewing direction, if the cameras lie in a plane
across it, as they do above the ground.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray, even_rows
from pcbench.geometry.cameras import Camera
from pcbench.geometry.transform import cross_matrix

_MAX_ROLL_DEG = 12.0  # maximum roll of an image with horizontal rows: hand-held cameras deviate by a few degrees
_MIN_YAW_DEG = 5.0  # RMS angle of the axes to their main direction: below, they hardly span a plane
_MIN_SPREAD_RATIO = 2.0  # ratio of that RMS to the RMS roll: below, the axes do not lie in a plane
_MAX_STANDARD_ERROR_DEG = 5.0  # standard error of the up direction, predicted from rolls and yaws
_MIN_CAMERAS = 3  # two cameras always have a direction orthogonal to both
_MAX_PAIRED_CAMERAS = 48  # cameras whose pairs are tried: 1,128 directions
_MIN_UP_COSINE = 0.1  # mean cosine of the images' upper sides, or of the reversed views, with up that fixes its sign
_MAX_NADIR_DEG = (
    20.0  # between a view and a survey's mean view, and between the mean view and the cameras' plane normal
)
_MIN_WIDTH_RATIO = 0.1  # width over length of a survey's block: a single strip does not determine the plane


class _Horizon(NamedTuple):
    """Direction orthogonal to the axes of most cameras, the cameras consistent with it, and RMS roll in degrees."""

    normal: FloatArray
    is_consistent: NDArray[np.bool_]
    roll_deg: float


def find_up(cameras: Collection[Camera]) -> tuple[FloatArray | None, str]:
    """Return the up direction (3,) of cameras as a unit vector, and how it was found.

    The method is that of Brown and Lowe 2007 (automatic straightening), with a consensus against rolled images.

    Returns:
        None and the reason if the cameras do not determine the up direction.
    """
    if len(cameras) < _MIN_CAMERAS:
        return None, f"{len(cameras)} cameras are too few to determine the up direction"
    axes = np.stack([camera.cam_from_world.rotation for camera in cameras])
    right, down, forward = axes[:, 0], axes[:, 1], axes[:, 2]
    if (rows := _find_horizon(right)) is not None:
        # Images that look straight down have no upper side: use their reversed viewing directions.
        sign = _up_sign(-down[rows.is_consistent], rows.normal) or _up_sign(-forward[rows.is_consistent], rows.normal)
        if sign:
            return sign * rows.normal, _describe("rows", rows)
        return None, "as many photographs are upside down as are upright"
    if (columns := _find_horizon(down)) is not None:
        if sign := _up_sign(-forward[columns.is_consistent], columns.normal):
            return sign * columns.normal, f"{_describe('columns', columns)}, as of rotated photographs that look down"
        return None, "most photographs are rotated by 90 degrees, and the direction of rotation is unknown"
    return _up_from_nadir_views(forward, np.stack([camera.position for camera in cameras]))


def _find_horizon(axes: FloatArray) -> _Horizon | None:
    """Return the direction orthogonal to most unit axes (N, 3); None if there is none, or it is not unique."""
    normal = _consensus(axes)
    if normal is None:
        return None
    limit = np.sin(np.radians(_MAX_ROLL_DEG))
    for _ in range(10):
        is_consistent = np.abs(_dots(axes, normal)) < limit
        if is_consistent.sum() < max(_MIN_CAMERAS, len(axes) // 2 + 1):
            return None
        scatter = np.einsum("ni,nj->ij", axes[is_consistent], axes[is_consistent]) / is_consistent.sum()
        squares, directions = np.linalg.eigh(scatter)
        normal = directions[:, 0]
    roll, yaw = np.sqrt(np.maximum(squares[:2], 0))
    error = roll / (yaw * np.sqrt(is_consistent.sum())) if yaw > 0 else np.inf
    if yaw < max(np.sin(np.radians(_MIN_YAW_DEG)), _MIN_SPREAD_RATIO * roll):
        return None
    if error > np.tan(np.radians(_MAX_STANDARD_ERROR_DEG)):
        return None
    return _Horizon(normal, is_consistent, float(np.degrees(roll)))


def _consensus(axes: FloatArray) -> FloatArray | None:
    """Return the direction most nearly orthogonal to all axes (N, 3), among those orthogonal to two of them.

    Deviations are clamped to the roll limit.
    """
    some = axes[even_rows(len(axes), _MAX_PAIRED_CAMERAS)]
    first, second = np.triu_indices(len(some), 1)
    normals = np.cross(some[first], some[second])
    lengths = np.linalg.norm(normals, axis=1)
    usable = lengths > np.sin(np.radians(_MIN_YAW_DEG))
    if not usable.any():
        return None
    normals = normals[usable] / lengths[usable, None]
    limit = np.sin(np.radians(_MAX_ROLL_DEG)) ** 2
    costs = [float(np.minimum(np.square(_dots(axes, normal)), limit).sum()) for normal in normals]
    best: FloatArray = normals[int(np.argmin(costs))]
    return best


def _up_from_nadir_views(forward: FloatArray, positions: FloatArray) -> tuple[FloatArray | None, str]:
    """Return the up direction of images that look straight down, if their positions (N, 3) are consistent with it."""
    mean = forward.mean(axis=0)
    mean /= max(float(np.linalg.norm(mean)), 1e-12)
    limit = np.cos(np.radians(_MAX_NADIR_DEG))
    if np.median(_dots(forward, mean)) < limit:
        return None, "the photographs are rolled and look in all directions"
    offsets = positions - positions.mean(axis=0)
    squares, directions = np.linalg.eigh(np.einsum("ni,nj->ij", offsets, offsets))
    if squares[1] < _MIN_WIDTH_RATIO**2 * squares[2]:
        return (
            None,
            "the photographs all look in one direction from a line of positions: a strip from above or a facade",
        )
    angle_deg = float(np.degrees(np.arccos(min(abs(float(_dots(mean[None], directions[:, 0])[0])), 1.0))))
    if angle_deg > _MAX_NADIR_DEG:
        return None, "the photographs all look in one direction, and their positions do not show whether it is down"
    return -mean, (
        f"opposite to the mean viewing direction of {len(forward)} cameras, assumed to look straight down (it is within"
        f" {angle_deg:.1f} degrees of the normal of the plane of their positions)"
    )


def _up_sign(ups: FloatArray, normal: FloatArray) -> int:
    """Return the sign of a direction that points up according to the mean of directions (N, 3); 0 if undecided."""
    mean = float(_dots(ups, normal).mean())
    return 0 if abs(mean) < _MIN_UP_COSINE else 1 if mean > 0 else -1


def _describe(what: str, horizon: _Horizon) -> str:
    return (
        f"the image {what} of {int(horizon.is_consistent.sum())} of {len(horizon.is_consistent)} cameras are horizontal"
        f" within {horizon.roll_deg:.1f} degrees RMS"
    )


def _dots(vectors: FloatArray, direction: FloatArray) -> FloatArray:
    dots: FloatArray = np.einsum("ni,i->n", vectors, direction)
    return dots


def rotation_to_z(up: FloatArray) -> FloatArray:
    """Return the smallest rotation (3, 3) that maps a unit vector to +z (Rodrigues)."""
    x, y, z = up
    if z < -1 + 1e-12:
        return np.diag([1.0, -1.0, -1.0])
    cross = cross_matrix(np.array([y, -x, 0.0]))
    rotation: FloatArray = np.eye(3) + cross + cross @ cross / (1 + z)
    return rotation
