"""Read and write .spz files of Gaussian splats: columns of quantised values, compressed with gzip or Zstandard.

The format is that of Niantic's library spz (MIT), versions 1 to 4; version 3 is written. Its axes are x right, y up and
z back, while splats in PLY files have y down and z forward. So y and z change their signs, as in its own converters,
and a model has the same coordinates in both formats.

Why not the library: it has no wheels, and it trusts the counts in a file.
"""

from __future__ import annotations

import struct
import zlib
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.errors import InputError, MissingExtra
from pcbench.extras import require
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.splats import is_splat_attribute
from pcbench.io.files import Fields, Warn
from pcbench.io.names import left_out_warning
from pcbench.io.splat_fields import (
    dc_coefficients,
    model_to_write,
    rotations_of,
    shift_advice,
    splat_fields,
    stack_columns,
    to_bytes,
)
from pcbench.scratch import atomic_write

_MAGIC = 0x5053474E  # "NGSP"
_HEADER = struct.Struct("<IIIBBBB")  # magic, version, count, degree, fractional bits, flags, number of streams
_HEADER_4_BYTES, _TOC_ENTRY = 32, struct.Struct("<QQ")
_HAS_EXTENSIONS = 2
_MAX_DEGREE, _MAX_WRITTEN_DEGREE = 4, 3  # version 3 of the library read degree 4 only in its last releases
_MAX_FRACTIONAL_BITS = 24
# Bound of the unpacked size: this factor times the file size, plus bytes. Splats shrink to a half or a third.
_MAX_GROWTH, _MAX_FREE_GROWTH_BYTES = 200, 16 << 20
_AXES = np.array([1.0, -1.0, -1.0])  # from the axes of PLY files to those of the format, and back
_COLOR_SCALE = 0.15  # of coefficients of degree 0, so that colours beyond 0 and 1 are kept
_LEAST_LOG_SCALE, _LOG_SCALE_STEPS = -10.0, 16.0
# Signs of the coefficients of degrees 1 to 4 under `_AXES`: parities of the harmonics in y and z.
_SH_SIGNS = np.array(
    [-1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1, -1, 1, -1, 1, 1, -1, 1, -1, 1], dtype=np.float64
)
_SH_STEPS = np.repeat([8, 16], [3, 12])  # 5 bits of degree 1, 4 bits of the others, as the library writes them
_POSITION_BITS, _FRACTIONAL_BITS = 24, 12  # the library always writes 12


class _SpzHeader(NamedTuple):
    version: int
    splats: int
    degree: int
    fractional_bits: int
    flags: int

    @property
    def coefficients(self) -> int:
        """Number of coefficients of one colour, without degree 0."""
        return self.degree * (self.degree + 2)

    @property
    def widths(self) -> tuple[int, ...]:
        """Bytes of one splat in each column: position, opacity, colour, scales, rotation, harmonics."""
        return (6 if self.version == 1 else 9, 1, 3, 3, 4 if self.version >= 3 else 3, 3 * self.coefficients)


def read_spz(path: Path, warn: Warn) -> Fields:
    """Read the splats of a file.

    Raises:
        InputError: the file is damaged, truncated or of another version, or it has version 4 and the library zstandard
            is not installed.
        OSError: the file cannot be read.
    """
    with path.open("rb") as file:
        start = file.read(_HEADER_4_BYTES)
        file.seek(0)
        if start.startswith(b"\x1f\x8b"):
            header, columns = _read_gzip(file.read(), warn)
        elif start.startswith(struct.pack("<I", _MAGIC)):
            header, columns = _read_version_4(file, path.stat().st_size, warn)
        else:
            raise InputError(f"expected a .spz file that starts with gzip or NGSP, got {start[:4]!r}: export it again")
    position, opacity, color, scales, rotation, harmonics = columns
    with np.errstate(invalid="ignore", over="ignore"):
        rest = None
        if header.degree:
            values = (harmonics.reshape(-1, header.coefficients, 3).astype(np.float64) - 128) / 128
            rest = (values * _SH_SIGNS[: header.coefficients, None]).transpose(0, 2, 1)
        return splat_fields(
            _positions(position, header) * _AXES + 0.0,  # no -0
            (color / 255 - 0.5) / _COLOR_SCALE,
            opacity[:, 0] / 255,
            scales / _LOG_SCALE_STEPS + _LEAST_LOG_SCALE,
            _quaternions(rotation) * [1, *(_AXES.prod() * _AXES)],
            rest,
        )


