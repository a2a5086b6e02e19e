"""Undistorted photographs as pinhole cameras take them, at the size that is matched, with their masks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cameras import Camera, Intrinsics
from pcbench.geometry.transform import Similarity
from pcbench.plugins.stages import stage
from pcbench.scenes import Scene
from pcbench.scenes.decode import decode_alpha, decode_gray, decode_image, decode_mask, opaque_pixels
from reconstructors.mvs.maps import read_depth, read_map
from reconstructors.mvs.patchmatch import GrayView
from reconstructors.sfm.contrast import stretch_contrast

# In the workspace: one folder per image with image.png, mask.png if it is masked, and alpha.png if it is transparent.
VIEWS = "views"
IMAGE, MASK, ALPHA = "image.png", "mask.png", "alpha.png"
_MAX_WIDENING = 1.25  # size of the pinhole's image relative to the photograph; a wide lens's corners are cropped


class ViewCache:
    """Views and maps of the images, read on demand; the most recent ones are cached.

    Args:
        cameras: pinholes by image name.
        views: folders of the views by image name.
        cache_size: number of views, and of maps, to cache.
    """

    def __init__(self, cameras: Mapping[str, Camera], views: Mapping[str, Path], cache_size: int) -> None:
        self.cameras = cameras
        self._views = views
        self.view = lru_cache(cache_size)(self._view)
        self.map = lru_cache(cache_size)(read_map)
        self.depth = lru_cache(cache_size)(read_depth)

    def clear(self) -> None:
        """Drop the cached views and maps from memory."""
        for cached in (self.view, self.map, self.depth):
            cached.cache_clear()

    def _view(self, name: str) -> GrayView:
        return read_view(self._views[name], self.cameras[name])


def stage_location(root: Path, name: str) -> tuple[Path, str]:
    """Return the parent folder and the name of an image's stage; subfolders in image names become subfolders here."""
    path = root / name
    path.parent.mkdir(parents=True, exist_ok=True)
    return path.parent, path.name


def view_stage(scene: Scene, camera: Camera, target: Camera, workspace: Path) -> Path:
    """Return the stage with the photograph of `camera` resampled to the pinhole `target` of the same pose."""
    inputs = {
        "photograph": scene.select([camera.name]).fingerprint(cameras=False),
        "camera": repr(camera.intrinsics),
        "pinhole": repr(target.intrinsics),
    }

    def make(folder: Path) -> None:
        from PIL import Image

        image, valid, alpha = undistort(scene, camera, target.intrinsics)
        Image.fromarray(image).save(folder / IMAGE, compress_level=1)
        if valid is not None:
            Image.fromarray(np.where(valid, np.uint8(255), np.uint8(0))).save(folder / MASK)
        if alpha is not None:
            Image.fromarray(alpha).save(folder / ALPHA)

    return stage(*stage_location(workspace / VIEWS, camera.name), inputs, make)


def read_view(folder: Path, camera: Camera) -> GrayView:
    """Read a view from its stage, in grey, with its mask; pixels that are at least half transparent are masked too.

    The contrast of dark and faint views is stretched.

    Raises:
        InputError: the image cannot be decoded.
    """
    size = (camera.intrinsics.width, camera.intrinsics.height)
    gray = _weigh_colors(decode_image(folder / IMAGE, size))
    valid = decode_mask(folder / MASK, size) if (folder / MASK).is_file() else None
    if (folder / ALPHA).is_file():
        opaque = opaque_pixels(decode_gray(folder / ALPHA, size))
        valid = opaque if valid is None else valid & opaque
    stretched = stretch_contrast(gray)
    return GrayView(gray.round().astype(np.uint8) if stretched is None else stretched, camera, valid)


