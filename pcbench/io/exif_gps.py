"""GPS positions in EXIF: the GPS directory of the TIFF block in a JPEG's APP1 segment (CIPA DC-008, 4.6.6).

Read here and not by Pillow, see `image_header`. Pillow 13 skips what it cannot read of a damaged block, and gives
positions that differ from these, such as heights below the sea without their sign.
"""

from __future__ import annotations

import struct
from typing import Any

import numpy as np

from pcbench.geometry.geodesy import Gps

_GPS_DIRECTORY = 0x8825
_LATITUDE_REF, _LATITUDE, _LONGITUDE_REF, _LONGITUDE, _ALTITUDE_REF, _ALTITUDE = range(1, 7)
_SIZES = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8, 7: 1, 9: 4, 10: 8}  # bytes of a value, by TIFF type


def gps_from_exif(tiff: bytes) -> Gps | None:
    """The position in an EXIF block; None where there is none, or where the block is damaged: a photograph whose
    position cannot be read is still a photograph.
    """
    order = {b"II": "<", b"MM": ">"}.get(tiff[:2])
    if order is None:
        return None
    try:
        (first,) = struct.unpack_from(f"{order}I", tiff, 4)
        pointer = _directory(tiff, order, first).get(_GPS_DIRECTORY)
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


def _directory(tiff: bytes, order: str, offset: int) -> dict[int, bytes]:
    """Tag -> the bytes of its value, of one TIFF directory."""
    (count,) = struct.unpack_from(f"{order}H", tiff, offset)
    fields: dict[int, bytes] = {}
    for number in range(count):
        place = offset + 2 + 12 * number
        tag, kind, length = struct.unpack_from(f"{order}HHI", tiff, place)
        size = _SIZES.get(kind, 0) * length
        # Up to four bytes stand in the entry itself.
        start = place + 8 if size <= 4 else struct.unpack_from(f"{order}I", tiff, place + 8)[0]
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