# ---- containers ---------------------------------------------------------------------------------------------------


def _read_gzip(data: bytes, warn: Warn) -> tuple[_SpzHeader, list[NDArray[np.uint8]]]:
    """Return the header and the columns of versions 1 to 3; sizes are checked before anything is unpacked."""
    unpacker = zlib.decompressobj(wbits=16 + zlib.MAX_WBITS)
    try:
        header = _parse_header(unpacker.decompress(data, _HEADER.size), (1, 2, 3))
        expected = _unpacked_bytes(header, len(data))
        body = unpacker.decompress(unpacker.unconsumed_tail, expected)
        surplus = unpacker.decompress(unpacker.unconsumed_tail, 1) if len(body) == expected else b""
    except zlib.error as error:
        raise InputError(f"damaged: {str(error)[:80]}: copy or export the file again") from error
    if len(body) < expected:
        complete = len(body) // sum(header.widths)
        raise InputError(f"truncated: got less than {header.splats} splats ({complete}): copy or export the file again")
    if not surplus and not unpacker.eof:
        raise InputError("truncated: got all splats, but no checksum: copy or export the file again")
    if header.flags & _HAS_EXTENSIONS or surplus:
        warn("left out extensions after the splats")
    ends = np.cumsum([header.splats * width for width in header.widths])
    values = np.frombuffer(body, np.uint8)
    parts = [values[end - header.splats * width : end] for end, width in zip(ends, header.widths, strict=True)]
    return header, [part.reshape(header.splats, -1) for part in parts]


def _read_version_4(file: BinaryIO, size: int, warn: Warn) -> tuple[_SpzHeader, list[NDArray[np.uint8]]]:
    """Return the header and the columns of version 4: a table of contents, and one Zstandard stream per column."""
    start = file.read(_HEADER_4_BYTES)
    header = _parse_header(start, (4,))
    if len(start) < _HEADER_4_BYTES:
        raise _truncated_header(start)
    (toc,) = struct.unpack("<I", start[16:20])
    widths = [width for width in header.widths if width]
    streams = start[15]
    if streams != len(widths) or toc < _HEADER_4_BYTES or toc + streams * _TOC_ENTRY.size > size:
        raise InputError(
            f"expected {len(widths)} streams and their table, got {streams} and a table at byte {toc} of {size}: copy"
            " or export the file again"
        )
    if toc > _HEADER_4_BYTES:
        warn("left out extensions before the splats")
    file.seek(toc)
    entries = list(_TOC_ENTRY.iter_unpack(file.read(streams * _TOC_ENTRY.size)))
    stored = sum(packed for packed, _ in entries)
    _unpacked_bytes(header, size)
    if stored > size or [unpacked for _, unpacked in entries] != [header.splats * width for width in widths]:
        raise InputError(f"truncated: got less than {header.splats} splats: copy or export the file again")
    try:
        zstandard = require("zstandard")
    except MissingExtra as error:
        raise InputError(
            f"version 4 of the format: {error}, or convert it with 'splat-transform IN.spz OUT.spz --spz-version 3'"
        ) from None
    columns = []
    for (packed, unpacked), width in zip(entries, widths, strict=True):
        try:
            # A reader unpacks no more than is asked for, whatever the stream states.
            values = zstandard.ZstdDecompressor().stream_reader(file.read(packed)).read(unpacked)
        except (zstandard.ZstdError, MemoryError) as error:
            raise InputError(f"damaged: {str(error)[:80]}: copy or export the file again") from error
        if len(values) != unpacked:
            raise InputError(f"truncated: got less than {header.splats} splats: copy or export the file again")
        columns.append(np.frombuffer(values, np.uint8).reshape(-1, width))
    if not header.degree:
        columns.append(np.empty((header.splats, 0), np.uint8))
    return header, columns


def _unpacked_bytes(header: _SpzHeader, size: int) -> int:
    """Return the number of bytes of all columns, which must be plausible for the size of the file."""
    expected = header.splats * sum(header.widths)
    if expected > _MAX_FREE_GROWTH_BYTES + _MAX_GROWTH * size:
        raise InputError(f"{size} bytes would unpack to {expected} bytes of {header.splats} splats: export it again")
    return expected


