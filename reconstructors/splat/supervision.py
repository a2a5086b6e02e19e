"""Depth supervision: train on the depths of dense stereo beside the photographs.

Photographs hardly distinguish a Gaussian on the surface from one behind or before it; a depth does. The loss gets one
more term: the mean, over the pixels with a known depth, of the absolute difference between rendered and known depth,
relative to the known depth. Kerbl et al. 2024, "A hierarchical 3D Gaussian representation", use inverse depths
predicted by a network instead.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.cameras import Camera
from pcbench.io.colmap_model import read_colmap_cameras
from reconstructors.mvs.filter import Criteria, depths_on_planes
from reconstructors.mvs.maps import DepthMap, read_map
from reconstructors.mvs.mvs import VIEW_COUNTS
from reconstructors.splat.interface import RasterOutput
from reconstructors.splat.photographs import Photograph, Pyramid
from reconstructors.splat.view import View

if TYPE_CHECKING:
    from torch import Tensor

WEIGHT = 3.0
# Depths that correlate less, or on which two images agree, start the training but do not supervise it.
CRITERIA = Criteria(confidence=0.3, views=3)


class DepthGradients(NamedTuple):
    """Gradients of the loss with respect to the rendered transmittance and depth (H, W); None for zero."""

    transmittance: Tensor | None = None
    depth: Tensor | None = None


@dataclass(frozen=True, eq=False)
class Supervision:
    """Known depths of some photographs.

    Args:
        depths: by image name, (H, W) float32 for each size of the photograph, the full one first, in the frame of the
            model; 0 where the depth is unknown.
        weight: weight of the term in the loss.
    """

    depths: Mapping[str, Sequence[Tensor]]
    weight: float = WEIGHT

    def gradients(self, photograph: Photograph, rendering: RasterOutput) -> DepthGradients:
        """Return the gradients of the depth term for a rendered photograph."""
        shape = photograph.color.shape[:2]
        depths = [depth for depth in self.depths.get(photograph.name, ()) if depth.shape == shape]
        if not depths:
            return DepthGradients()
        assert rendering.depth is not None
        target = depths[0]
        has_depth = target > 0
        # Compare the weighted sums: a mean depth would divide by alpha, which is near 0 at a nearly transparent pixel.
        difference = rendering.depth - (1 - rendering.transmittance) * target
        gradient = difference.sign() * has_depth * (self.weight / has_depth.sum().clamp(min=1))
        return DepthGradients(gradient, gradient / target.where(has_depth, target.new_ones(())))


def read_supervision(maps: Path, photographs: Sequence[Pyramid], unit: float) -> Supervision:
    """Read the depth maps that `mvs` keeps, resampled to photographs of the same cameras.

    Only depths that meet `CRITERIA` are used, although the initial points of `mvs` may meet weaker ones.

    Args:
        maps: folder with a map per image and the model of their pinholes.
        photographs: photographs at all sizes.
        unit: unit of the frame of the model, in the world's unit.
    """
    import torch

    pinholes = {camera.name: camera for camera in read_colmap_cameras(maps)}
    depths = {}
    for pyramid in photographs:
        name = pyramid[0].name
        if name in pinholes:
            depth_map, counts = read_map(maps / name), np.load(maps / name / VIEW_COUNTS)
            depth_map = depth_map.where((depth_map.confidence >= CRITERIA.confidence) & (counts >= CRITERIA.views))
            local = [
                resample_depths(photograph.view, pinholes[name], depth_map) / np.float32(unit) for photograph in pyramid
            ]
            depths[name] = [torch.from_numpy(array).to(pyramid[0].color.device) for array in local]
    return Supervision(depths)


def resample_depths(view: View, pinhole: Camera, depth_map: DepthMap) -> NDArray[np.float32]:
    """Return the depths (H, W) of a map at the pixels of a view from the same position.

    Each depth lies on the plane of the map's pixel that contains the centre of the view's pixel. So depths are not
    mixed across edges, and are exact on a slope if the two sizes differ.
    """
    v, u = (index.ravel().astype(np.float64) + 0.5 for index in np.indices((view.height, view.width)))
    k = pinhole.intrinsics
    x = (u - view.cx) / view.fx * k.fx + k.cx
    y = (v - view.cy) / view.fy * k.fy + k.cy
    height, width = depth_map.depth.shape
    inside = np.flatnonzero((x >= 0) & (x < width) & (y >= 0) & (y < height))
    x, y = x[inside], y[inside]
    depths = np.zeros(view.height * view.width, dtype=np.float32)
    depths[inside] = depths_on_planes(pinhole, depth_map, y.astype(np.int64), x.astype(np.int64), x, y)
    return depths.reshape(view.height, view.width)
