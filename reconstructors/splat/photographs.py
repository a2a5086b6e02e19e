"""Photographs to train on and to judge by: undistorted, at several sizes, in the frame of the model."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from pcbench.geometry.cameras import Camera
from pcbench.scenes.decode import decode_image, decode_mask
from reconstructors.mvs.views import IMAGE, MASK
from reconstructors.splat.model import LocalFrame
from reconstructors.splat.view import View

if TYPE_CHECKING:
    from torch import Tensor

_NEAREST = 1e-3  # depth up to which nothing is drawn, in units of the cameras' spread
_LEAST_SIDE = 64  # pixels: no smaller size is made


class Photograph(NamedTuple):
    """One photograph at one size.

    Attributes:
        name: of its image.
        view: the pinhole in the frame of the model.
        color: (H, W, 3) uint8.
        valid: (H, W) bool, False where a mask hides it; None for nowhere.
    """

    name: str
    view: View
    color: Tensor
    valid: Tensor | None

    def target(self) -> Tensor:
        """(H, W, 3) float32 from 0 to 1, 0 where a mask hides it."""
        color = self.color.float() / 255
        return color if self.valid is None else color * self.valid[..., None]


Pyramid = list[Photograph]  # of one photograph: the full size first, each next one half as large


def read_photographs(
    folders: Mapping[str, Path], cameras: Mapping[str, Camera], frame: LocalFrame, levels: int
) -> list[Pyramid]:
    """The photographs of view stages (`reconstructors.mvs.views.view_stage`) and their pinholes in the world.

    Args:
        levels: sizes, at most.
    """
    import torch

    pyramids = []
    for name, folder in folders.items():
        camera = frame.camera(cameras[name])
        size = (camera.intrinsics.width, camera.intrinsics.height)
        color = decode_image(folder / IMAGE, size)
        valid = decode_mask(folder / MASK, size) if (folder / MASK).is_file() else None
        pyramid = []
        for level in range(levels):
            if level > 0:
                if min(color.shape[:2]) < 2 * _LEAST_SIDE:
                    break
                color, valid = _halved(color), None if valid is None else _whole(valid)
                width, height = color.shape[1], color.shape[0]
                camera = replace(camera, intrinsics=_halved_camera(camera, width, height))
            pyramid.append(
                Photograph(
                    name,
                    View.of(camera, _NEAREST),
                    torch.from_numpy(color),
                    None if valid is None else torch.from_numpy(valid),
                )
            )
        pyramids.append(pyramid)
    return pyramids


def _halved_camera(camera: Camera, width: int, height: int):  # type: ignore[no-untyped-def]
    """The pinhole of an image of whole 2 x 2 blocks: a last odd row or column is left out."""
    k = camera.intrinsics
    return replace(k, width=width, height=height, fx=k.fx / 2, fy=k.fy / 2, cx=k.cx / 2, cy=k.cy / 2)


def _blocks(image: np.ndarray) -> np.ndarray:
    height, width = image.shape[0] // 2 * 2, image.shape[1] // 2 * 2
    cut = image[:height, :width]
    return cut.reshape(height // 2, 2, width // 2, 2, *image.shape[2:])


def _halved(color: np.ndarray) -> np.ndarray:
    """Means of 2 x 2 blocks, uint8."""
    return ((_blocks(color).astype(np.uint16).sum(axis=(1, 3)) + 2) // 4).astype(np.uint8)


def _whole(valid: np.ndarray) -> np.ndarray:
    """Where all of a block is shown."""
    return _blocks(valid).all(axis=(1, 3))
