"""Images of a courtyard whose four facades repeat one bay, so that different places look alike."""

from functools import cache

import numpy as np
from textured_corner import bilinear, texture

from pcbench.geometry.cameras import Camera, Intrinsics, look_at

WIDTH, DEPTH, HEIGHT = 24.0, 16.0, 8.0  # metres, about the origin
BAY = 4.0  # metres, period of a facade
_PIXELS = 40  # texture pixels per metre


@cache
def bay(seed=0):
    """Paint one bay of a facade (HEIGHT, BAY): plaster, and on each of two floors a window with panes and a sill."""
    plaster = texture(100 + seed, 512)[: int(HEIGHT * _PIXELS), : int(BAY * _PIXELS)]
    image = 0.35 + 0.45 * plaster
    for floor in (0.6, 4.6):
        top, left = int((HEIGHT - floor - 2.4) * _PIXELS), int(1.2 * _PIXELS)
        window = image[top : top + int(2.2 * _PIXELS), left : left + int(1.6 * _PIXELS)]
        glass = texture(200 + seed, 256)[: window.shape[0], : window.shape[1]]
        window[:] = 0.25 * glass
        window[:: window.shape[0] // 3, :] = window[:, :: window.shape[1] // 2] = 0.9
        image[top + window.shape[0] : top + window.shape[0] + 5, left - 6 : left + window.shape[1] + 6] = 0.75
    return image


@cache
def wall(length, number, unique_share, seed):
    """Paint a facade (HEIGHT, length) of repeated bays, mixed with the given share of unique texture."""
    image = np.tile(bay(seed), (1, int(length / BAY), 1))
    unique_texture = texture(1000 * seed + number, 1024)[: image.shape[0], : image.shape[1]]
    return (1 - unique_share) * image + unique_share * unique_texture


@cache
def floor(unique_share, seed):
    paving = np.tile(
        texture(1000 * seed + 50, 512)[:80, :80], (int(DEPTH * _PIXELS) // 80, int(WIDTH * _PIXELS) // 80, 1)
    )
    return (1 - unique_share) * paving + unique_share * texture(1000 * seed + 51, 1024)[
        : paving.shape[0], : paving.shape[1]
    ]


def cameras(count, intrinsics, inwards=False):
    """Place cameras around the courtyard: near its centre facing outwards, or along the walls facing inwards."""
    result = []
    for number, a in enumerate(2 * np.pi * np.arange(count) / count):
        direction = np.array([np.cos(a), np.sin(a), 0])
        eye = direction * ([9, 5.5, 0] if inwards else [3, 2, 0]) + [0, 0, 1.7 + 0.3 * (number % 3)]
        target = -direction * [5, 3, 0] if inwards else 20 * direction
        result.append(Camera(f"{number:03}.png", intrinsics, look_at(eye, target + [0, 0, 3.0])))
    return result


def photograph(camera, unique_share=0.15, seed=0):
    """Render the camera's image (height, width, 3), uint8, from inside; above the walls is a plain sky."""
    k = camera.intrinsics
    x, y = np.meshgrid(np.arange(k.width) + 0.5, np.arange(k.height) + 0.5)
    rays = np.stack([(x - k.cx) / k.fx, (y - k.cy) / k.fy, np.ones_like(x)], axis=-1) @ camera.cam_from_world.rotation
    image = np.full((k.height, k.width, 3), 0.8)
    for axis, side, number in ((0, 1, 1), (0, -1, 2), (1, 1, 3), (1, -1, 4), (2, -1, 0)):
        wall_distance = (WIDTH / 2, DEPTH / 2, 0.0)[axis]
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = (side * wall_distance - camera.position[axis]) / rays[..., axis]
            points = camera.position + depth[..., None] * rays
        px, py, pz = points[..., 0], points[..., 1], points[..., 2]
        is_on_plane = (
            (np.abs(px) <= WIDTH / 2 + 1e-9) & (np.abs(py) <= DEPTH / 2 + 1e-9) & (pz >= -1e-9) & (pz <= HEIGHT)
        )
        is_visible = (depth > 0) & is_on_plane
        if axis == 2:
            plane, u, v = floor(unique_share, seed), px + WIDTH / 2, py + DEPTH / 2
        else:
            coordinate, length = (py, DEPTH) if axis == 0 else (px, WIDTH)
            # u runs from left to right when seen from inside.
            u = (coordinate * (-side if axis == 0 else side)) + length / 2
            plane, v = wall(length, number, unique_share, seed), HEIGHT - pz
        image[is_visible] = bilinear(plane, u[is_visible] * _PIXELS - 0.5, v[is_visible] * _PIXELS - 0.5)
    return (255 * image).round().astype(np.uint8)


def standard_intrinsics(width=480, height=360):
    return Intrinsics(width, height, 0.8 * width, 0.8 * width, width / 2, height / 2)