def _parse_header(data: bytes, versions: tuple[int, ...]) -> _SpzHeader:
    if len(data) < _HEADER.size:
        raise _truncated_header(data)
    magic, version, count, degree, bits, flags, _ = _HEADER.unpack(data[: _HEADER.size])
    if magic != _MAGIC:
        raise InputError(f"expected gzip of a header that starts with NGSP, got {data[:4]!r}: export it again as .spz")
    if version not in versions:
        raise InputError(
            f"expected version 1 to 4 of the format, got {version}: convert it with 'splat-transform IN.spz OUT.ply' of"
            " PlayCanvas"
        )
    if degree > _MAX_DEGREE or bits > _MAX_FRACTIONAL_BITS:
        raise InputError(
            f"expected harmonics of degree 0 to {_MAX_DEGREE} and at most {_MAX_FRACTIONAL_BITS} fractional bits, got"
            f" {degree} and {bits}: export the file again"
        )
    if not count:
        raise InputError("expected at least one splat, got 0: export the file again")
    return _SpzHeader(version, count, degree, bits, flags)


def _truncated_header(data: bytes) -> InputError:
    return InputError(f"truncated: got {len(data)} bytes of a header: copy or export the file again")


# ---- values -------------------------------------------------------------------------------------------------------


def _positions(stored: NDArray[np.uint8], header: _SpzHeader) -> FloatArray:
    if header.version == 1:
        return np.ascontiguousarray(stored).view("<f2").astype(np.float64)
    low, middle, high = (stored.reshape(-1, 3, 3)[:, :, k].astype(np.int32) for k in range(3))
    fixed = low | middle << 8 | high.astype(np.uint8).view(np.int8).astype(np.int32) << 16
    return fixed / float(1 << header.fractional_bits)


def _quaternions(stored: NDArray[np.uint8]) -> FloatArray:
    """Return quaternions (N, 4), w first, from three bytes (x, y, z) or from the smallest three of four numbers."""
    if stored.shape[1] == 3:
        xyz = stored / 127.5 - 1
        w = np.sqrt(np.maximum(0, 1 - np.square(xyz).sum(axis=1)))
        return np.column_stack([w, xyz])
    packed = np.ascontiguousarray(stored).view("<u4")[:, 0].astype(np.uint32)
    largest = packed >> 30
    fields = np.stack([packed >> shift & 1023 for shift in (20, 10, 0)], axis=1)
    small = (fields & 511) / 511 * np.sqrt(0.5) * np.where(fields >> 9, -1.0, 1.0)
    rows = np.arange(len(packed))
    xyzw = np.empty((len(packed), 4))
    for k in range(3):  # the stored ones are in the order x, y, z, w without the largest
        xyzw[rows, k + (k >= largest)] = small[:, k]
    xyzw[rows, largest] = np.sqrt(np.maximum(0, 1 - np.square(small).sum(axis=1)))
    return xyzw[:, [3, 0, 1, 2]]


# ---- writer -------------------------------------------------------------------------------------------------------


def write_spz(path: Path, cloud: Cloud, warn: Warn) -> None:
    """Write a cloud of splats as version 3, with the quantisation of the library, and warn of what is lost.

    Raises:
        InputError: the cloud has no splats, or is too far from the origin for their size.
        OSError: the file cannot be written; an existing file is then unchanged.
    """
    model = model_to_write(cloud)
    bits = _fractional_bits(cloud.points, float(np.median(model.largest_axes)))
    degree = min(model.sh_degree or 0, _MAX_WRITTEN_DEGREE)
    others = {"the normals": cloud.normals, "the crs": cloud.crs, "the unit": cloud.unit}
    others |= {name: values for name, values in cloud.attributes.items() if not is_splat_attribute(name)}
    if model.sh_degree != degree:
        others[f"harmonics above degree {degree}"] = cloud.points
    if line := left_out_warning("SPZ", others):
        warn(line)
    warn(
        f"values are rounded: coordinates to {0.5**bits:.2g}, axes by {np.expm1(0.5 / _LOG_SCALE_STEPS):.0%} at most,"
        f" opacities and colours to 8 bits, rotations to 10 bits{', harmonics to 5 and 4 bits' if degree else ''}"
    )
    flat = np.zeros((len(cloud), 3 - model.dimensions))  # discs get the smallest axis that the format stores
    quaternions = rotations_of(cloud) * [1, *(_AXES.prod() * _AXES)]
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
        log_scales = np.log(np.column_stack([model.axes, flat]))
        parts: list[NDArray[Any]] = [
            _fixed(cloud.points * _AXES, bits),
            to_bytes(255 * model.opacities),
            to_bytes(255 * (_COLOR_SCALE * dc_coefficients(cloud) + 0.5)),
            to_bytes(_LOG_SCALE_STEPS * (log_scales - _LEAST_LOG_SCALE)),
            _smallest_three(quaternions),
            _harmonics(cloud, degree, model.sh_degree),
        ]
    packer = zlib.compressobj(wbits=16 + zlib.MAX_WBITS)
    with atomic_write(path) as file:
        file.write(packer.compress(_HEADER.pack(_MAGIC, 3, len(cloud), degree, bits, 0, 0)))
        for part in parts:
            file.write(packer.compress(part.tobytes()))
        file.write(packer.flush())


