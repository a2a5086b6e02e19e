"""Decode images and masks with Pillow and resize them to the working size of a scene."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pcbench.errors import InputError
from pcbench.extras import require
from pcbench.io.image_header import PILLOW_ERRORS, no_pixel_limit

if TYPE_CHECKING:
    from PIL.Image import Image

MAX_PIXELS = 600_000_000  # per image; survey cameras have up to 450 million
Size = tuple[int, int]  # width and height in pixels
_MODES_16_BIT = ("I;16", "I;16L", "I;16B", "I")  # Pillow's names for grey images of 16 bits
_TO_8_BIT = 255 / 65535

# EXIF tags (CIPA DC-008): the EXIF directory, and in it the size in pixels and the resolution of the focal plane.
_EXIF_TAG, _PIXEL_SIZE_TAGS, _RESOLUTION_TAGS = 0x8769, (0xA002, 0xA003), (0xA20E, 0xA20F)
_MAX_EXIF_BYTES = 65_000  # limit of a JPEG segment


def decode_image(path: Path, size: Size) -> NDArray[np.uint8]:
    """Decode an image to (height, width, 3) RGB and resize it with a Lanczos filter.

    Values of 16 bits are scaled to 8 bits. An image with an alpha channel is composited over black.

    Args:
        path: image file.
        size: (width, height) in pixels.

    Raises:
        InputError: the image cannot be decoded.
        MissingExtra: Pillow is not installed.
    """
    return np.array(_load(path, "RGB", size), dtype=np.uint8)


def decode_alpha(path: Path, size: Size) -> NDArray[np.uint8] | None:
    """Decode the alpha channel of an image to (height, width) and resize it with a Lanczos filter.

    Returns:
        Alpha from 0 (transparent) to 255 (opaque); None if all pixels are opaque.

    Raises:
        InputError: the image cannot be decoded.
        MissingExtra: Pillow is not installed.
    """
    alpha = np.array(_load(path, "A", size), dtype=np.uint8)
    return None if alpha.min() == 255 else alpha


def decode_luminance(path: Path, size: Size) -> NDArray[np.float32]:
    """Decode the luminance (height, width) of an image from 0 to 255, not rounded, and resize it with a Lanczos filter.

    The weights of the colours are those of ITU-R BT.601. Grey images of 16 bits keep their precision. Of 16-bit colours
    Pillow reads the upper 8 bits.

    Args:
        path: image file.
        size: (width, height) in pixels.

    Raises:
        InputError: the image cannot be decoded.
        MissingExtra: Pillow is not installed.
    """
    return np.array(_load(path, "F", size), dtype=np.float32)


def decode_gray(path: Path, size: Size) -> NDArray[np.uint8]:
    """Decode an image to grey values (height, width) and resize it with a Lanczos filter.

    Args:
        path: image file.
        size: (width, height) of the result in pixels.

    Raises:
        InputError: the image cannot be decoded.
        MissingExtra: Pillow is not installed.
    """
    return np.array(_load(path, "L", size), dtype=np.uint8)


def opaque_pixels(alpha: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Return where an alpha channel (height, width) is more than half opaque."""
    return np.asarray(alpha > 127)


def decode_mask(path: Path, size: Size) -> NDArray[np.bool_]:
    """Decode a mask to (height, width), True where it is not black, and resize it by nearest neighbour.

    Args:
        path: image file.
        size: (width, height) in pixels.

    Raises:
        InputError: the mask cannot be decoded.
        MissingExtra: Pillow is not installed.
    """
    return np.array(_load(path, "L", size, smooth=False)) > 0


def find_decoding_error(path: Path) -> str | None:
    """Describe why an image cannot be decoded (too large, truncated or unreadable); None if it can be.

    Checksums are verified too: Pillow ignores those of a PNG's pixels, but other decoders refuse wrong ones.

    Raises:
        MissingExtra: Pillow is not installed.
    """
    pillow = require("PIL.Image")
    try:
        with no_pixel_limit(), pillow.open(path) as image:
            if image.width * image.height > MAX_PIXELS:
                return f"too large ({image.width} x {image.height} pixels, at most {MAX_PIXELS / 1e6:.0f} million)"
            image.verify()
        with no_pixel_limit(), pillow.open(path) as image:
            image.load()
    except MemoryError:
        return f"too large ({path.stat().st_size} bytes do not fit into memory)"
    except PILLOW_ERRORS as error:
        what = " ".join(str(error).replace(str(path), "").split())
        return f"{'truncated' if 'truncated' in what.lower() else 'unreadable'} ({what})"
    return None


