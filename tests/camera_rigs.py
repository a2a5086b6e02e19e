"""Cameras with a known up direction, in a frame with +z up and in others."""

import numpy as np

from pcbench.geometry.cameras import Camera, Intrinsics, look_at
from pcbench.geometry.transform import Similarity

K = Intrinsics(640, 480, 500, 500, 320, 240)


def random_rotation(seed):
    """Return a random rotation (3, 3)."""
    matrix, triangle = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    matrix *= np.sign(np.diag(triangle))
    return matrix if np.linalg.det(matrix) > 0 else -matrix


def rotated(cameras, rotation):
    """Return cameras after a rotation (3, 3) of the world about its origin."""
    return [
        Camera(c.name, c.intrinsics, Similarity(c.cam_from_world.rotation @ rotation.T, c.cam_from_world.translation))
        for c in cameras
    ]


def rolled(camera, angle_deg):
    """Return a camera turned about its viewing direction."""
    cos, sin = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    turn = Similarity(np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]]), np.zeros(3))
    return Camera(camera.name, camera.intrinsics, turn @ camera.cam_from_world)


def _cameras(eyes, targets, up=(0, 0, 1)):
    return [
        Camera(f"{k}.png", K, look_at(eye, target, up=up))
        for k, (eye, target) in enumerate(zip(eyes, targets, strict=True))
    ]


def ring(count=12, radius=80.0, height=60.0, start_deg=20.0):
    """Return cameras on a circle that look obliquely at the origin."""
    angles = np.radians(start_deg) + 2 * np.pi * np.arange(count) / count
    eyes = np.stack([radius * np.cos(angles), radius * np.sin(angles), np.full(count, height)], axis=1)
    return _cameras(eyes, np.zeros((count, 3)))


def sector(start_deg, end_deg, count=9, radius=80.0, height=60.0):
    """Return cameras on an arc that look at the origin."""
    angles = np.radians(np.linspace(start_deg, end_deg, count))
    eyes = np.stack([radius * np.cos(angles), radius * np.sin(angles), np.full(count, height)], axis=1)
    return _cameras(eyes, np.zeros((count, 3)))


def nadir(columns=5, strips=4, turned=True):
    """Return cameras of a survey in strips along x, which look down; each second strip is flown backwards."""
    cameras = []
    for strip in range(strips):
        for column in range(columns):
            back = turned and strip % 2
            eye = np.array([20.0 * (columns - 1 - column if back else column) - 40, 25.0 * strip - 40, 70.0])
            pose = look_at(eye, eye - [0, 0, 1], up=[0, -1 if back else 1, 0])
            cameras.append(Camera(f"{len(cameras)}.png", K, pose))
    return cameras


def walk(count=9, distance=12.0, pitches_deg=(10.0, -5.0, 20.0)):
    """Return cameras on a line in front of a wall in the plane y = 0, at its side of negative y, looking up and down.

    They look to the left at its right end, and to the right at its left end.
    """
    x = np.linspace(-10, 10, count)
    eyes = np.stack([x, np.full(count, -distance), np.full(count, 1.6)], axis=1)
    pitch = np.tan(np.radians(np.resize(pitches_deg, count)))
    targets = np.stack([0.5 * x, np.zeros(count), 1.6 + distance * pitch], axis=1)
    return _cameras(eyes, targets)
