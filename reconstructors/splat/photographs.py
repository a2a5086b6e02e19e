"""Undistorted photographs for training and evaluation, at several sizes, in the frame of the model."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.errors import InputError
from pcbench.geometry.cameras import Camera, Intrinsics
from pcbench.scenes.decode import decode_gray, decode_image, decode_mask
from reconstructors.mvs.views import ALPHA, IMAGE, MASK, pinhole
from reconstructors.splat.model import LocalFrame
from reconstructors.splat.view import View

if TYPE_CHECKING:
    import torch
    from torch import Tensor

NEAREST = 1e-3  # depth up to which nothing is rendered, in units of the cameras' spread
_MIN_SIDE_PX = 64  # photographs are not downscaled below this shorter side


class Photograph(NamedTuple):
    """One photograph at one size.

    Attributes:
        name: name of its image.
        view: the pinhole in the frame of the model.
        color: (H, W, 3) uint8, composited over black where the photograph is transparent.
        valid: (H, W) bool, False where a mask hides the photograph; None if no mask does.
        alpha: (H, W) uint8 from 0 (transparent) to 255 (opaque); None if the photograph is opaque.
    """

    name: str
    view: View
    color: Tensor
    valid: Tensor | None
    alpha: Tensor | None = None

    @property
    def has_valid_pixels(self) -> bool:
        """Return whether the mask leaves any pixel."""
        return self.valid is None or bool(self.valid.any())

    def over(self, background: Tensor) -> Tensor:
        """Return the colors (H, W, 3) over a background color (3,), as float32 from 0 to 1."""
        color = self.color.float() / 255
        return color if self.alpha is None else color + (1 - self.alpha.float() / 255)[..., None] * background

    def target(self, background: Tensor) -> Tensor:
        """Return the colors (H, W, 3) over a background color (3,), 0 where a mask hides them."""
        color = self.over(background)
        return color if self.valid is None else color * self.valid[..., None]


Pyramid = list[Photograph]  # the sizes of one photograph: the full size first, each next one half as wide


def check_training(image_side: int | None, memory_gb: float, seed: int) -> None:
    """Check the settings that reconstructors trained on photographs have in common.

    Raises:
        ValueError: a setting is out of its range.
    """
    if image_side is not None and image_side < 16:
        raise ValueError(f"expected photographs of at least 16 pixels, got image_side={image_side}")
    if not (np.isfinite(memory_gb) and memory_gb > 0):
        raise ValueError(f"expected memory in gigabytes, got {memory_gb}")
    if not 0 <= seed < 2**31:
        raise ValueError(f"expected a seed from 0 to 2^31 - 1, got {seed}")


def training_pinhole(camera: Camera, max_side: int) -> Camera:
    """Return the pinhole of a photograph for training, whose longer side has at most `max_side` pixels."""
    return pinhole(camera, min(1.0, max_side / max(camera.intrinsics.width, camera.intrinsics.height)))


def select_usable(photographs: Iterable[Pyramid], names: Iterable[str]) -> list[Pyramid]:
    """Return the photographs of these names that have valid pixels, in the order of the names.

    Raises:
        InputError: there are none.
    """
    by_name, names = {pyramid[0].name: pyramid for pyramid in photographs}, list(names)
    usable = [by_name[name] for name in names if by_name[name][0].has_valid_pixels]
    if not usable:
        raise InputError(f"the masks hide all of the {len(names)} training photographs: black mask pixels are left out")
    return usable


def read_photographs(
    folders: Mapping[str, Path], cameras: Mapping[str, Camera], frame: LocalFrame, levels: int, device: torch.device
) -> list[Pyramid]:
    """Read the photographs of view stages (`reconstructors.mvs.views.view_stage`).

    Args:
        folders: folder of the view stage, by image name.
        cameras: pinholes in the world, by image name.
        frame: the frame of the model.
        levels: maximum number of sizes.
        device: device for all photographs, which are stored as bytes.
    """
    import torch

    pyramids = []
    for name, folder in folders.items():
        camera = frame.camera(cameras[name])
        size = (camera.intrinsics.width, camera.intrinsics.height)
        color = decode_image(folder / IMAGE, size)
        valid = decode_mask(folder / MASK, size) if (folder / MASK).is_file() else None
        alpha = decode_gray(folder / ALPHA, size) if (folder / ALPHA).is_file() else None
        pyramid = []
        for level in range(levels):
            if level > 0:
                if min(color.shape[:2]) < 2 * _MIN_SIDE_PX:
                    break
                color, valid = _halve(color), None if valid is None else _all_valid(valid)
                alpha = None if alpha is None else _halve(alpha)
                camera = replace(camera, intrinsics=_halve_intrinsics(camera.intrinsics))
            pyramid.append(
                Photograph(
                    name,
                    View.of(camera, NEAREST),
                    torch.from_numpy(color).to(device),
                    None if valid is None else torch.from_numpy(valid).to(device),
                    None if alpha is None else torch.from_numpy(alpha).to(device),
                )
            )
        pyramids.append(pyramid)
    return pyramids


def _halve_intrinsics(k: Intrinsics) -> Intrinsics:
    """Return the intrinsics of an image of half the size; a last odd row or column is cropped."""
    return replace(k, width=k.width // 2, height=k.height // 2, fx=k.fx / 2, fy=k.fy / 2, cx=k.cx / 2, cy=k.cy / 2)


def _blocks(image: NDArray[Any]) -> NDArray[Any]:
    """Return the 2 x 2 blocks of an image as an array (H / 2, 2, W / 2, 2, ...)."""
    height, width = image.shape[0] // 2, image.shape[1] // 2
    return image[: 2 * height, : 2 * width].reshape(height, 2, width, 2, *image.shape[2:])


def _halve(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the rounded means of 2 x 2 blocks."""
    return np.asarray((_blocks(image).astype(np.uint16).sum(axis=(1, 3)) + 2) // 4, dtype=np.uint8)


def _all_valid(valid: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return a mask of the 2 x 2 blocks whose pixels are all valid."""
    return np.asarray(_blocks(valid).all(axis=(1, 3)))
