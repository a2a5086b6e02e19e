"""The pixels of images and masks, decoded by Pillow and brought to the size that a scene works with."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pcbench.errors import InputError, MissingExtra

if TYPE_CHECKING:
    from PIL.Image import Image

Size = tuple[int, int]  # width and height in pixels


def decode_image(path: Path, size: Size) -> NDArray[np.uint8]:
    """An image (height, width, 3) RGB, resized smoothly.

    Raises:
        InputError: it cannot be decoded.
        MissingExtra: Pillow is not installed.
    """
    return np.array(_open(path, "RGB", size), dtype=np.uint8)


def decode_mask(path: Path, size: Size) -> NDArray[np.bool_]:
    """Which pixels (height, width) are not black, resized to the nearest pixel: a mask has nothing in between.

    Raises:
        InputError: it cannot be decoded.
        MissingExtra: Pillow is not installed.
    """
    return np.array(_open(path, "L", size, smooth=False)) > 0


def resize_image(path: Path, out: Path, size: Size) -> None:
    """Write an image at another size: PNG without loss, JPEG at quality 97 without subsampled colours.

    Raises:
        InputError: it cannot be decoded.
        MissingExtra: Pillow is not installed.
        OSError: the file cannot be written.
    """
    lossless = out.suffix.lower() == ".png"
    options: dict[str, Any] = {"compress_level": 1} if lossless else {"quality": 97, "subsampling": 0}
    _open(path, "RGB", size).save(out, **options)


def _open(path: Path, mode: str, size: Size, *, smooth: bool = True) -> Image:
    try:
        from PIL import Image, UnidentifiedImageError
    except ImportError as error:
        raise MissingExtra("pillow", "sfm", str(error)) from error
    try:
        with Image.open(path) as file:
            image = file.convert(mode)
    except (OSError, UnidentifiedImageError, SyntaxError, Image.DecompressionBombError) as error:
        raise InputError(f"{path}: cannot be decoded ({error}): copy the image again or remove it") from error
    if image.size == size:
        return image
    return image.resize(size, Image.Resampling.LANCZOS if smooth else Image.Resampling.NEAREST)
