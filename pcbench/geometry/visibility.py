"""Which points of a surface cameras see."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cameras import Camera
from pcbench.geometry.mesh import MeshIndex

SEEN_BY = 3  # cameras that make a point visible: what multi-view stereo asks for
_LIFT = 1e-7  # of the scene's size: far above the rounding of its coordinates, far below what hides anything


def views(
    index: MeshIndex,
    cameras: Sequence[Camera],
    points: FloatArray,
    normals: FloatArray,
    *,
    enough: int | None = None,
) -> NDArray[np.int64]:
    """How many cameras see each of `points` (N, 3) of the mesh: in the frame, from the normal's side, nothing between.

    Args:
        normals: (N, 3), to the side that light falls on.
        enough: points that so many cameras see are not looked at again.
    """
    counts = np.zeros(len(points), dtype=np.int64)
    for camera in cameras:
        open_ = np.arange(len(points)) if enough is None else np.flatnonzero(counts < enough)
        counts[open_] += sees(index, camera, points[open_], normals[open_])
    return counts


def sees(index: MeshIndex, camera: Camera, points: FloatArray, normals: FloatArray) -> NDArray[np.bool_]:
    """Which of `points` (N, 3) of the mesh, with `normals` (N, 3) as in `views`, one camera sees."""
    seen = in_frame(camera, points)
    # Lines of sight must not meet what they start from.
    lifted = points[seen] + _LIFT * float(np.ptp(index.mesh.vertices, axis=0).max()) * normals[seen]
    lines = camera.position - lifted
    facing = np.einsum("ni,ni->n", lines, normals[seen]) > 0
    free = np.zeros(len(lines), dtype=np.bool_)
    if facing.any():
        free[facing] = ~index.blocked(lifted[facing], lines[facing], limit=1.0)
    seen[seen] = free
    return seen


def in_frame(camera: Camera, points: FloatArray, *, beyond: float = 0.0) -> NDArray[np.bool_]:
    """Which of points (N, 3) fall into the image, or outside it by less than the share `beyond` of its sides."""
    k = camera.intrinsics
    at = camera.cam_from_world.apply(points)
    # Far outside the frame a distorted point can come back into it: no ray of the lens goes there.
    front = (at[:, 2] > 0) & (np.abs(at[:, :2]) <= (1.01 + 2 * beyond) * k.widest * at[:, 2:]).all(axis=1)
    u, v = camera.project(points)[0].T
    x, y = beyond * k.width, beyond * k.height
    inside: NDArray[np.bool_] = front & (u >= -x) & (u < k.width + x) & (v >= -y) & (v < k.height + y)
    return inside


def pixel_sizes(camera: Camera, points: FloatArray, *, beyond: float = 0.0) -> FloatArray:
    """How large a pixel is at each of points (N, 3), across the line of sight: depth over focal length, which is the
    ground sample distance of a camera that looks straight down. Infinite where `in_frame` says that the point is not
    in the image; what hides points is not asked.
    """
    depths = camera.cam_from_world.apply(points)[:, 2]
    sizes = depths / np.sqrt(camera.intrinsics.fx * camera.intrinsics.fy)
    result: FloatArray = np.where(in_frame(camera, points, beyond=beyond), sizes, np.inf)
    return result
