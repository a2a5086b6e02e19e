"""Read the header of a LAS file and check it against the size of the file.

LAS 1.0 to 1.4, point formats 0 to 10; LAZ and COPC have the same header. ASPRS, "LAS Specification 1.4 - R15", 2019.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from pcbench.errors import InputError
from pcbench.io.files import Warn

HEADER = struct.Struct("<4s HH 16s BB 32s 32s HH H I I B H I 5I 3d 3d 6d")  # all versions: 227 bytes
HEADER_1_4 = struct.Struct("<Q QI Q 15Q")  # waveforms; first extended record and record count; point count, by return
VLR = struct.Struct("<H 16s H H 32s")
EVLR = struct.Struct("<H 16s H Q 32s")

_XYZI = [("X", "<i4"), ("Y", "<i4"), ("Z", "<i4"), ("intensity", "<u2"), ("returns", "u1")]
_LEGACY = [*_XYZI, ("class_flags", "u1"), ("scan_angle", "i1"), ("user_data", "u1"), ("point_source_id", "<u2")]
_EXTENDED = [*_XYZI, ("flags", "u1"), ("classification", "u1"), ("user_data", "u1"), ("scan_angle", "<i2")]
_EXTENDED += [("point_source_id", "<u2"), ("gps_time", "<f8")]
_GPS = [("gps_time", "<f8")]
_RGB = [("red", "<u2"), ("green", "<u2"), ("blue", "<u2")]
_NIR = [("nir", "<u2")]
_WAVE = [("wave_packet", "V29")]
POINT_FORMATS = (
    _LEGACY,
    _LEGACY + _GPS,
    _LEGACY + _RGB,
    _LEGACY + _GPS + _RGB,
    _LEGACY + _GPS + _WAVE,
    _LEGACY + _GPS + _RGB + _WAVE,
    _EXTENDED,
    _EXTENDED + _RGB,
    _EXTENDED + _RGB + _NIR,
    _EXTENDED + _WAVE,
    _EXTENDED + _RGB + _NIR + _WAVE,
)

# Types of extra bytes, by type number from 1; 11 to 20 and 21 to 30 are pairs and triples of the same types.
EXTRA_TYPES = ("u1", "i1", "<u2", "<i2", "<u4", "<i4", "<u8", "<i8", "<f4", "<f8")
EXTRA_LAYOUT = struct.Struct("<2s BB 32s 4s 24s 24s 24s 3d 3d 32s")
EXTRA_NO_DATA, EXTRA_SCALE, EXTRA_OFFSET = 1, 8, 16  # bits of a description's options

EXTRA_BYTES = ("LASF_Spec", 4)  # record that describes them

_MAX_RECORDS = 10_000  # real files have about a dozen
_MAX_RECORD_BYTES = 1 << 20  # longer extended records (waveforms, COPC's hierarchy) are not needed
# The variable length records that are read: coordinate system, extra bytes, LASzip.
_READ_RECORDS = {
    *(("LASF_Projection", 2112), ("LASF_Projection", 34735), ("LASF_Projection", 34736), EXTRA_BYTES),
    ("laszip encoded", 22204),
}


class ExtraDimension(NamedTuple):
    """Extra dimension after the standard ones of a point record: `size` numbers of type `dtype`."""

    name: str
    dtype: np.dtype[Any]
    size: int
    no_data: bytes | None  # eight bytes per number
    scales: tuple[float, ...]
    offsets: tuple[float, ...]


@dataclass(frozen=True)
class LasHeader:
    """Header fields needed to read the points, checked against the size of the file."""

    point_format: int
    compressed: bool
    record_bytes: int
    count: int
    start: int  # first byte of the points
    end: int  # upper bound of the first byte after the points: the extended records or the end of the file
    scales: tuple[float, float, float]
    offsets: tuple[float, float, float]
    records: dict[tuple[str, int], bytes]  # by user and record ID
    bounds: tuple[tuple[float, ...], tuple[float, ...]] | None  # minimum and maximum x, y, z; None if all are zero
    by_return: tuple[int, ...]  # number of points per return number from 1; empty if all are zero

    @property
    def is_extended(self) -> bool:
        """Return whether this is one of the point formats 6 to 10, with wider return numbers and classes."""
        return self.point_format >= 6

    @property
    def extra_bytes(self) -> int:
        """Number of extra bytes per point."""
        return self.record_bytes - np.dtype(POINT_FORMATS[self.point_format]).itemsize


def read_header(file: BinaryIO, warn: Warn, allow_empty: bool = False) -> LasHeader:
    """Read the header and the records that are needed.

    Args:
        file: input file.
        warn: callback for warnings.
        allow_empty: whether the file may have no points, as tiles do.

    Raises:
        InputError: the file is not a LAS file, or its header is inconsistent or does not fit the size of the file.
    """
    size = file.seek(0, 2)
    file.seek(0)
    block = file.read(HEADER.size + HEADER_1_4.size)
    if block[:4] != b"LASF":
        raise InputError(f"expected a LAS file that starts with b'LASF', got {block[:4]!r}: export it again as LAS")
    if len(block) < HEADER.size:
        raise InputError(f"truncated: got {len(block)} of {HEADER.size} header bytes: copy or export the file again")
    fields = HEADER.unpack_from(block)
    major, minor = fields[4:6]
    header_bytes, start, vlr_count, format_byte, record_bytes, count = fields[10:16]
    scales, offsets = fields[21:24], fields[24:27]

    if major != 1 or minor > 4:
        raise InputError(f"expected LAS 1.0 to 1.4, got version {major}.{minor}: export it as LAS 1.4")
    least = {3: HEADER.size + 8, 4: HEADER.size + HEADER_1_4.size}.get(minor, HEADER.size)
    if header_bytes < least:
        raise InputError(
            f"expected a LAS 1.{minor} header of {least} bytes or more, got {header_bytes}: export it again"
        )
    if not header_bytes <= start:
        raise InputError(f"expected points after the header of {header_bytes} bytes, got byte {start}: export it again")
    if start > size:
        raise InputError(f"truncated: points start at byte {start}, the file has {size} bytes: copy or export it again")
    point_format = format_byte & 0x3F  # LASzip uses the two upper bits as flags
    if point_format >= len(POINT_FORMATS):
        raise InputError(
            f"expected a point format from 0 to {len(POINT_FORMATS) - 1}, got {point_format}: export it again"
        )
    least = np.dtype(POINT_FORMATS[point_format]).itemsize
    if record_bytes < least:
        raise InputError(
            f"expected at least {least} bytes per point in format {point_format}, got {record_bytes}: export it again"
        )
    if not all(math.isfinite(number) for number in (*scales, *offsets)) or 0 in scales:
        raise InputError(
            f"expected finite non-zero scales and finite offsets, got {scales} and {offsets}: export it again"
        )

    highest, lowest = fields[27:33:2], fields[28:33:2]
    by_return = fields[16:21]
    end, first_evlr, evlr_count = size, 0, 0
    if minor == 4:
        _, first_evlr, evlr_count, long_count, *long_by_return = HEADER_1_4.unpack_from(block, HEADER.size)
        by_return = tuple(long_by_return) if any(long_by_return) else by_return
        if long_count and count not in (0, long_count):
            warn(f"the header states {count} points for old readers and {long_count} for new ones: read {long_count}")
        count = long_count or count
    if not count and not allow_empty:
        raise InputError("expected at least one point, got 0: export the file again")
    records, problem = _read_records(file, VLR, vlr_count, header_bytes, start)
    if problem:
        warn(problem)
    if evlr_count:
        if start <= first_evlr <= size:
            end = first_evlr
        try:
            extended, problem = _read_records(file, EVLR, evlr_count, first_evlr, size)
            records = extended | records
        except InputError as error:
            problem = str(error)
        if problem:
            warn(f"left out extended records: {problem}")
    return LasHeader(
        point_format, bool(format_byte & 0xC0), record_bytes, count, start, end, scales, offsets, records,
        (lowest, highest) if any((*lowest, *highest)) else None, by_return if any(by_return) else (),
    )  # fmt: skip


def _read_records(
    file: BinaryIO, layout: struct.Struct, count: int, offset: int, end: int
) -> tuple[dict[tuple[str, int], bytes], str]:
    """Read the needed ones of `count` records between bytes `offset` and `end`; the first of each kind is kept.

    Returns:
        The records, and a warning if there are fewer than stated, which other readers accept; else "".

    Raises:
        InputError: the count is absurd, or a record does not end before `end`.
    """
    if count > _MAX_RECORDS:
        raise InputError(f"expected at most {_MAX_RECORDS} variable length records, got {count}: export the file again")
    records: dict[tuple[str, int], bytes] = {}
    for number in range(count):
        if offset + layout.size > end:
            return records, f"the header states {count} variable length records, the file has {number}: read these"
        file.seek(offset)
        _, user, record_id, length, _ = layout.unpack(file.read(layout.size))
        offset += layout.size
        if offset + length > end:
            raise InputError(
                f"variable length record {number + 1} of {count} ends at byte {offset + length}, after byte {end}:"
                " export the file again"
            )
        key = (user.split(b"\0")[0].decode("latin-1"), record_id)
        if key in _READ_RECORDS and key not in records and length <= _MAX_RECORD_BYTES:
            records[key] = file.read(length)
        offset += length
    return records, ""


def read_extras(header: LasHeader, warn: Warn) -> list[ExtraDimension]:
    """Return the described extra dimensions in order, including undescribed gaps (with an empty `name`).

    If the descriptions do not fit the record, all are left out with a warning: the coordinates do not depend on them.
    """
    data = header.records.get(EXTRA_BYTES, b"")
    extras = []
    for fields in EXTRA_LAYOUT.iter_unpack(data[: len(data) // EXTRA_LAYOUT.size * EXTRA_LAYOUT.size]):
        _, kind, options, name, _, no_data, _, _, *numbers, _ = fields
        size, dtype = 1, np.dtype("u1")
        if kind == 0:  # undocumented bytes; `options` is their count
            size, name = options, b""
        elif kind <= 3 * len(EXTRA_TYPES):
            size, dtype = (kind - 1) // len(EXTRA_TYPES) + 1, np.dtype(EXTRA_TYPES[(kind - 1) % len(EXTRA_TYPES)])
        else:
            warn(f"left out the extra bytes: expected a type from 0 to {3 * len(EXTRA_TYPES)}, got {kind}")
            return []
        extras.append(
            ExtraDimension(
                name.split(b"\0")[0].decode("utf-8", errors="replace").strip(),
                dtype,
                size,
                no_data if kind and options & EXTRA_NO_DATA else None,
                tuple(numbers[:3]) if kind and options & EXTRA_SCALE else (1.0,) * 3,
                tuple(numbers[3:]) if kind and options & EXTRA_OFFSET else (0.0,) * 3,
            )
        )
    described = sum(extra.size * extra.dtype.itemsize for extra in extras)
    if described > header.extra_bytes:
        warn(f"left out the extra bytes: the descriptions need {described} bytes, a point has {header.extra_bytes}")
        return []
    return extras
