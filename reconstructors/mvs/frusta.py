"""Triangulation angles, and the part of a viewing volume that neighbouring cameras see at useful angles."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cameras import Camera
from pcbench.geometry.visibility import in_frame

# Triangulation angles. Below the full-weight angle depths become uncertain, below the minimum they would be noise. The
# images look too different to be matched above the wide angle.
MIN_ANGLE_DEG, _FULL_WEIGHT_DEG, _WIDE_ANGLE_DEG, _WIDE_FALLOFF_DEG = 1.0, 10.0, 30.0, 15.0
ROUNDING = 1e-9  # distance between positions that are equal up to rounding, as a share of their distance to the origin
_NEIGHBORS = 8  # nearest cameras; distant ones of a long flight would favour depths far beyond the scene
_RAYS_PER_SIDE, _DEPTHS = 9, 64  # samples across the image and along each ray
_NEAREST, _FARTHEST = 0.5, 60.0  # depths searched, in the smallest and the largest distance to a neighbour
_MIN_COVERAGE = 0.1  # share of the best depth's coverage by neighbours; lower values add little but range


def angles_deg(a: Camera, b: Camera, points: FloatArray) -> FloatArray:
    """Return the triangulation angles in degrees (N,) of two cameras at points (N, 3)."""
    u, v = a.position - points, b.position - points
    across = np.linalg.norm(np.cross(u, v), axis=1)
    angles: FloatArray = np.degrees(np.arctan2(across, np.einsum("ni,ni->n", u, v)))
    return angles


def angle_weights(degrees: FloatArray) -> FloatArray:
    """Return weights from 0 to 1 for triangulation angles: high if depths are well determined and images match."""
    narrow = np.clip(degrees / _FULL_WEIGHT_DEG, 0, 1) ** 2
    wide = np.exp(-0.5 * (np.maximum(degrees - _WIDE_ANGLE_DEG, 0) / _WIDE_FALLOFF_DEG) ** 2)
    weights: FloatArray = np.where(degrees < MIN_ANGLE_DEG, 0.0, narrow * wide)
    return weights


def sample_common_volume(camera: Camera, others: Sequence[Camera]) -> FloatArray:
    """Sample the part of a camera's viewing volume in which its neighbours can measure depths; return points (N, 3).

    The neighbours' frames and the triangulation angles bound the depths. The result is empty if the viewing volumes do
    not meet, or if all cameras are at one position.

    Args:
        camera: the reference camera.
        others: the other cameras; the nearest 8 count.
    """
    distances = np.array([float(np.linalg.norm(other.position - camera.position)) for other in others])
    rounding = ROUNDING * float(np.linalg.norm(camera.position))
    nearest = [k for k in np.argsort(distances, kind="stable") if distances[k] > rounding][:_NEIGHBORS]
    if not nearest:
        return np.empty((0, 3))
    k, sides = camera.intrinsics, (np.arange(_RAYS_PER_SIDE) + 0.5) / _RAYS_PER_SIDE
    pixels = np.stack(np.meshgrid(k.width * sides, k.height * sides), axis=-1).reshape(-1, 2)
    depths = np.geomspace(_NEAREST * distances[nearest[0]], _FARTHEST * distances[nearest[-1]], _DEPTHS)
    local = k.directions(pixels) * depths[:, None, None]  # (depths, rays, 3)
    points = camera.cam_from_world.inverse().apply(local.reshape(-1, 3))
    weights = np.zeros(len(points))
    for other in (others[k] for k in nearest):
        weights += angle_weights(angles_deg(camera, other, points)) * in_frame(other, points)
    coverage = weights.reshape(_DEPTHS, -1).mean(axis=1)
    covered = np.repeat(coverage >= _MIN_COVERAGE * coverage.max(), len(pixels)) & (weights > 0)
    common: FloatArray = points[covered]
    return common
