"""Read the size, orientation and GPS position of an image without decoding it.

JPEG (ISO/IEC 10918-1, markers) and PNG (W3C, IHDR) are read here. Nothing is decompressed: 1000 images take 0.1 s. TIFF
and WebP, which are rare, are read by Pillow.

Why not Pillow for all: Pillow 13 gives the same sizes and positions for intact images, but takes two to eight times as
long because it reads the complete header. It raises three kinds of errors, and warnings. It also refuses images above
its pixel limit or with damage elsewhere, and would be a dependency even if no image is decoded.
"""

from __future__ import annotations

import struct
import warnings
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from os import SEEK_CUR
from pathlib import Path
from typing import BinaryIO, NamedTuple

from pcbench.errors import InputError
from pcbench.extras import require
from pcbench.geometry.geodesy import Gps
from pcbench.io.exif import GPS_DIRECTORY, gps_from_exif, orientation_from_exif
from pcbench.io.files import errors_named
from pcbench.regular_files import open_regular

JPEG_AND_PNG = (".jpg", ".jpeg", ".png")
EXTENSIONS = (*JPEG_AND_PNG, ".tif", ".tiff", ".webp")

_TIFF = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")  # the last two are BigTIFF
_TIFF_MODES = ("1", "L", "LA", "P", "PA", "RGB", "RGBA", "CMYK", "YCbCr", "LAB", "I;16", "I;16L", "I;16B")  # of Pillow
_PNG = b"\x89PNG\r\n\x1a\n"
_PNG_ALPHA_TYPES = (4, 6)  # colour types with an alpha channel: grey and RGB
_STANDALONE_MARKERS = {0x01, *range(0xD0, 0xD8)}  # markers without a length
_FRAME_MARKERS = {*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC}  # these are tables or reserved
_APP1, _START_OF_SCAN = 0xE1, 0xDA
_MAX_EXIF_BYTES = 1 << 20  # of a PNG; a JPEG's segment is smaller


# What Pillow raises for damaged files.
PILLOW_ERRORS = (OSError, ValueError, TypeError, KeyError, SyntaxError, ArithmeticError, struct.error, zlib.error)


class ImageHeader(NamedTuple):
    """Stored size in pixels (before any EXIF rotation), GPS position of the antenna, alpha, and EXIF orientation.

    `gps` is None if the file has no position. `has_alpha` is True for a PNG with an alpha channel or a
    transparent colour. `orientation` is 1 if the stored pixels are upright.
    """

    width: int
    height: int
    gps: Gps | None
    has_alpha: bool = False
    orientation: int = 1


def read_image_header(path: Path) -> ImageHeader:
    """Read the size, GPS position and orientation of a JPEG, PNG, TIFF or WebP file.

    Raises:
        InputError: the file is missing, empty, truncated, in none of these formats, or has several pages or values that
            are no colours. The message starts with the path.
        MissingExtra: the file is a TIFF or WebP image, and Pillow is not installed.
    """
    with errors_named(path), open_regular(path) as file:
        start = file.read(12)
        file.seek(8)
        if not start:
            raise InputError("expected an image, got an empty file (0 bytes): copy it again or remove it")
        if start[:8] == _PNG:
            header = _png(file)
        elif start[:2] == b"\xff\xd8":
            file.seek(2)
            header = _jpeg(file)
        elif start[:4] in _TIFF or (start[:4] == b"RIFF" and start[8:] == b"WEBP"):
            file.seek(0)
            header = _with_pillow(file)
        else:
            raise InputError("expected a JPEG, PNG, TIFF or WebP image, got another format: convert it to JPEG or PNG")
        if header.width < 1 or header.height < 1:
            raise InputError(
                f"expected an image of at least 1 x 1 pixels, got {header.width} x {header.height}: copy it again"
            )
    return header


@contextmanager
def no_pixel_limit() -> Iterator[None]:
    """Disable Pillow's pixel limit, which is lower than the size of survey images."""
    pillow = require("PIL.Image")
    original_limit, pillow.MAX_IMAGE_PIXELS = pillow.MAX_IMAGE_PIXELS, None
    try:
        yield
    finally:
        pillow.MAX_IMAGE_PIXELS = original_limit


