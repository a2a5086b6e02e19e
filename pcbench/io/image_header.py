"""What a photograph's file says before it is decoded: its size, and where it was taken.

JPEG (ISO/IEC 10918-1, markers) and PNG (W3C, IHDR). Nothing is decompressed: a thousand photographs take a tenth of a
second.

Read here and not by Pillow. Pillow 13 gives the same sizes and positions for whole photographs, in two to eight times
the time, but reads all of the header: it lets out errors of three kinds and warnings, refuses photographs that are
larger than its pixel limit or damaged where neither the size nor the position stands, and would be needed to read a
scene of which no image is decoded.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import BinaryIO, NamedTuple

from pcbench.errors import InputError
from pcbench.geometry.geodesy import Gps
from pcbench.io.exif_gps import gps_from_exif
from pcbench.regular_files import open_regular

EXTENSIONS = (".jpg", ".jpeg", ".png")

_PNG = b"\x89PNG\r\n\x1a\n"
_STANDALONE_MARKERS = {0x01, *range(0xD0, 0xD8)}  # markers without a length
_FRAME_MARKERS = {*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC}  # the three others are tables
_APP1, _START_OF_SCAN = 0xE1, 0xDA


class ImageHeader(NamedTuple):
    """Size in pixels as stored (a viewer may turn it), and the position of the antenna if the file has one."""

    width: int
    height: int
    gps: Gps | None


def read_image_header(path: Path) -> ImageHeader:
    """Size and GPS position of a JPEG or PNG file.

    Raises:
        InputError: the file is missing, empty, cut off, or neither format; the message starts with the path.
    """
    try:
        with open_regular(path) as file:
            start = file.read(8)
            if not start:
                raise InputError("expected an image, got an empty file (0 bytes): copy it again or remove it")
            if start == _PNG:
                header = _png(file)
            elif start[:2] == b"\xff\xd8":
                file.seek(2)
                header = _jpeg(file)
            else:
                raise InputError("expected a JPEG or PNG image, got something else: convert it first")
            if header.width < 1 or header.height < 1:
                raise InputError(f"expected an image of at least one pixel, got {header.width} x {header.height}")
            return header
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error


def _png(file: BinaryIO) -> ImageHeader:
    chunk = file.read(16)
    if len(chunk) < 16 or chunk[4:8] != b"IHDR":
        raise InputError("expected a PNG header, got a file that ends before it: the image is cut off")
    width, height = struct.unpack(">II", chunk[8:])
    return ImageHeader(width, height, None)


def _jpeg(file: BinaryIO) -> ImageHeader:
    gps: Gps | None = None
    while True:
        marker = file.read(2)
        while len(marker) == 2 and marker[1] == 0xFF:  # fill bytes
            marker = marker[1:] + file.read(1)
        if len(marker) < 2 or marker[0] != 0xFF or marker[1] == _START_OF_SCAN:
            raise InputError("expected a JPEG with its size before the pixels: the image is cut off or damaged")
        if marker[1] in _STANDALONE_MARKERS:
            continue
        length_bytes = file.read(2)
        length = int.from_bytes(length_bytes, "big")
        if len(length_bytes) < 2 or length < 2:
            raise InputError("expected a JPEG with its size before the pixels: the image is cut off or damaged")
        if marker[1] in _FRAME_MARKERS:
            frame = file.read(5)
            if len(frame) < 5:
                raise InputError("expected a JPEG with its size before the pixels: the image is cut off or damaged")
            height, width = struct.unpack(">HH", frame[1:])
            return ImageHeader(width, height, gps)
        if marker[1] == _APP1:
            segment = file.read(length - 2)
            if segment.startswith(b"Exif\0\0"):
                gps = gps_from_exif(segment[6:])
        else:
            file.seek(length - 2, 1)
