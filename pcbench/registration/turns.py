"""Quarter and half turns: poses in which a symmetric cloud looks the same, and in which ICP may end."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pcbench.errors import RegistrationError
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.normals import Surface
from pcbench.geometry.transform import Similarity, cross_matrix
from pcbench.registration.icp_settings import IcpSettings
from pcbench.registration.icp_stages import refine, refine_coarsely
from pcbench.registration.target import Target

_SAMPLE_SIZE = 1_000  # candidate points of a turned start
_MAX_ITERATIONS = 20  # of each stage of ICP
_MAX_COARSE_RATIO = 0.9  # of mean distances to the coarse reference, above which a turned pose is not refined
_MAX_SPACINGS = 5  # distances above this multiple of the reference's point spacing count as equal


class TurnedPose(NamedTuple):
    """How a pose that ICP finds from a turned start compares with the original pose."""

    distance_ratio: float  # mean distance to the reference over that at the original pose
    angle_deg: float  # rotation between the two poses


def closest_turned_pose(target: Target, points: FloatArray, T: Similarity, *, with_scale: bool) -> TurnedPose | None:
    """Register again from quarter and half turns of a pose, and compare the closest result with it.

    Buildings, rooms and plates have nearly symmetric shapes. ICP that starts far from the right pose may end at a
    turned one, where most points lie on the reference and every displacement worsens the fit.

    Args:
        target: reference.
        points: (N, 3) random sample of the candidate, minus the reference's local origin.
        T: pose between local coordinates.
        with_scale: whether the scale is solved for.

    Returns:
        The comparison with the turned pose of the smallest mean distance to the reference; None if the coarse stage
        shows that no turned pose is clearly closer.
    """
    settings = IcpSettings(with_scale=with_scale, max_sample=_SAMPLE_SIZE, max_iterations=_MAX_ITERATIONS)
    moved = T.apply(points[:_SAMPLE_SIZE])
    coarse, max_distance = target.coarse, target.coarse_side
    poses = []
    for turn in symmetry_turns(moved):
        try:
            pose = refine_coarsely(target, moved, settings, turn)
        except RegistrationError:
            continue
        poses.append((_mean_distance(coarse, pose.apply(moved), max_distance), pose))
    if not poses:
        return None
    distance, best = min(poses, key=lambda distance_and_pose: distance_and_pose[0])
    if distance > _MAX_COARSE_RATIO * _mean_distance(coarse, moved, max_distance):
        return None
    try:
        best = refine(target, moved, settings, best)
    except RegistrationError:
        return None
    max_distance = _MAX_SPACINGS * target.spacing
    original, turned = (_mean_distance(target.surface, each, max_distance) for each in (moved, best.apply(moved)))
    return TurnedPose(turned / original if original > 0 else np.inf, best.motion_at(np.zeros(3)).angle_deg)


def symmetry_turns(points: FloatArray) -> list[Similarity]:
    """Return quarter and half turns about the principal axes of points (N, 3), which include their symmetry axes."""
    center = points.mean(axis=0)
    offsets = points - center
    _, axes = np.linalg.eigh(np.einsum("ni,nj->ij", offsets, offsets))  # no BLAS: independent of the thread count
    turns = []
    for axis in axes.T:
        cross = cross_matrix(axis)
        square = cross @ cross
        for rotation in (np.eye(3) + cross + square, np.eye(3) + 2 * square, np.eye(3) - cross + square):
            turns.append(Similarity(rotation, center - rotation @ center))
    return turns


def _mean_distance(surface: Surface, points: FloatArray, max_distance: float) -> float:
    """Return the mean distance of points (N, 3) to a surface; longer distances count as the maximum."""
    return float(np.minimum(surface.index.query(points).distances, max_distance).mean())
