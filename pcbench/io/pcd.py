"""Read and write PCD 0.7 of the Point Cloud Library: ascii, binary and binary_compressed.

As for PLY, the sizes in the header are checked against the file. Specification: "The PCD (Point Cloud Data) file
format", in the documentation of the Point Cloud Library.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from pcbench.errors import InputError
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cloud import Cloud
from pcbench.io import lzf
from pcbench.io.columns import as_integers, excerpt, packed_rows, parse_rows, plain_type
from pcbench.io.files import MAX_PADDING, Fields, Warn, check_end, read_rest, with_line_feeds
from pcbench.io.names import (
    PACKED_COLORS,
    XYZ,
    Columns,
    left_out_warning,
    repeated_name,
    standard_names,
    stored_attributes,
    take_fields,
    take_points,
)
from pcbench.scratch import atomic_write

_MAX_HEADER_BYTES = 1 << 20
_MAX_VALUES = 10_000  # per point, each of which becomes an attribute; the longest descriptors of PCL have 1,980
_KEYS = ("VERSION", "FIELDS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "VIEWPOINT", "POINTS", "DATA")
_TYPES = {f"{kind.upper()}{size}": f"<{kind}{size}" for kind in "iu" for size in (1, 2, 4, 8)}
_TYPES |= {"F4": "<f4", "F8": "<f8"}
_IDENTITY = "0 0 0 1 0 0 0"  # viewpoint: translation, and rotation as a quaternion wxyz
_DATA_KINDS = ("ascii", "binary", "binary_compressed")
_PCL_NORMALS = ("normal_x", "normal_y", "normal_z")

Fieldwise = dict[str, NDArray[Any]]  # columns (N, count) of fields


@dataclass(frozen=True)
class _Field:
    """Field of `count` numbers of one type per point; padding is named "_"."""

    name: str
    dtype: np.dtype[Any]
    count: int

    @property
    def size(self) -> int:
        return self.dtype.itemsize * self.count


@dataclass(frozen=True)
class _PcdHeader:
    fields: list[_Field]
    count: int
    area: int  # width times height, which should be the count
    data: str
    viewpoint: str

    @property
    def values(self) -> int:
        return sum(field.count for field in self.fields)

    @property
    def point_bytes(self) -> int:
        return sum(field.size for field in self.fields)

    def truncation_error(self, complete: int) -> InputError:
        return InputError(f"truncated: got {complete} of {self.count} points: copy or export the file again")


def read_pcd(path: Path, warn: Warn) -> Fields:
    """Read the points of a PCD file: x y z, normals, colours or packed rgb or rgba; the rest are attributes.

    A field of several numbers becomes attributes "name[0]", "name[1]". The alpha of rgba is left out. Coordinates of an
    ascii file keep all digits. Points are returned as stored: the viewpoint is not applied.

    Raises:
        InputError: the file is not a complete PCD file with at least one point.
        OSError: the file cannot be read.
    """
    with path.open("rb") as file:
        lines = with_line_feeds(file, _MAX_HEADER_BYTES + 1)
        header = _read_header(lines)
        file.seek(lines.tell())
        body = read_rest(file)
    header = _with_true_count(header, body, warn)
    if not _is_identity(header.viewpoint):
        warn(f"the viewpoint {header.viewpoint[:80]!r} was not applied")
    with np.errstate(invalid="ignore", over="ignore"):
        if header.data == "ascii":
            fields = _ascii_columns(body.tobytes(), header, warn)
        elif header.data == "binary":
            fields = _binary_columns(body, header, warn)
        else:
            fields = _decompressed_columns(body, header, warn)
        columns = _split_fields(fields)
        points = take_points(columns)
        normals, colors, attributes = take_fields(columns, warn)
    return Fields(points=points, normals=normals, colors=colors, attributes=attributes)


def _with_true_count(header: _PcdHeader, body: NDArray[np.uint8], warn: Warn) -> _PcdHeader:
    """Return the header with the number of points that the body has, if POINTS is not WIDTH x HEIGHT."""
    if header.count == header.area:
        return header
    if header.data == "ascii":
        stored = sum(bool(line.strip()) for line in body.tobytes().splitlines())
    elif header.data == "binary":
        stored = len(body) // header.point_bytes
    else:
        stored = int(body[4:8].view("<u4")[0]) // header.point_bytes if len(body) >= 8 else 0
    if stored not in (header.count, header.area):
        raise InputError(
            f"header: expected POINTS {header.area} (WIDTH x HEIGHT), got {header.count}: export the file again"
        )
    warn(f"the header states {header.count} points, but WIDTH x HEIGHT is {header.area}: read {stored}")
    return replace(header, count=stored, area=stored)


def _is_identity(viewpoint: str) -> bool:
    try:
        return [float(word) for word in viewpoint.split()] == [0, 0, 0, 1, 0, 0, 0]
    except ValueError:
        return False


def _split_fields(fields: Fieldwise) -> Columns:
    """Return columns (N,), those of a field of several numbers as "name[0]", "name[1]"."""
    columns: Columns = {}
    for name, values in fields.items():
        for k in range(values.shape[1]):
            column = values[:, k]
            key = name if values.shape[1] == 1 else f"{name}[{k}]"
            columns[key] = np.ascontiguousarray(column, dtype=column.dtype.newbyteorder("="))
    return dict(zip(standard_names(list(columns)), columns.values(), strict=True))


# ---- header -------------------------------------------------------------------------------------------------------


def _read_header(file: BinaryIO) -> _PcdHeader:
    """Read the header including the DATA line, so that the file position is at the body."""
    entries: dict[str, list[str]] = {}
    used = 0
    while "DATA" not in entries:
        line = file.readline(_MAX_HEADER_BYTES - used + 1)
        used += len(line)
        if used > _MAX_HEADER_BYTES:
            raise InputError(
                f"expected a DATA line within {_MAX_HEADER_BYTES} header bytes, got none: export the file again"
            )
        if not line:
            raise InputError(
                "expected a PCD header (VERSION, FIELDS, SIZE, TYPE, ...), got no DATA line: export it again"
            )
        words = line.decode("latin-1").split()
        if not words or words[0].startswith("#"):
            continue
        key = words[0].upper()
        if key == "COLUMNS":  # an old name
            key = "FIELDS"
        if key not in _KEYS or not line.isascii() or not " ".join(words).isprintable():
            raise InputError(
                f"header: expected a line that starts with one of {', '.join(_KEYS)}; got {excerpt(line)}"
                ": export it again"
            )
        if key in entries:
            raise InputError(f"header: expected one {key} line, got two: export the file again")
        entries[key] = words[1:]

    if missing := [key for key in ("FIELDS", "SIZE", "TYPE") if not entries.get(key)]:
        raise InputError(f"header: expected {', '.join(missing)}, got no such line: export the file again")
    names = _field_names(entries["FIELDS"])
    counts = entries.get("COUNT", ["1"] * len(names))
    for key, words in (("SIZE", entries["SIZE"]), ("TYPE", entries["TYPE"]), ("COUNT", counts)):
        if len(words) != len(names):
            raise InputError(
                f"header: expected {len(names)} values in {key}, one per field, got {len(words)}: export it again"
            )
    fields = [
        _field(name, kind + size, count)
        for name, kind, size, count in zip(names, entries["TYPE"], entries["SIZE"], counts, strict=True)
    ]
    _check_fields(fields)
    width, height = _single_count(entries, "WIDTH"), _single_count(entries, "HEIGHT")
    count = _single_count(entries, "POINTS") if "POINTS" in entries else width * height
    area = width * height if "WIDTH" in entries else count
    if not count:
        raise InputError("expected at least one point, got POINTS 0: export the file again")
    if len(entries["DATA"]) != 1 or entries["DATA"][0].lower() not in _DATA_KINDS:
        raise InputError(
            f"header: expected DATA {', '.join(_DATA_KINDS)}; got {' '.join(entries['DATA'])[:40]!r}: export it again"
        )
    viewpoint = " ".join(entries.get("VIEWPOINT", [_IDENTITY]))
    return _PcdHeader(fields, count, area, entries["DATA"][0].lower(), viewpoint)


def _single_count(entries: dict[str, list[str]], key: str) -> int:
    words = entries.get(key, ["1"])
    return _parse_count(words[0] if len(words) == 1 else " ".join(words), key)


def _parse_count(word: str, key: str) -> int:
    if not word.isdigit() or len(word) > 18:
        raise InputError(f"header: expected {key} as an integer, got {word[:40]!r}: export the file again")
    return int(word)


def _field(name: str, code: str, count: str) -> _Field:
    if code.upper() not in _TYPES:
        raise InputError(
            f"header: expected type and size {', '.join(_TYPES)}; got {code[:40]!r} for {name[:40]!r}: export it again"
        )
    return _Field(name, np.dtype(_TYPES[code.upper()]), _parse_count(count, "COUNT"))


def _field_names(words: list[str]) -> list[str]:
    """Return the standard names of the fields; "_" is padding."""
    names = [word for word in words if word != "_"]
    if twice := repeated_name(names):
        raise InputError(f"header: expected unique field names, got {twice[:40]!r} twice: rename one of them")
    standard = iter(standard_names(names))
    return [word if word == "_" else next(standard) for word in words]


def _check_fields(fields: list[_Field]) -> None:
    names = [field.name for field in fields if field.name != "_"]
    if missing := [name for name in XYZ if name not in names]:
        raise InputError(
            f"expected fields x, y, z; missing: {', '.join(missing)} in {' '.join(names)[:100]}: export it with"
            " coordinates"
        )
    if (values := sum(field.count for field in fields if field.name != "_")) > _MAX_VALUES:
        raise InputError(f"header: expected at most {_MAX_VALUES} values per point, got {values}: leave out fields")
    for field in fields:
        if not field.count or (field.name in XYZ + PACKED_COLORS and field.count != 1):
            raise InputError(f"header: expected COUNT 1 for {field.name[:40]!r}, got {field.count}: export it again")


# ---- body ---------------------------------------------------------------------------------------------------------


def _binary_columns(body: NDArray[np.uint8], header: _PcdHeader, warn: Warn) -> Fieldwise:
    """Return columns (N, count) as views: the body stores point after point."""
    if len(body) < header.count * header.point_bytes:
        raise header.truncation_error(len(body) // header.point_bytes)
    _check_end(body, header.count * header.point_bytes, header, warn)
    columns: Fieldwise = {}
    offset = 0
    for field in header.fields:
        if field.name != "_":
            shape, strides = (header.count, field.count), (header.point_bytes, field.dtype.itemsize)
            columns[field.name] = np.ndarray(shape, field.dtype, body.data, offset, strides)
        offset += field.size
    return columns


def _check_end(body: NDArray[np.uint8], end: int, header: _PcdHeader, warn: Warn) -> None:
    """Check the bytes after the points, which end at a byte of the body."""
    rest = body[end : end + MAX_PADDING].tobytes()
    check_end(rest, len(body) - end, header.point_bytes, "the last point", warn)


def _decompressed_columns(body: NDArray[np.uint8], header: _PcdHeader, warn: Warn) -> Fieldwise:
    """Return columns (N, count) as views: the body stores field after field, compressed together."""
    total = header.count * header.point_bytes
    if len(body) < 8:
        raise header.truncation_error(0)
    packed, unpacked = struct.unpack("<II", body[:8].tobytes())
    if unpacked != total:
        raise InputError(
            f"expected {total} bytes for {header.count} points, the body states {unpacked}: export it again"
        )
    if packed > len(body) - 8:
        raise InputError(f"truncated: got {len(body) - 8} of {packed} compressed bytes: copy or export the file again")
    if unpacked > packed * lzf.MAX_GROWTH:
        raise InputError(f"damaged LZF data: {packed} bytes cannot decompress to {unpacked}: export the file again")
    _check_end(body, 8 + packed, header, warn)
    data = lzf.decompress(body[8 : 8 + packed].tobytes(), total)
    columns: Fieldwise = {}
    offset = 0
    for field in header.fields:
        if field.name != "_":
            columns[field.name] = np.ndarray((header.count, field.count), field.dtype, data, offset)
        offset += field.size * header.count
    return columns


def _ascii_columns(text: bytes, header: _PcdHeader, warn: Warn) -> Fieldwise:
    """Return columns (N, count) in their types; coordinates in float64."""
    if header.count * header.values * 2 - 1 > len(text):  # at least a digit and a separator per value
        raise header.truncation_error(min(len(text.splitlines()), header.count - 1))
    lines = [line for line in text.splitlines() if line.strip()]
    if len(lines) < header.count:
        raise header.truncation_error(len(lines))
    rest = b"\n".join(lines[header.count :])
    check_end(rest[:MAX_PADDING], len(rest), 2 * header.values - 1, f"{header.count} points", warn)
    del lines[header.count :]
    table = parse_rows(lines, header.values, _place)
    columns: Fieldwise = {}
    offset = 0
    for field in header.fields:
        values = table[:, offset : offset + field.count]
        if field.name in XYZ:
            columns[field.name] = values
        elif field.name != "_":
            columns[field.name] = _typed(values, lines, offset, field)
        offset += field.count
    return columns


def _typed(values: FloatArray, lines: list[bytes], offset: int, field: _Field) -> NDArray[Any]:
    """Convert the numbers of a field (N, count) to its type."""
    if field.dtype.kind == "f":
        return values.astype(field.dtype)
    typed = as_integers(values, field.dtype, field.name, field.dtype.name, _place)
    if field.dtype.itemsize < 8 or np.abs(values).max() < 2**53:
        return typed
    try:  # float64 has rounded them
        words = [line.split()[offset : offset + field.count] for line in lines]
        return np.array([[int(word) for word in row] for row in words], dtype=field.dtype)
    except (ValueError, OverflowError):
        raise InputError(
            f"expected {field.name!r} as {field.dtype.name}, got another number: export it again"
        ) from None


def _place(row: int) -> str:
    return f"point {row + 1}"


# ---- writer -------------------------------------------------------------------------------------------------------


def write_pcd(path: Path, cloud: Cloud, warn: Warn) -> None:
    """Write binary PCD: x y z, normals as float, packed rgb, attributes in their type. PCD cannot store crs and unit.

    Coordinates are float if that is exact, else double: PCL and Open3D only support float points (Open3D reads doubles
    as zeros), but float is off by 0.1 m and more at UTM coordinates.

    Raises:
        InputError: an attribute does not consist of numbers.
        OSError: the file cannot be written; an existing file is then unchanged.
    """
    with np.errstate(over="ignore"):
        floats = cloud.points.astype(np.float32)
    points = floats if np.array_equal(floats, cloud.points) else cloud.points
    columns: Columns = {name: points[:, axis] for axis, name in enumerate(XYZ)}
    if cloud.normals is not None:
        columns |= {name: cloud.normals[:, axis].astype("<f4") for axis, name in enumerate(_PCL_NORMALS)}
    if cloud.colors is not None:
        red, green, blue = cloud.colors.T.astype(np.uint32)
        columns["rgb"] = red << 16 | green << 8 | blue
    attributes = stored_attributes(cloud.attributes, "PCD", warn, reserved={*columns, *PACKED_COLORS, "_"})
    columns |= {name: plain_type(values) for name, values in attributes.items()}
    if line := left_out_warning("PCD", {"the crs": cloud.crs, "the unit": cloud.unit}):
        warn(line)
    dtypes = [column.dtype for column in columns.values()]
    lines = {
        "VERSION": "0.7",
        "FIELDS": " ".join(columns),
        "SIZE": " ".join(str(dtype.itemsize) for dtype in dtypes),
        "TYPE": " ".join(dtype.kind.upper() for dtype in dtypes),
        "COUNT": " ".join("1" for _ in dtypes),
        "WIDTH": str(len(cloud)),
        "HEIGHT": "1",
        "VIEWPOINT": _IDENTITY,
        "POINTS": str(len(cloud)),
        "DATA": "binary",
    }
    with atomic_write(path) as file:
        file.write("".join(f"{key} {value}\n" for key, value in lines.items()).encode())
        file.write(packed_rows(columns).view(np.uint8).data)
