"""Photographs of a plane with a smooth random texture and exact depths, in closed form."""

from typing import NamedTuple

import numpy as np

from pcbench.geometry.cameras import Camera, Intrinsics
from pcbench.geometry.transform import Similarity
from reconstructors.mvs.patchmatch import GrayView


class PlaneScene(NamedTuple):
    views: list  # of GrayView
    depths: list  # of (H, W) float32
    focal: float
    baseline: float


def plane_scene(normal=(0.0, 0.0, -1.0), *, distance=10.0, contrast=50.0, width=240, height=160, noise=1.0, sources=4):
    """Return photographs of the plane n.X = d at a given distance in front of the first camera.

    The first camera defines the world frame; the others are next to it, rotated slightly.
    """
    normal = np.asarray(normal, float) / np.linalg.norm(normal)
    focal, baseline = 1.2 * width, 1.2
    rng = np.random.default_rng(5)
    waves = rng.normal(0, 6.0, (60, 3))
    phases, amplitudes = rng.uniform(0, 2 * np.pi, 60), np.full(60, contrast / np.sqrt(30))
    steps = [(0, 0), (1, 0), (0, 1), (-1, 0), (0, -1), (1, 1), (-1, 1)][: sources + 1]
    views, depths = [], []
    for number, (dx, dy) in enumerate(steps):
        angle = 0.05 * number
        rotation = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
        position = baseline * np.array([dx, dy, 0.1 * number])
        intrinsics = Intrinsics(width, height, focal, focal, 0.5 * width + 3, 0.5 * height - 2)
        camera = Camera(f"{number}.png", intrinsics, Similarity(rotation, -rotation @ position))
        x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        rays = intrinsics.directions(np.column_stack([x.ravel(), y.ravel()]))
        world_rays = rays @ rotation  # of depth 1
        depth = (normal[2] * distance - normal @ position) / (world_rays @ normal)
        points = position + world_rays * depth[:, None]
        gray = 128 + (amplitudes * np.cos(points @ waves.T + phases)).sum(axis=1) + rng.normal(0, noise, len(points))
        gray = np.clip(np.rint(gray), 0, 255).astype(np.uint8).reshape(height, width)
        views.append(GrayView(gray, camera))
        depths.append(depth.reshape(height, width).astype(np.float32))
    return PlaneScene(views, depths, focal, baseline)
