"""Photographs all around an object in front of an empty background: a textured box, ray-cast."""

import numpy as np
import textured_corner as corner
from PIL import Image

from pcbench.geometry.cameras import Camera, look_at
from pcbench.io.colmap_model import write_colmap_model

HALF = np.array([1.0, 0.8, 0.6])  # half sides of the box, about the origin
BACKGROUND = 0.9


def cameras(count, intrinsics):
    """Return cameras on a full circle around the box, from two heights, looking at it."""
    angles = 2 * np.pi * np.arange(count) / count
    return [
        Camera(f"{k:03}.png", intrinsics, look_at([3.6 * np.cos(a), 3.6 * np.sin(a), 1.2 + k % 2], [0, 0, 0]))
        for k, a in enumerate(angles)
    ]


def photograph(camera, noise=1.0):
    """Return the photograph (height, width, 3) uint8 of a camera, with sensor noise."""
    k = camera.intrinsics
    x, y = np.meshgrid(np.arange(k.width) + 0.5, np.arange(k.height) + 0.5)
    rays = np.stack([(x - k.cx) / k.fx, (y - k.cy) / k.fy, np.ones_like(x)], axis=-1) @ camera.cam_from_world.rotation
    with np.errstate(divide="ignore"):
        crossings = np.sort(((np.array([[-1], [1]]) * HALF) - camera.position)[:, None, None] / rays, axis=0)
    enter, leave = crossings[0].max(axis=-1), crossings[1].min(axis=-1)
    axis = crossings[0].argmax(axis=-1)
    points = camera.position + enter[..., None] * rays
    image = np.full((k.height, k.width, 3), BACKGROUND)
    for a in range(3):
        u, v = (0.5 + 0.5 * points[..., b] / HALF[b] for b in range(3) if b != a)
        for side in (-1, 1):
            visible = (enter < leave) & (axis == a) & (np.sign(points[..., a]) == side)
            plane = corner.texture(10 + 2 * a + (side > 0), 160)
            image[visible] = corner.bilinear(plane, u[visible] * (len(plane) - 1), v[visible] * (len(plane) - 1))
    image = 255 * image + np.random.default_rng(int(camera.name[:3])).normal(0, noise, image.shape)
    return image.clip(0, 255).round().astype(np.uint8)


def distances(points):
    """Return the distances (N,) of points (N, 3) to the surface of the box."""
    beyond = np.abs(points) - HALF
    outside = np.linalg.norm(np.maximum(beyond, 0), axis=1)
    return np.where((beyond > 0).any(axis=1), outside, -beyond.max(axis=1))


def write_scene(folder, cameras):
    """Write photographs and their true cameras into an existing folder; return the folder."""
    (folder / "images").mkdir()
    for camera in cameras:
        Image.fromarray(photograph(camera)).save(folder / "images" / camera.name)
    write_colmap_model(folder / "sparse", cameras)
    return folder
