"""Brings an arbitrary gauge into the world: onto known cameras or GPS positions."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cameras import Camera
from pcbench.geometry.transform import Similarity


def moved(camera: Camera, transform: Similarity) -> Camera:
    """The same camera in the world that `transform` leads to."""
    rotation = camera.cam_from_world.rotation @ transform.rotation.T
    position = transform.apply(camera.position[None])[0]
    return Camera(camera.name, camera.intrinsics, Similarity(rotation, -rotation @ position))


def camera_errors(cameras: Mapping[str, Camera], truth: Mapping[str, Camera]) -> tuple[FloatArray, FloatArray]:
    """Distances of the centres in the unit of the truth, and angles in degrees between the orientations, for the images
    that are in both, in the order of their names.
    """
    positions, angles = [], []
    for name in sorted(set(cameras) & set(truth)):
        a, b = cameras[name], truth[name]
        positions.append(float(np.linalg.norm(a.position - b.position)))
        turn = a.cam_from_world.rotation @ b.cam_from_world.rotation.T
        # The sine is exact for small angles, where the cosine is flat.
        sine = np.linalg.norm([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / 2
        angles.append(float(np.degrees(np.arctan2(sine, (np.trace(turn) - 1) / 2))))
    return np.array(positions), np.array(angles)