def _png(file: BinaryIO) -> ImageHeader:
    chunk = file.read(16)
    if len(chunk) < 16 or chunk[4:8] != b"IHDR":
        raise InputError("expected a PNG header, got a truncated file: copy the image again")
    width, height = struct.unpack(">II", chunk[8:])
    depth, kind = file.read(2).ljust(2, b"\0")  # bit depth and colour type
    has_transparent_color, gps, orientation = _png_chunks(file)
    # Pillow does not apply transparent colours of 16 bits.
    has_alpha = kind in _PNG_ALPHA_TYPES or (depth <= 8 and has_transparent_color)
    return ImageHeader(width, height, gps, has_alpha, orientation)


def _png_chunks(file: BinaryIO) -> tuple[bool, Gps | None, int]:
    """Return whether a chunk of a PNG makes colours transparent, and the position and orientation of its EXIF block.

    Only chunks before the pixels are read. The file is within its header.
    """
    has_transparent_color, gps, orientation = False, None, 1
    file.seek(7, SEEK_CUR)  # the rest of the header and its checksum
    while len(chunk := file.read(8)) == 8 and chunk[4:] != b"IDAT":
        length, end = int.from_bytes(chunk[:4], "big"), file.tell() + int.from_bytes(chunk[:4], "big") + 4
        if chunk[4:] == b"tRNS":
            has_transparent_color = True
        elif chunk[4:] == b"eXIf":
            block = file.read(min(length, _MAX_EXIF_BYTES))
            gps, orientation = gps_from_exif(block), orientation_from_exif(block)
        file.seek(end)
    return has_transparent_color, gps, orientation


def _jpeg(file: BinaryIO) -> ImageHeader:
    gps: Gps | None = None
    orientation = 1
    while True:
        marker = file.read(2)
        while len(marker) == 2 and marker[1] == 0xFF:  # fill bytes
            marker = marker[1:] + file.read(1)
        if len(marker) < 2 or marker[0] != 0xFF or marker[1] == _START_OF_SCAN:
            break
        if marker[1] in _STANDALONE_MARKERS:
            continue
        length_bytes = file.read(2)
        length = int.from_bytes(length_bytes, "big")
        if len(length_bytes) < 2 or length < 2:
            break
        if marker[1] in _FRAME_MARKERS:
            frame = file.read(5)
            if len(frame) < 5:
                break
            height, width = struct.unpack(">HH", frame[1:])
            return ImageHeader(width, height, gps, orientation=orientation)
        if marker[1] == _APP1:
            segment = file.read(length - 2)
            if segment.startswith(b"Exif\0\0"):
                gps, orientation = gps_from_exif(segment[6:]), orientation_from_exif(segment[6:])
        else:
            file.seek(length - 2, 1)
    raise InputError("expected a JPEG that states its size, got a truncated or damaged file: copy it again")


def _with_pillow(file: BinaryIO) -> ImageHeader:
    """Read the header of a TIFF or WebP file."""
    pillow = require("PIL.Image")
    try:
        with warnings.catch_warnings(), no_pixel_limit(), pillow.open(file) as image:
            warnings.simplefilter("ignore")  # Pillow warns about damaged EXIF blocks
            pages, mode = getattr(image, "n_frames", 1), image.mode
            exif = image.getexif()
            exif.get_ifd(GPS_DIRECTORY)  # loads it
            block = exif.tobytes().removeprefix(b"Exif\0\0") if exif else b""
            header = ImageHeader(
                image.width,
                image.height,
                gps_from_exif(block),
                image.has_transparency_data,
                orientation_from_exif(block),
            )
    except PILLOW_ERRORS as error:
        reason = " ".join(str(error).split())
        raise InputError(f"expected a TIFF or WebP image, got a damaged header ({reason}): copy it again") from error
    if pages > 1:
        raise InputError(f"expected one image, got {pages} pages: save each as a separate file")
    if mode not in _TIFF_MODES:
        raise InputError(f"expected grey values or colours of 8 or 16 bits, got values of type {mode}: convert it")
    return header
