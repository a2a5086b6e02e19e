"""Photographs of one textured plane from above with exact depths: a scene whose surface needs very few Gaussians."""

from typing import NamedTuple

import numpy as np
import textured_corner as corner
import torch
from exact_maps import plane_map, rays

from pcbench.geometry.cameras import Camera, Intrinsics, look_at
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.neighbors import Index
from reconstructors.splat import extract
from reconstructors.splat.model import Gaussians, LocalFrame
from reconstructors.splat.photographs import NEAREST, Photograph, Pyramid
from reconstructors.splat.splat import initial_model
from reconstructors.splat.supervision import Supervision
from reconstructors.splat.view import View

_FOCAL = 90.0
_HEIGHT = 5.0  # of the cameras over the plane
_FOOTPRINTS = 2  # pixel footprints: the distance threshold of the F-score


class PlaneScene(NamedTuple):
    cloud: Cloud  # a point with its color for each pixel
    cameras: dict[str, Camera]
    frame: LocalFrame
    photographs: list[Pyramid]
    supervision: Supervision

    def initial_model(self, count: int) -> Gaussians:
        return initial_model(self.cloud, self.frame, count, 0)

    def fscore(self, model: Gaussians) -> float:
        """F-score of the extracted surface at two pixel footprints."""
        points = extract.surface(model, self.frame, self.cameras).points
        limit = _FOOTPRINTS * _HEIGHT / _FOCAL
        precision = np.mean(np.abs(points[:, 2]) <= limit)
        recall = np.mean(Index(points).query(self.cloud.points[::20]).distances <= limit)
        return float(2 * precision * recall / (precision + recall))


def plane_scene(patches: int) -> PlaneScene:
    """Return twelve photographs of 96x64 pixels of a square of 12 m, whose texture has `patches` patches a side."""
    intrinsics = Intrinsics(96, 64, _FOCAL, _FOCAL, 48.0, 32.0)
    grid = [(x, y) for y in (-0.8, 0.0, 0.8) for x in (-1.2, -0.4, 0.4, 1.2)]
    cameras = [Camera(f"{k:02}.png", intrinsics, look_at((x, y, _HEIGHT), (0.5 * x, 0.5 * y + 0.1, 0.0)))
               for k, (x, y) in enumerate(grid)]  # fmt: skip
    texture = np.random.default_rng(3).uniform(0.1, 0.9, (patches + 2, patches + 2, 3))
    frame = LocalFrame.of(cameras)
    points, colors, photographs, depths = [], [], [], {}
    for camera in cameras:
        depth = plane_map(camera, (0, 0, 1), 0).depth
        seen = camera.position + depth[..., None] * rays(camera)
        x, y = ((seen[..., axis] + 6) / 12 * patches for axis in (0, 1))
        image = (255 * corner.bilinear(texture, x, y)).round().astype(np.uint8)
        points.append(seen.reshape(-1, 3))
        colors.append(image.reshape(-1, 3))
        photographs.append(
            [Photograph(camera.name, View.of(frame.camera(camera), NEAREST), torch.from_numpy(image), None)]
        )
        depths[camera.name] = [torch.from_numpy((depth / frame.unit).astype(np.float32))]
    cloud = Cloud(np.concatenate(points), colors=np.concatenate(colors))
    return PlaneScene(cloud, {c.name: c for c in cameras}, frame, photographs, Supervision(depths))
