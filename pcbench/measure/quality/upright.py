"""Rotation of walls against the vertical: whether the z axis of a cloud is the direction of gravity.

Neighbouring planar patches with about the same normal and height along it are joined to walls. If a cloud of upright
walls is rotated by a small vector w, the normal n of a wall gets the vertical component (w x n)_z = w_x n_y - w_y n_x.
The vector follows from all walls by robust least squares, each wall with the weight of its patches up to a limit; the
tilt is its length. A mean of the walls' own tilts would not vanish for a cloud without rotation.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.neighbors import Index
from pcbench.measure.quality.bootstrap import BlockEstimate, statistic_estimate
from pcbench.measure.quality.patches import SurfacePatches

MIN_WALLS = 6
"""Number of walls below which no tilt is reported."""
_MAX_TILT_DEG = 10.0  # of a wall
_LINK_RADII, _MAX_LINK_ANGLE_DEG, _MAX_STEP_SHARE = 2.5, 6.0, 0.12
_MIN_WALL_PATCHES, _MAX_WALL_WEIGHT = 12, 60
_MIN_HEIGHT_RADII = 2.0  # of a wall, in radii of patches
_MIN_SECOND_SHARE = 0.05  # of the second direction of walls: without one, half of the rotation is unknown
_ROUNDS = 5
_HUBER = 1.5


class Uprightness(NamedTuple):
    """The rotation of the walls of a cloud against the vertical.

    Attributes:
        walls: number of walls.
        tilt_deg: angle between the common direction of the walls and z; None if there are too few walls.
        median_tilt_deg: median angle between a wall and z; None likewise.
        azimuth_deg: direction to which the tops of the walls lean, clockwise from y; None likewise.
        why_not: why there is no tilt; empty if there is.
    """

    walls: int
    tilt_deg: BlockEstimate | None
    median_tilt_deg: float | None
    azimuth_deg: float | None
    why_not: str


def wall_tilt(patches: SurfacePatches, seed: int) -> Uprightness:
    """Return the rotation of the walls among planar patches against the vertical."""
    steep = patches.select(patches.is_plane & (np.abs(patches.normals[:, 2]) < math.sin(math.radians(_MAX_TILT_DEG))))
    normals, weights = _walls(steep)
    if len(normals) < MIN_WALLS:
        return Uprightness(len(normals), None, None, None, f"fewer than {MIN_WALLS} walls")
    spread = np.linalg.eigvalsh((normals[:, :2] * weights[:, None]).T @ normals[:, :2]) / weights.sum()
    if spread[0] < _MIN_SECOND_SHARE:
        return Uprightness(len(normals), None, None, None, "all walls are parallel")
    design = np.stack([normals[:, 1], -normals[:, 0]], axis=1)
    rotation, robust = _rotation(design, normals[:, 2], weights)
    value = math.degrees(float(np.linalg.norm(rotation)))

    def tilts(counts: FloatArray) -> FloatArray:
        """Return the tilt of each draw (D,) of walls along the rotation of all; their robust weights are kept."""
        drawn = counts * weights * robust
        left = np.einsum("dw,wi,wj->dij", drawn, design, design, optimize=True) + 1e-9 * np.eye(2)
        right = np.einsum("dw,wi,w->di", drawn, design, normals[:, 2], optimize=True)
        solved = np.linalg.solve(left, right[:, :, None])[:, :, 0]
        return np.asarray(np.degrees(solved @ rotation / max(float(np.linalg.norm(rotation)), 1e-300)))

    estimate = statistic_estimate(value, len(normals), tilts, seed)
    own = np.degrees(np.arcsin(np.clip(np.abs(normals[:, 2]), 0, 1)))
    # A rotation about w moves the top of the z axis by w x z = (w_y, -w_x).
    azimuth = math.degrees(math.atan2(rotation[1], -rotation[0])) % 360
    return Uprightness(
        len(normals), BlockEstimate(value, max(estimate.low, 0.0), estimate.high), float(np.median(own)), azimuth, ""
    )


def _rotation(design: FloatArray, upward: FloatArray, weights: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the rotation about x and y (2,), in radians, and the robust weights (W,) of walls.

    Args:
        design: (W, 2) change of the z of each normal per radian about x and y.
        upward: (W,) z of the normals.
        weights: (W,) weights of the walls.
    """
    robust: FloatArray = np.ones(len(upward))
    solution: FloatArray = np.zeros(2)
    for _ in range(_ROUNDS):
        weighted = design * (weights * robust)[:, None]
        solution = np.asarray(np.linalg.lstsq(weighted.T @ design, weighted.T @ upward, rcond=None)[0])
        residuals = np.abs(upward - design @ solution)
        limit = max(_HUBER * 1.4826 * float(np.median(residuals)), 1e-12)
        robust = np.minimum(limit / np.maximum(residuals, 1e-300), 1.0)  # weights of Huber 1981
    return solution, robust


def _walls(patches: SurfacePatches) -> tuple[FloatArray, FloatArray]:
    """Return the normals (W, 3) of the walls that steep patches make, and their weights (W,)."""
    labels = _components(patches)
    normals, weights = [], []
    for label in np.flatnonzero(np.bincount(labels) >= _MIN_WALL_PATCHES) if len(labels) else []:
        rows = labels == label
        centres = patches.centres[rows]
        if np.ptp(centres[:, 2]) < _MIN_HEIGHT_RADII * patches.radius:
            continue
        values, axes = np.linalg.eigh(np.cov(centres.T))
        normal = axes[:, 0]
        if abs(normal[2]) > math.sin(math.radians(_MAX_TILT_DEG)) or values[0] > 0.05 * values[1]:
            continue
        normals.append(normal)
        weights.append(min(int(rows.sum()), _MAX_WALL_WEIGHT))
    return np.array(normals).reshape(-1, 3), np.array(weights, dtype=np.float64)


def _components(patches: SurfacePatches) -> IntArray:
    """Return the wall (P,) of each patch: neighbours that lie in a common plane share a wall."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    count = len(patches.centres)
    if not count:
        return np.empty(0, dtype=np.int64)
    near = Index(patches.centres).query_radius(patches.centres, _LINK_RADII * patches.radius)
    first, second = np.repeat(np.arange(count), near.counts), near.indices
    between = patches.centres[second] - patches.centres[first]
    step = np.maximum(*(np.abs(np.einsum("ni,ni->n", between, patches.normals[k])) for k in (first, second)))
    aligned = np.abs(np.einsum("ni,ni->n", patches.normals[first], patches.normals[second]))
    agrees = (step < _MAX_STEP_SHARE * patches.radius * _LINK_RADII) & (
        aligned > np.cos(np.radians(_MAX_LINK_ANGLE_DEG))
    )
    links = coo_matrix((np.ones(int(agrees.sum())), (first[agrees], second[agrees])), shape=(count, count))
    return np.asarray(connected_components(links, directed=False)[1], dtype=np.int64)