def _fractional_bits(points: FloatArray, axis: float) -> int:
    """Return the largest number of fractional bits, 12 at most, with which 24 bits hold all coordinates.

    Args:
        points: (N, 3) coordinates.
        axis: length of a typical splat; if fewer bits round by more, the cloud is refused.
    """
    largest = float(np.abs(points).max())
    bits = min(_FRACTIONAL_BITS, _POSITION_BITS - 2 - int(np.floor(np.log2(max(largest, 1)))))
    if bits < 0 or (bits < _FRACTIONAL_BITS and 0.5**bits > axis):
        raise InputError(
            f"expected splats near the origin, got coordinates up to {largest:.6g}, which 24 bits round to"
            f" {2.0**-bits:g}, more than half of the splats measure ({axis:.2g}): {shift_advice(points)}"
        )
    return bits


def _fixed(points: FloatArray, bits: int) -> NDArray[np.uint8]:
    """Return coordinates as whole numbers of 24 bits (N, 9); halves go away from 0."""
    steps = points * float(1 << bits)
    rounded = np.sign(steps) * np.floor(np.abs(steps) + 0.5)
    most = 1 << (_POSITION_BITS - 1)  # which the largest coordinate may reach by rounding
    whole = rounded.clip(-most, most - 1).astype("<i4")
    return whole.view(np.uint8).reshape(-1, 3, 4)[:, :, :3].reshape(-1, 9)


def _smallest_three(wxyz: FloatArray) -> NDArray[np.uint32]:
    """Return unit quaternions as the index of the largest number (2 bits) and the others (a sign and 9 bits each)."""
    xyzw = wxyz[:, [1, 2, 3, 0]]
    largest = np.abs(xyzw).argmax(axis=1)
    rows = np.arange(len(xyzw))
    packed = largest.astype(np.uint32)
    negated = xyzw[rows, largest] < 0
    for k in range(3):
        values = xyzw[rows, k + (k >= largest)]
        magnitude = np.minimum(511, 511 * np.abs(values) / np.sqrt(0.5) + 0.5).astype(np.uint32)
        packed = packed << 10 | ((values < 0) ^ negated).astype(np.uint32) << 9 | magnitude
    words: NDArray[np.uint32] = packed.astype("<u4")
    return words


def _harmonics(cloud: Cloud, degree: int, stored_degree: int | None) -> NDArray[np.uint8]:
    """Return the coefficients of degrees 1 to `degree` (N, K, 3), rounded to steps in which 0 is exact."""
    if not degree or stored_degree is None:
        return np.empty((len(cloud), 0), np.uint8)
    count, stored = degree * (degree + 2), stored_degree * (stored_degree + 2)
    values = stack_columns(cloud, [f"f_rest_{k}" for k in range(3 * stored)]).reshape(-1, 3, stored)[:, :, :count]
    signed = np.nan_to_num(values.transpose(0, 2, 1) * _SH_SIGNS[:count, None])
    steps = _SH_STEPS[:count, None]
    scaled = 128 * signed.clip(-2, 2)
    whole = np.sign(scaled) * np.floor(np.abs(scaled) + 0.5) + 128
    rounded: NDArray[np.uint8] = (np.floor((whole + steps // 2) / steps) * steps).clip(0, 255).astype(np.uint8)
    return rounded
