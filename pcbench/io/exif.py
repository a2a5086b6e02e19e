"""Read orientation and GPS position from EXIF: the TIFF block in a JPEG's APP1 segment or a PNG's eXIf chunk.

Tags are those of CIPA DC-008: the orientation is in 4.6.4, the GPS directory in 4.6.6.

For why Pillow is not used, see `image_header`. In addition, Pillow 13 skips unreadable parts of a damaged block and
returns other positions, such as heights below sea level without their sign.
"""

from __future__ import annotations

import struct
from typing import Any

import numpy as np

from pcbench.geometry.geodesy import Gps

GPS_DIRECTORY = 0x8825
_ORIENTATION = 0x0112
_LATITUDE_REF, _LATITUDE, _LONGITUDE_REF, _LONGITUDE, _ALTITUDE_REF, _ALTITUDE = range(1, 7)
_TYPE_BYTES = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8, 7: 1, 9: 4, 10: 8}  # bytes of a value, by TIFF type


def gps_from_exif(tiff: bytes) -> Gps | None:
    """Return the position in an EXIF block; None if there is none or the block is damaged.

    An image whose position cannot be read is still a valid image.
    """
    order = _byte_order(tiff)
    if order is None:
        return None
    try:
        pointer = _first_directory(tiff, order).get(GPS_DIRECTORY)
        if pointer is None:
            return None
        fields = _directory(tiff, order, struct.unpack(f"{order}I", pointer[:4])[0])
        latitude = _degrees(fields[_LATITUDE], order) * (-1 if fields[_LATITUDE_REF][:1] == b"S" else 1)
        longitude = _degrees(fields[_LONGITUDE], order) * (-1 if fields[_LONGITUDE_REF][:1] == b"W" else 1)
        below = fields.get(_ALTITUDE_REF, b"\0")[:1] == b"\x01"
        altitude = _rationals(fields[_ALTITUDE], order)[0] * (-1 if below else 1) if _ALTITUDE in fields else 0.0
    except (struct.error, KeyError, ValueError, ZeroDivisionError, IndexError):
        return None
    # A receiver without a fix writes zeros.
    if not (abs(latitude) <= 90 and abs(longitude) <= 180 and np.isfinite(altitude)) or latitude == longitude == 0:
        return None
    return Gps(latitude, longitude, altitude)


def orientation_from_exif(tiff: bytes) -> int:
    """Return how an image is turned for display, from 1 (not at all) to 8; 1 if it is missing or damaged."""
    order = _byte_order(tiff)
    if order is None:
        return 1
    try:
        value = _first_directory(tiff, order).get(_ORIENTATION, b"")
        (orientation,) = struct.unpack(f"{order}H", value[:2])
    except (struct.error, ValueError):
        return 1
    return orientation if 1 <= orientation <= 8 else 1


def _byte_order(tiff: bytes) -> str | None:
    return {b"II": "<", b"MM": ">"}.get(tiff[:2])


def _first_directory(tiff: bytes, order: str) -> dict[int, bytes]:
    return _directory(tiff, order, *struct.unpack_from(f"{order}I", tiff, 4))


def _directory(tiff: bytes, order: str, offset: int) -> dict[int, bytes]:
    """Return the value bytes of one TIFF directory by tag."""
    (count,) = struct.unpack_from(f"{order}H", tiff, offset)
    fields: dict[int, bytes] = {}
    for number in range(count):
        entry = offset + 2 + 12 * number
        tag, kind, length = struct.unpack_from(f"{order}HHI", tiff, entry)
        size = _TYPE_BYTES.get(kind, 0) * length
        # Values of up to four bytes are stored in the entry itself.
        start = entry + 8 if size <= 4 else struct.unpack_from(f"{order}I", tiff, entry + 8)[0]
        if start + size > len(tiff):
            raise ValueError("a value outside the block")
        fields[tag] = tiff[start : start + max(size, 4)] if size <= 4 else tiff[start : start + size]
    return fields


def _rationals(value: bytes, order: str) -> list[float]:
    numbers: Any = struct.unpack(f"{order}{len(value) // 4}I", value)
    return [a / b for a, b in zip(numbers[::2], numbers[1::2], strict=True)]


def _degrees(value: bytes, order: str) -> float:
    degrees, minutes, seconds = _rationals(value, order)
    return degrees + minutes / 60 + seconds / 3600