def luminance(rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return grey values (H, W) of colours (H, W, 3), with the weights of ITU-R BT.601."""
    return np.asarray(_weigh_colors(rgb).round(), dtype=np.uint8)


def _weigh_colors(rgb: NDArray[np.uint8]) -> NDArray[np.float32]:
    return np.asarray(rgb @ np.array([0.299, 0.587, 0.114], np.float32), dtype=np.float32)


def pinhole(camera: Camera, scale: float) -> Camera:
    """Return a camera without distortion of the same pose, whose image contains the undistorted photograph.

    Args:
        camera: the camera of the photograph.
        scale: ratio of the focal lengths.

    Raises:
        InputError: the distortion folds the image over.
    """
    k = camera.intrinsics.scaled(scale)
    if k.is_pinhole:
        return replace(camera, intrinsics=k)
    x, y = (k.border * [k.fx, k.fy] + [k.cx, k.cy]).T
    left, width = _fit(float(x.min()), float(x.max()), k.cx, _MAX_WIDENING * k.width)
    upper, height = _fit(float(y.min()), float(y.max()), k.cy, _MAX_WIDENING * k.height)
    return replace(camera, intrinsics=Intrinsics(width, height, k.fx, k.fy, k.cx - left, k.cy - upper))


def _fit(lower: float, upper: float, center: float, longest: float) -> tuple[float, int]:
    """Return where an interval of pixels begins and its whole length, about the center if it would be too long."""
    if upper - lower > round(longest):
        return max(lower, center - round(longest) / 2), round(longest)
    return lower, round(upper - lower)


class Undistorted(NamedTuple):
    """An undistorted photograph.

    Attributes:
        image: (H, W, 3) colors, composited over black where the photograph is transparent.
        valid: (H, W) False where the mask is black or outside the photograph; None if all pixels are valid.
        alpha: (H, W) from 0 (transparent) to 255 (opaque); None if all pixels are opaque.
    """

    image: NDArray[np.uint8]
    valid: NDArray[np.bool_] | None
    alpha: NDArray[np.uint8] | None = None


def undistort(scene: Scene, camera: Camera, target: Intrinsics) -> Undistorted:
    """Resample the photograph of a camera to a pinhole of the same pose.

    The photograph is first resized to the pinhole's focal length with an antialiasing filter, then undistorted with
    cubic interpolation.

    Raises:
        InputError: the photograph or its mask cannot be decoded.
    """
    scale = target.fx / camera.intrinsics.fx
    source = camera.intrinsics.scaled(scale)
    size, name = (source.width, source.height), camera.name
    image = decode_image(scene.folder / name, size)
    mask = decode_mask(scene.masks[name], size) if name in scene.masks else None
    alpha = decode_alpha(scene.folder / name, size) if name in scene.with_alpha else None
    if source.is_pinhole:
        return Undistorted(image, mask, alpha)
    coordinates = _distorted_coordinates(source, target)
    inside: NDArray[np.bool_] = np.asarray((coordinates >= 0).all(axis=2) & (coordinates < size).all(axis=2))
    resampled = _resample(image, coordinates)
    resampled_alpha = None if alpha is None else _resample(alpha[..., None], coordinates)[..., 0]
    if mask is not None:
        column, row = np.floor(np.where(inside[..., None], coordinates, 0)).astype(np.int64).transpose(2, 0, 1)
        inside &= mask[row, column]
    return Undistorted(resampled, None if inside.all() else inside, resampled_alpha)


def _distorted_coordinates(source: Intrinsics, target: Intrinsics) -> FloatArray:
    """Return the coordinates (H, W, 2) in the photograph of a pinhole's pixels."""
    u, v = np.meshgrid(np.arange(target.width) + 0.5, np.arange(target.height) + 0.5)
    rays = target.directions(np.stack([u.ravel(), v.ravel()], axis=1))
    pixels, _ = Camera("", source, Similarity.identity()).project(rays)
    return pixels.reshape(target.height, target.width, 2)


def _resample(image: NDArray[np.uint8], coordinates: FloatArray) -> NDArray[np.uint8]:
    """Interpolate an image (H, W, C) at coordinates (h, w, 2); beyond its border the border pixels repeat."""
    from scipy.ndimage import map_coordinates

    rows_columns = [coordinates[..., 1] - 0.5, coordinates[..., 0] - 0.5]
    channels = [
        map_coordinates(image[..., c].astype(np.float32), rows_columns, order=3, mode="nearest")
        for c in range(image.shape[2])
    ]
    return np.stack(channels, axis=-1).clip(0, 255).round().astype(np.uint8)
