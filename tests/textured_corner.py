"""Ray-cast photographs of known geometry: three textured planes that meet in a corner."""

from functools import cache

import numpy as np

from pcbench.geometry.cameras import Camera, Intrinsics, look_at
from pcbench.geometry.cloud import Cloud
from pcbench.io.colmap_model import write_colmap_model
from pcbench.plugins import Reconstruction

SIDE = 4.0  # side of each plane, from the corner at the origin


class RandomPointsSfm:
    """Replaces the plugin `sfm`: random points in the corner."""

    def __init__(self, **_):
        pass

    def reconstruct(self, scene, workspace):
        points = np.random.default_rng(4).uniform(0, SIDE, (400, 3))
        return Reconstruction(Cloud(points, colors=np.full((400, 3), 128, np.uint8)), "georeferenced", scene.cameras)


@cache
def texture(seed, size=512):
    """Return noise with structure at several scales, in which SIFT finds features."""
    rng = np.random.default_rng(seed)
    image = np.zeros((size, size, 3))
    for step, weight in ((4, 1.0), (8, 1.0), (16, 0.8), (64, 0.6)):
        coarse = rng.uniform(size=(size // step + 2, size // step + 2, 3))
        image += weight * bilinear(coarse, *np.meshgrid(np.arange(size) / step, np.arange(size) / step))
    return (image - image.min()) / np.ptp(image)


def bilinear(image, x, y):
    x0, y0 = np.floor(x).astype(int), np.floor(y).astype(int)
    x0, y0 = np.clip(x0, 0, image.shape[1] - 2), np.clip(y0, 0, image.shape[0] - 2)
    fx, fy = np.clip(x - x0, 0, 1)[..., None], np.clip(y - y0, 0, 1)[..., None]
    top = (1 - fx) * image[y0, x0] + fx * image[y0, x0 + 1]
    bottom = (1 - fx) * image[y0 + 1, x0] + fx * image[y0 + 1, x0 + 1]
    return (1 - fy) * top + fy * bottom


def cameras(count, intrinsics):
    """Return cameras on a quarter circle around the corner, at varying heights, looking into it."""
    angles = np.radians(np.linspace(20, 70, count))
    return [
        Camera(
            f"{number:03}.png",
            intrinsics,
            look_at([5 * np.cos(a), 5 * np.sin(a), 2.5 + 0.6 * (number % 3)], [0.7, 0.7, 0.7]),
        )
        for number, a in enumerate(angles)
    ]


def photograph(camera, seed=0):
    """Return the photograph (height, width, 3) uint8 of a camera without distortion; the background is grey."""
    k = camera.intrinsics
    x, y = np.meshgrid(np.arange(k.width) + 0.5, np.arange(k.height) + 0.5)
    rays = np.stack([(x - k.cx) / k.fx, (y - k.cy) / k.fy, np.ones_like(x)], axis=-1) @ camera.cam_from_world.rotation
    image = np.full((k.height, k.width, 3), 0.5)
    nearest = np.full((k.height, k.width), np.inf)
    for axis in range(3):
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = -camera.position[axis] / rays[..., axis]
        points = camera.position + depth[..., None] * rays
        u, v = (points[..., other_axis] / SIDE for other_axis in range(3) if other_axis != axis)
        is_visible = (depth > 0) & (depth < nearest) & (u >= 0) & (u <= 1) & (v >= 0) & (v <= 1)
        plane = texture(seed + axis)
        image[is_visible] = bilinear(plane, u[is_visible] * (len(plane) - 1), v[is_visible] * (len(plane) - 1))
        nearest[is_visible] = depth[is_visible]
    return (255 * image).round().astype(np.uint8)


def distances(points):
    """Return the distances (N,) of points to the nearest of the three planes."""
    return np.abs(points).min(axis=1)


def standard_intrinsics(width=480, height=360):
    return Intrinsics(width, height, 0.9 * width, 0.9 * width, width / 2, height / 2)


def write_scene(folder, cameras):
    """Write photographs and their true cameras into an existing folder; return the folder."""
    from PIL import Image

    (folder / "images").mkdir()
    for camera in cameras:
        Image.fromarray(photograph(camera)).save(folder / "images" / camera.name)
    write_colmap_model(folder / "sparse", cameras)
    return folder
