"""The pixels of images and masks, decoded by Pillow and brought to the size that a scene works with."""

from __future__ import annotations

import struct
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pcbench.errors import InputError, MissingExtra

if TYPE_CHECKING:
    from PIL.Image import Image

Size = tuple[int, int]  # width and height in pixels

# Tags of EXIF (CIPA DC-008): its directory, in it the size, and pixels to a unit of the sensor.
_EXIF, _PIXELS, _RESOLUTIONS = 0x8769, (0xA002, 0xA003), (0xA20E, 0xA20F)
_MAX_EXIF = 65_000  # bytes that a JPEG's segment takes


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
    """Write an image at another size: PNG without loss, JPEG at quality 97 without subsampled colours. What its EXIF
    says goes with it, which is how others know the focal length; a damaged block is left out.

    Raises:
        InputError: it cannot be decoded.
        MissingExtra: Pillow is not installed.
        OSError: the file cannot be written.
    """
    lossless = out.suffix.lower() == ".png"
    options: dict[str, Any] = {"compress_level": 1} if lossless else {"quality": 97, "subsampling": 0}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of Pillow, on damaged blocks
        image = _open(path, "RGB", size)
        if exif := _exif(path, size):
            options["exif"] = exif
    image.save(out, **options)


def _exif(path: Path, size: Size) -> bytes:
    """The EXIF block of an image as it is for another size: of the focal length, one of three ways to give it counts
    in pixels of the sensor. Empty where there is none, or none that can be read.
    """
    from PIL import Image as Pillow
    from PIL.TiffImagePlugin import IFDRational

    try:
        with Pillow.open(path) as original:
            scales = [new / old for new, old in zip(size, original.size, strict=True)]
            exif = original.getexif()
            if not exif:
                return b""
            fields = exif.get_ifd(_EXIF)
            for pixels, resolution, length, scale in zip(_PIXELS, _RESOLUTIONS, size, scales, strict=True):
                if pixels in fields:
                    fields[pixels] = length
                if resolution in fields:
                    fields[resolution] = IFDRational(round(1000 * scale * float(fields[resolution])), 1000)
            block: bytes = exif.tobytes()
    except (OSError, ValueError, TypeError, KeyError, SyntaxError, ArithmeticError, struct.error):
        return b""
    return block if len(block) <= _MAX_EXIF else b""


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