def resize_image(path: Path, out: Path, size: Size) -> None:
    """Write an image at another size: JPEG at quality 97 without chroma subsampling, or PNG for all other names.

    Programs recognize the format by the content. EXIF data are copied, because other programs read the focal length
    from them; a damaged EXIF block is left out.

    Args:
        path: image file.
        out: output file.
        size: (width, height) in pixels.

    Raises:
        InputError: the image cannot be decoded.
        MissingExtra: Pillow is not installed.
        OSError: the file cannot be written.
    """
    lossless = out.suffix.lower() not in (".jpg", ".jpeg")
    options: dict[str, Any] = {"compress_level": 1} if lossless else {"quality": 97, "subsampling": 0}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Pillow warns about damaged EXIF blocks
        image = _load(path, "RGB", size)
        if exif := _resized_exif(path, size):
            options["exif"] = exif
    image.save(out, format="PNG" if lossless else "JPEG", **options)


def _resized_exif(path: Path, size: Size) -> bytes:
    """Return the EXIF block of an image, adapted to another size; empty if there is none or it cannot be read.

    Programs derive the focal length from the size in pixels and the focal plane resolution, so both are scaled.
    """
    from PIL import Image as Pillow
    from PIL.TiffImagePlugin import IFDRational

    try:
        with Pillow.open(path) as original:
            scales = [new / old for new, old in zip(size, original.size, strict=True)]
            exif = original.getexif()
            if not exif:
                return b""
            fields = exif.get_ifd(_EXIF_TAG)
            for pixels, resolution, length, scale in zip(_PIXEL_SIZE_TAGS, _RESOLUTION_TAGS, size, scales, strict=True):
                if pixels in fields:
                    fields[pixels] = length
                if resolution in fields:
                    fields[resolution] = IFDRational(round(1000 * scale * float(fields[resolution])), 1000)
            block: bytes = exif.tobytes()
    except PILLOW_ERRORS:
        return b""
    return block if len(block) <= _MAX_EXIF_BYTES else b""


def _load(path: Path, mode: str, size: Size, *, smooth: bool = True) -> Image:
    pillow = require("PIL.Image")
    try:
        with no_pixel_limit(), pillow.open(path) as file:
            if file.width * file.height > MAX_PIXELS:
                raise InputError(
                    f"{path}: expected an image of at most {MAX_PIXELS / 1e6:.0f} million pixels, got {file.width} x"
                    f" {file.height}: make it smaller or remove it"
                )
            is_deep = file.mode in _MODES_16_BIT and smooth and mode != "A"
            image: Image = _scale_to_8_bit(file, mode) if is_deep else _convert(file, mode)
    except (OSError, SyntaxError) as error:
        raise InputError(f"{path}: cannot be decoded ({error}): copy the image again or remove it") from error
    except MemoryError as error:
        raise InputError(f"{path}: does not fit into memory: make it smaller or remove it") from error
    if image.size != size:
        image = image.resize(size, pillow.Resampling.LANCZOS if smooth else pillow.Resampling.NEAREST)
    return image


def _scale_to_8_bit(image: Image, mode: str) -> Image:
    """Convert a grey image of 16 bits to a mode, scaled to 0 to 255: Pillow would clip its values at 255."""
    pillow = require("PIL.Image")
    scaled = np.asarray(image.convert("F")) * np.float32(_TO_8_BIT)
    gray: Image = pillow.fromarray(scaled if mode == "F" else scaled.round().astype(np.uint8))
    return gray.convert(mode)


def _convert(image: Image, mode: str) -> Image:
    """Convert an image to a mode; "A" gives its alpha channel, and "RGB" and "F" composite it over black."""
    pillow = require("PIL.Image")
    has_alpha = image.has_transparency_data
    if mode == "A":
        return image.convert("RGBA").getchannel("A") if has_alpha else pillow.new("L", image.size, 255)
    if mode in ("RGB", "F") and has_alpha:
        black = pillow.new("RGBA", image.size, (0, 0, 0, 255))
        image = pillow.alpha_composite(black, image.convert("RGBA")).convert("RGB")
    return image.convert(mode)
