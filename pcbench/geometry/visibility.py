"""Visibility of surface points in cameras."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cameras import MAX_FISHEYE_DEG, Camera
from pcbench.geometry.mesh import MeshIndex

MIN_VISIBLE_VIEWS = 3  # number of cameras that must see a point for multi-view stereo
_RAY_OFFSET_SHARE = 1e-7  # ray offset as a share of the scene size: above rounding, below the distance of occluders


def views(
    index: MeshIndex,
    cameras: Sequence[Camera],
    points: FloatArray,
    normals: FloatArray,
    *,
    enough: int | None = None,
) -> NDArray[np.int64]:
    """Count the cameras that see each of `points` (N, 3) of the mesh.

    A camera sees a point that lies in its frame, faces it with its normal, and is not occluded.

    Args:
        index: index of the mesh.
        cameras: cameras in the mesh's frame.
        points: (N, 3) on the surface.
        normals: (N, 3) towards the visible side.
        enough: number of cameras after which a point is tested no further; None to test all cameras.
    """
    counts = np.zeros(len(points), dtype=np.int64)
    for camera in cameras:
        pending = np.arange(len(points)) if enough is None else np.flatnonzero(counts < enough)
        counts[pending] += sees(index, camera, points[pending], normals[pending])
    return counts


def sees(index: MeshIndex, camera: Camera, points: FloatArray, normals: FloatArray) -> NDArray[np.bool_]:
    """Return the mask (N,) of `points` (N, 3) of the mesh that one camera sees; see `views`."""
    visible = in_frame(camera, points)
    # Offset the start of each line of sight so that it does not intersect its own surface.
    starts = points[visible] + _RAY_OFFSET_SHARE * float(np.ptp(index.mesh.vertices, axis=0).max()) * normals[visible]
    lines = camera.position - starts
    facing = np.einsum("ni,ni->n", lines, normals[visible]) > 0
    free = np.zeros(len(lines), dtype=np.bool_)
    if facing.any():
        free[facing] = ~index.is_occluded(starts[facing], lines[facing], limit=1.0)
    visible[visible] = free
    return visible


def in_frame(camera: Camera, points: FloatArray, *, beyond: float = 0.0) -> NDArray[np.bool_]:
    """Return the mask (N,) of points (N, 3) inside the image, extended by the share `beyond` of its sides."""
    k = camera.intrinsics
    points_in_camera = camera.cam_from_world.apply(points)
    # Far outside the frame, a distorted projection can fold back into it although no ray of the lens goes there.
    widest = np.minimum(k.widest, np.tan(np.radians(MAX_FISHEYE_DEG))) if k.fisheye else k.widest
    front = (points_in_camera[:, 2] > 0) & (
        np.abs(points_in_camera[:, :2]) <= (1.01 + 2 * beyond) * widest * points_in_camera[:, 2:]
    ).all(axis=1)
    u, v = camera.project(points)[0].T
    x, y = beyond * k.width, beyond * k.height
    inside: NDArray[np.bool_] = front & (u >= -x) & (u < k.width + x) & (v >= -y) & (v < k.height + y)
    return inside


def pixel_sizes(camera: Camera, points: FloatArray, *, beyond: float = 0.0) -> FloatArray:
    """Return the size of a pixel (N,) at points (N, 3), across the line of sight, in the unit of the points.

    This is depth over focal length: the ground sample distance of a camera that looks straight down. It is infinite for
    points outside the image (see `in_frame`); occlusion is not tested.
    """
    depths = camera.cam_from_world.apply(points)[:, 2]
    sizes = depths / np.sqrt(camera.intrinsics.fx * camera.intrinsics.fy)
    result: FloatArray = np.where(in_frame(camera, points, beyond=beyond), sizes, np.inf)
    return result
