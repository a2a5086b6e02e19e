"""Depths to train by: what dense stereo knows of the surface, beside the photographs.

Photographs are as good with a Gaussian behind the surface or before it; a depth holds it there. The loss gets a term
more: how far the drawn depth is from the map's, as a share of that, by its mean over the pixels that the map knows
(as of Kerbl et al. 2024, "A hierarchical 3D Gaussian representation", who take inverse depths that a network guessed).
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
from reconstructors.mvs.filter import Criteria, depths_beside
from reconstructors.mvs.maps import DepthMap, read_map
from reconstructors.mvs.mvs import COUNTS
from reconstructors.splat.interface import Drawn
from reconstructors.splat.photographs import Photograph, Pyramid
from reconstructors.splat.view import View

if TYPE_CHECKING:
    from torch import Tensor

WEIGHT = 3.0


class Pull(NamedTuple):
    """Derivatives of the loss by transmittance and by depth (H, W) as they were drawn; None where there are none."""

    transmittance: Tensor | None = None
    depth: Tensor | None = None


@dataclass(frozen=True, eq=False)
class Supervision:
    """Depths of some photographs.

    Args:
        depths: by image name, (H, W) float32 for each size of the photograph, the full one first, in the frame of the
            model; 0 where nothing is known.
        weight: of the term.
    """

    depths: Mapping[str, Sequence[Tensor]]
    weight: float = WEIGHT

    def pull(self, photograph: Photograph, drawn: Drawn) -> Pull:
        """What the depths of a photograph add to the derivatives."""
        shape = photograph.color.shape[:2]
        known = [depth for depth in self.depths.get(photograph.name, ()) if depth.shape == shape]
        if not known:
            return Pull()
        assert drawn.depth is not None
        target = known[0]
        held = target > 0
        # By the sums over the Gaussians: a mean would be divided by the little that hides the background at a pixel
        # which is all but clear.
        off = drawn.depth - (1 - drawn.transmittance) * target
        towards = off.sign() * held * (self.weight / held.sum().clamp(min=1))
        return Pull(towards, towards / target.where(held, target.new_ones(())))


def read_supervision(maps: Path, photographs: Sequence[Pyramid], unit: float) -> Supervision:
    """The depths that a folder of `mvs` keeps, a map for each image and the model of their pinholes, for photographs of
    the same cameras: what is as confident and as well confirmed as points of `mvs` are, though points to begin at may
    be less.

    Args:
        unit: of the frame of the model, in the world's.
    """
    import torch

    pinholes = {camera.name: camera for camera in read_colmap_cameras(maps)}
    sure, depths = Criteria(), {}
    for pyramid in photographs:
        name = pyramid[0].name
        if name in pinholes:
            made, counts = read_map(maps / name), np.load(maps / name / COUNTS)
            made = made.where((made.confidence >= sure.confidence) & (counts >= sure.views))
            local = [depths_at(photograph.view, pinholes[name], made) / np.float32(unit) for photograph in pyramid]
            depths[name] = [torch.from_numpy(each).to(pyramid[0].color.device) for each in local]
    return Supervision(depths)


def depths_at(view: View, pinhole: Camera, made: DepthMap) -> NDArray[np.float32]:
    """(H, W) depths of a map at the pixels of a view from the same place: on the plane of the map's pixel that the
    centre of the view's pixel is in. So nothing is mixed across edges, and a slope is met where the two sizes differ.
    """
    v, u = (index.ravel().astype(np.float64) + 0.5 for index in np.indices((view.height, view.width)))
    k = pinhole.intrinsics
    x = (u - view.cx) / view.fx * k.fx + k.cx
    y = (v - view.cy) / view.fy * k.fy + k.cy
    height, width = made.depth.shape
    inside = np.flatnonzero((x >= 0) & (x < width) & (y >= 0) & (y < height))
    x, y = x[inside], y[inside]
    depths = np.zeros(view.height * view.width, dtype=np.float32)
    depths[inside] = depths_beside(pinhole, made, y.astype(np.int64), x.astype(np.int64), x, y)
    return depths.reshape(view.height, view.width)
