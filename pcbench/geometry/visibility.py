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
    # Lines of sight must not meet what they start from.
    lifted = points + _LIFT * float(np.ptp(index.mesh.vertices, axis=0).max()) * normals
    for camera in cameras:
        open_ = np.arange(len(points)) if enough is None else np.flatnonzero(counts < enough)
        framed = open_[in_frame(camera, points[open_])]
        lines = camera.position - lifted[framed]
        facing = np.einsum("ni,ni->n", lines, normals[framed]) > 0
        framed, lines = framed[facing], lines[facing]
        if len(framed):
            counts[framed] += ~index.blocked(lifted[framed], lines, limit=1.0)
    return counts


def in_frame(camera: Camera, points: FloatArray) -> NDArray[np.bool_]:
    """Which of points (N, 3) fall into the image."""
    k = camera.intrinsics
    at = camera.cam_from_world.apply(points)
    # Far outside the frame a distorted point can come back into it: no ray of the lens goes there.
    front = (at[:, 2] > 0) & (np.abs(at[:, :2]) <= 1.01 * k.widest * at[:, 2:]).all(axis=1)
    u, v = camera.project(points)[0].T
    inside: NDArray[np.bool_] = front & (u >= 0) & (u < k.width) & (v >= 0) & (v < k.height)
    return inside
