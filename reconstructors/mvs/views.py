"""Photographs as pinholes take them: undistorted, at the size that is matched, with their masks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cameras import Camera, Intrinsics
from pcbench.geometry.transform import Similarity
from pcbench.plugins.stages import stage
from pcbench.scenes import Scene
from pcbench.scenes.decode import decode_image, decode_mask
from reconstructors.mvs.maps import read_depth, read_map
from reconstructors.mvs.patchmatch import GrayView

VIEWS = "views"  # in the workspace: image.png and perhaps mask.png in a folder for each image
IMAGE, MASK = "image.png", "mask.png"
_MOST_WIDER = 1.25  # a pinhole's image may be than the photograph: what a wide lens has in its corners is left out


class Photographs:
    """The views and maps of the images, read when they are asked for; the last few are kept.

    Args:
        cameras: pinholes by image name.
        views: folders of the views by image name.
        keep: how many views and maps are kept.
    """

    def __init__(self, cameras: Mapping[str, Camera], views: Mapping[str, Path], keep: int) -> None:
        self.cameras = cameras
        self._views = views
        self.view = lru_cache(keep)(self._view)
        self.map = lru_cache(keep)(read_map)
        self.depth = lru_cache(keep)(read_depth)

    def _view(self, name: str) -> GrayView:
        return read_view(self._views[name], self.cameras[name])


def in_folder(root: Path, name: str) -> tuple[Path, str]:
    """Where the stage of an image is: images may lie in folders of their own, and their stages then do too."""
    path = root / name
    path.parent.mkdir(parents=True, exist_ok=True)
    return path.parent, path.name


def view_stage(scene: Scene, camera: Camera, target: Camera, workspace: Path) -> Path:
    """The stage with the photograph of `camera` as the pinhole `target` of the same place takes it."""
    inputs = {
        "photograph": scene.select([camera.name]).fingerprint(cameras=False),
        "camera": repr(camera.intrinsics),
        "pinhole": repr(target.intrinsics),
    }

    def make(folder: Path) -> None:
        from PIL import Image

        image, valid = rectified(scene, camera, target.intrinsics)
        Image.fromarray(image).save(folder / IMAGE, compress_level=1)
        if valid is not None:
            Image.fromarray(np.where(valid, np.uint8(255), np.uint8(0))).save(folder / MASK)

    return stage(*in_folder(workspace / VIEWS, camera.name), inputs, make)


def read_view(folder: Path, camera: Camera) -> GrayView:
    """What the stage of a view holds, as it is matched.

    Raises:
        InputError: it cannot be decoded.
    """
    size = (camera.intrinsics.width, camera.intrinsics.height)
    rgb = decode_image(folder / IMAGE, size)
    valid = decode_mask(folder / MASK, size) if (folder / MASK).is_file() else None
    return GrayView(luminance(rgb), camera, valid)


def luminance(rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Grey values (H, W) of colours (H, W, 3), weighted as ITU-R BT.601 does."""
    return np.asarray((rgb @ np.array([0.299, 0.587, 0.114], np.float32)).round(), dtype=np.uint8)


def pinhole(camera: Camera, scale: float) -> Camera:
    """A camera without distortion at the same place, of the same focal length times `scale`, whose image holds the
    undistorted photograph.

    Raises:
        InputError: the distortion folds the image over.
    """
    k = camera.intrinsics.scaled(scale)
    if k.is_pinhole:
        return replace(camera, intrinsics=k)
    left, right, upper, lower = _border(k)
    width, height = round(right - left), round(lower - upper)
    most_x, most_y = round(_MOST_WIDER * k.width), round(_MOST_WIDER * k.height)
    if width > most_x:
        left, width = max(left, k.cx - most_x / 2), most_x
    if height > most_y:
        upper, height = max(upper, k.cy - most_y / 2), most_y
    return replace(camera, intrinsics=Intrinsics(width, height, k.fx, k.fy, k.cx - left, k.cy - upper))


def _border(k: Intrinsics) -> tuple[float, float, float, float]:
    """Left, right, upper and lower end, in pixels of the same intrinsics without distortion, of an image's border."""
    u, v = np.linspace(0, k.width, 65), np.linspace(0, k.height, 65)
    ends = [np.column_stack([u, np.full(65, y)]) for y in (0.0, k.height)]
    ends += [np.column_stack([np.full(65, x), v]) for x in (0.0, k.width)]
    rays = k.directions(np.concatenate(ends))
    x, y = k.fx * rays[:, 0] + k.cx, k.fy * rays[:, 1] + k.cy
    return float(x.min()), float(x.max()), float(y.min()), float(y.max())


def rectified(scene: Scene, camera: Camera, target: Intrinsics) -> tuple[NDArray[np.uint8], NDArray[np.bool_] | None]:
    """The photograph (H, W, 3) of a pinhole at a camera's place, and where it shows something that counts (H, W); None
    where all does.

    The photograph is resized to the pinhole's focal length first, with a filter that keeps what is finer from aliasing,
    and bent straight with cubic interpolation then.

    Raises:
        InputError: it cannot be decoded.
    """
    scale = target.fx / camera.intrinsics.fx
    source = camera.intrinsics.scaled(scale)
    size, name = (source.width, source.height), camera.name
    image = decode_image(scene.folder / name, size)
    mask = decode_mask(scene.masks[name], size) if name in scene.masks else None
    if source.is_pinhole:
        return image, mask
    at = _distorted(source, target)
    inside: NDArray[np.bool_] = np.asarray((at >= 0).all(axis=2) & (at < size).all(axis=2))
    shown = _sampled(image, at)
    if mask is not None:
        column, row = np.floor(np.where(inside[..., None], at, 0)).astype(np.int64).transpose(2, 0, 1)
        inside &= mask[row, column]
    return shown, None if inside.all() else inside


def _distorted(source: Intrinsics, target: Intrinsics) -> FloatArray:
    """Where the pixels of a pinhole are in the photograph: (H, W, 2) of its coordinates."""
    u, v = np.meshgrid(np.arange(target.width) + 0.5, np.arange(target.height) + 0.5)
    rays = target.directions(np.stack([u.ravel(), v.ravel()], axis=1))
    pixels, _ = Camera("", source, Similarity.identity()).project(rays)
    return pixels.reshape(target.height, target.width, 2)


def _sampled(image: NDArray[np.uint8], at: FloatArray) -> NDArray[np.uint8]:
    """An image (H, W, 3) at coordinates (h, w, 2); beyond its border its last pixels."""
    from scipy.ndimage import map_coordinates

    places = [at[..., 1] - 0.5, at[..., 0] - 0.5]
    made = [map_coordinates(image[..., c].astype(np.float32), places, order=3, mode="nearest") for c in range(3)]
    return np.stack(made, axis=-1).clip(0, 255).round().astype(np.uint8)
