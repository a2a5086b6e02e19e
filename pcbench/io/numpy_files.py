"""Read and write NumPy files: .npy with points (N, 3), (N, 4) or (N, 6), or with named fields; .npz with named arrays.

numpy parses only the array header. The size in the header is compared with the file size before memory is allocated.
Only numbers and texts are read, never pickles.
"""

from __future__ import annotations

import errno
import struct
import zlib
from collections.abc import Iterable
from dataclasses import dataclass
from io import BytesIO
from math import prod
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pcbench.errors import InputError
from pcbench.geometry.cloud import Cloud
from pcbench.io.files import MAX_PADDING, Fields, Warn, check_end
from pcbench.io.names import (
    COLORS,
    NORMALS,
    XYZ,
    Columns,
    are_colors,
    left_out_warning,
    scale_colors,
    standard_names,
    stored_attributes,
    take_fields,
    take_points,
)
from pcbench.scratch import atomic_write

if TYPE_CHECKING:
    from zipfile import ZipFile, ZipInfo

_MAX_HEADER_BYTES = 10_000  # numpy's own limit: Python's parser may crash on longer ones; typical arrays have 118
_MAX_DIMENSION = 10**18  # more than any file stores; numpy's products of the shape stay within int64
# Bound of the decompressed size: this factor times the file size, plus bytes. Coordinates shrink 2 to 20 times.
_MAX_GROWTH, _MAX_FREE_GROWTH_BYTES = 200, 16 << 20
_TEXT_NAMES = ("crs", "unit")
# Other names of arrays, as in libraries for point clouds and meshes.
_ARRAY_NAMES = {
    "points": ("xyz", "positions", "position", "pos", "vertices", "coords", "coordinates"),
    "normals": ("normal",),
    "colors": ("color", "colours", "colour", "rgb"),
}
_WIDTHS = {"normals": (3,), "colors": (3, 4)}  # alpha is left out


@dataclass(frozen=True)
class _Header:
    """Array header and its length in bytes."""

    dtype: np.dtype[Any]
    fortran_order: bool
    shape: tuple[int, ...]
    header_bytes: int

    @property
    def rows(self) -> int:
        return self.shape[0] if self.shape else 1

    @property
    def data_bytes(self) -> int:
        return prod(self.shape) * self.dtype.itemsize

    @property
    def row_bytes(self) -> int:
        return max(self.data_bytes // max(self.rows, 1), 1)


def read_npy(path: Path, warn: Warn) -> Fields:
    """Read points (N, 3), with intensity (N, 4), or with normals or colours (N, 6), of any float or integer type.

    The last three of six columns are colours if most have no unit length and they fit a scale of `names.scale_colors`.
    An array (N,) may have named fields of these types, as PDAL's have: x, y, z and others with the names of
    `names.standard_names`.

    Raises:
        InputError: the file is not a complete array of that shape.
        OSError: the file cannot be read.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        header = _read_header(file)
        _check_points(header)
        _check_size(header, size)
        array = _read_data(file, header, size, "the array", warn)
        if array.dtype.names:
            return _fields_of({name: _plain(array[name]) for name in array.dtype.names}, warn)
        return _points_fields(array)


def read_npz(path: Path, warn: Warn) -> Fields:
    """Read arrays `points` (N, 3), (N, 4) or (N, 6), `normals` and `colors` (N, 3); other (N,) arrays are attributes.

    Colours may have any scale of `names.scale_colors`, and the arrays other usual names, such as `xyz` and `rgb`.
    `crs` and `unit` are texts. In an archive with one array, that array is the points, whatever its name. Arrays of
    other shapes are left out with a warning. Instead of points, an archive may have arrays x, y and z (N,).

    Raises:
        InputError: the archive is damaged, contains no points, or would decompress to an implausible size.
        OSError: the file cannot be read.
    """
    import zipfile

    try:
        with zipfile.ZipFile(path) as archive:
            return _read_archive(archive, path.stat().st_size, warn)
    except InputError:  # also a ValueError, but its message is complete
        raise
    # Errors that zipfile raises on damaged archives, found by reading its code and by fuzzing.
    except (zipfile.BadZipFile, zlib.error, EOFError, struct.error, ValueError, OverflowError) as error:
        raise InputError(f"damaged archive: {error}: copy or export the file again") from error
    except OSError as error:
        if error.errno != errno.EINVAL:
            raise
        raise InputError("damaged archive: an entry lies outside it: copy or export the file again") from error
    except (NotImplementedError, RuntimeError) as error:
        raise InputError(f"expected a plain zip archive, got: {error}: save it with numpy.savez") from error


def _read_archive(archive: ZipFile, archive_bytes: int, warn: Warn) -> Fields:
    members = _members(archive, archive_bytes)
    texts = {name: _read_text(archive, members.pop(name), name, warn) for name in _TEXT_NAMES if name in members}
    for name, others in _ARRAY_NAMES.items():
        if name not in members and (similar := next((other for other in others if other in members), None)):
            members[name] = members.pop(similar)
    key = "points" if "points" in members or len(members) != 1 else next(iter(members))
    if key not in members and set(XYZ) <= set(standard_names(list(members))):
        return _read_columns(archive, members, warn) | Fields(crs=texts.get("crs"), unit=texts.get("unit"))
    if key not in members:
        raise InputError(f"expected an array 'points', got {_list_names(members)}: save the points under that name")

    headers = {name: _member_header(archive, info, name) for name, info in members.items()}
    _check_points(headers[key])
    count = headers[key].shape[0]
    for name, header in headers.items():
        shapes = [(count, width) for width in _WIDTHS.get(name, ())]
        if shapes and name != key and header.shape not in shapes:
            raise InputError(f"expected {name} of shape ({count}, 3), got {header.shape}: save one row per point")
    arrays: dict[str, NDArray[Any]] = {}
    for name, header in headers.items():
        if name in (key, "normals", "colors") or header.shape == (count,):
            with archive.open(members[name]) as file:
                file.read(header.header_bytes)  # after a seek, zipfile would not verify the check sum
                arrays[name] = _read_data(file, header, members[name].file_size, f"array {name[:40]!r}", warn)
        else:
            warn(f"left out {name!r}: expected an attribute of shape ({count},), got {header.shape}")
    fields = _points_fields(arrays.pop(key))
    fields["normals"] = arrays.pop("normals", fields.get("normals"))
    fields["colors"] = _scaled(arrays.pop("colors")) if "colors" in arrays else fields.get("colors")
    known_names = standard_names(list(arrays), taken=(*XYZ, *NORMALS, *COLORS))
    fields["attributes"] = {
        **fields.get("attributes", {}),
        **dict(zip(known_names, arrays.values(), strict=True)),
    }
    fields["crs"] = texts.get("crs")
    fields["unit"] = texts.get("unit")
    return fields


def _read_columns(archive: ZipFile, members: dict[str, ZipInfo], warn: Warn) -> Fields:
    """Read an archive of columns (N,)."""
    columns: Columns = {}
    for name, info in members.items():
        header = _member_header(archive, info, name)
        if len(header.shape) != 1:
            raise InputError(f"expected arrays of shape (N,) beside x, y, z, got {name[:40]!r} of another: remove it")
        with archive.open(info) as file:
            file.read(header.header_bytes)
            columns[name] = _read_data(file, header, info.file_size, f"array {name[:40]!r}", warn)
    if len({len(column) for column in columns.values()}) > 1:
        lengths = ", ".join(f"{len(column)} of {name[:40]!r}" for name, column in list(columns.items())[:6])
        raise InputError(f"expected arrays of one length, got {lengths}: save one value per point")
    return _fields_of(columns, warn)


def _fields_of(columns: Columns, warn: Warn) -> Fields:
    """Return the fields of a cloud from columns (N,) with any of the usual names."""
    named = dict(zip(standard_names(list(columns)), columns.values(), strict=True))
    if not len(named["x"]):
        raise InputError("expected at least one point, got 0: save a cloud with points")
    with np.errstate(invalid="ignore", over="ignore"):
        points = take_points(named)
        normals, colors, attributes = take_fields(named, warn)
    return Fields(points=points, normals=normals, colors=colors, attributes=attributes)


def _scaled(colors: NDArray[Any]) -> NDArray[np.uint8]:
    scaled = scale_colors(list(colors.T[:3]))
    if scaled is None:
        raise InputError(
            f"expected colors from 0 to 1, 255 or 65535, got {colors.min():g} to {colors.max():g} as {colors.dtype}:"
            " convert them to uint8"
        )
    return scaled


def _list_names(names: Iterable[str]) -> str:
    return ", ".join(repr(name[:40]) for name in sorted(names)[:10]) or "none"


def _members(archive: ZipFile, archive_bytes: int) -> dict[str, ZipInfo]:
    """Return members by array name, after checking that the total decompressed size is plausible."""
    unpacked = sum(info.file_size for info in archive.infolist())
    if unpacked > _MAX_FREE_GROWTH_BYTES + _MAX_GROWTH * archive_bytes:
        raise InputError(f"{archive_bytes} bytes would decompress to {unpacked} bytes: save it with numpy.savez")
    members: dict[str, ZipInfo] = {}
    for info in archive.infolist():
        name = info.filename.removesuffix(".npy")
        if name == info.filename:
            raise InputError(f"expected arrays (.npy) in the archive, got {name[:40]!r}: save it with numpy.savez")
        if name in members:
            raise InputError(f"expected unique array names, got {name[:40]!r} twice: save it with numpy.savez")
        if info.flag_bits & 1 or info.compress_type not in (0, 8):
            got = "an encrypted one" if info.flag_bits & 1 else f"zip method {info.compress_type}"
            raise InputError(f"expected a stored or deflated archive, got {got}: save it with numpy.savez")
        members[name] = info
    return members


def _member_header(archive: ZipFile, info: ZipInfo, name: str) -> _Header:
    with archive.open(info) as file:
        try:
            header = _read_header(file)
            _check_size(header, info.file_size)
        except InputError as error:
            raise InputError(f"array {name[:40]!r}: {error}") from error
        if header.dtype.names:
            raise InputError(f"array {name[:40]!r}: expected plain numbers, got named fields: save it as .npy")
        return header


def _read_text(archive: ZipFile, info: ZipInfo, name: str, warn: Warn) -> str | None:
    with archive.open(info) as file:
        header = _read_header(file, kinds="U")
        _check_size(header, info.file_size)
        if header.shape != ():
            raise InputError(f"expected {name!r} as a text, got an array of shape {header.shape}: save a string")
        if not header.data_bytes:
            return None
        # Not with numpy's str, which raises SystemError on an invalid code point; decode raises ValueError.
        codes = _read_data(file, header, info.file_size, f"text {name!r}", warn).reshape(1).view(np.uint32)
        return codes.astype("<u4").tobytes().decode("utf-32-le").rstrip("\0") or None


def _check_points(header: _Header) -> None:
    if header.dtype.names:
        if len(header.shape) != 1 or not set(XYZ) <= set(standard_names(header.dtype.names)):
            raise InputError(
                f"expected fields x, y, z in an array of shape (N,), got {', '.join(header.dtype.names)[:80]} in"
                f" {header.shape}: name the coordinates"
            )
        return
    if len(header.shape) != 2 or header.shape[1] not in (3, 4, 6):
        raise InputError(
            f"expected points of shape (N, 3), (N, 4) with intensity or (N, 6) with normals; got {header.shape}:"
            " reshape them"
        )
    if header.dtype.kind not in "fiu":
        raise InputError(f"expected points as floats or integers, got {header.dtype}: convert them")
    if not header.shape[0]:
        raise InputError("expected at least one point, got 0: save a cloud with points")


def _check_size(header: _Header, size: int) -> None:
    if (available := size - header.header_bytes) < header.data_bytes:
        complete = available // header.row_bytes
        raise InputError(f"truncated: got {complete} of {header.rows} rows: copy or export the file again")


def _points_fields(array: NDArray[Any]) -> Fields:
    with np.errstate(invalid="ignore", over="ignore"):
        points = array.astype(np.float64, copy=False)
    if points.shape[1] == 3:
        return Fields(points=points)
    if points.shape[1] == 4:  # as in the data sets for driving; the attribute keeps its type
        return Fields(points=points[:, :3], attributes={"intensity": array[:, 3].copy()})
    if are_colors(points[:, 3:]):
        return Fields(points=points[:, :3], colors=scale_colors(list(points[:, 3:].T)))
    return Fields(points=points[:, :3], normals=points[:, 3:])


def _read_header(file: IO[bytes], kinds: str = "fiub") -> _Header:
    """Parse the header of an array in format version 1 or 2, and leave the file at its data."""
    head = BytesIO(file.read(_MAX_HEADER_BYTES))  # numpy requests all the bytes that a damaged header states
    try:
        # Version 3 is only needed for field names that are not Latin.
        parsers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
        parse = parsers[np.lib.format.read_magic(head)]
        shape, fortran_order, dtype = parse(head, max_header_size=_MAX_HEADER_BYTES)
        if dtype.subdtype or not all(0 <= size < _MAX_DIMENSION for size in shape):
            raise ValueError
    except Exception as error:  # numpy's ValueError, another version, any error of Python's parser on damaged text
        got = head.getvalue()[:70]
        raise InputError(f"expected an array of numbers as numpy.save writes it, got {got!r}: save it again") from error
    if dtype.names:
        types = [dtype[name] for name in dtype.names]
        if kinds == "U" or not all(each.kind in kinds and each.shape == () for each in types):
            listed = ", ".join(dtype.names)[:80]
            raise InputError(f"expected fields of plain numbers, got {listed}: save the points as (N, 3)")
    elif dtype.kind not in kinds:
        raise InputError(f"expected {'a text' if kinds == 'U' else 'floats or integers'}, got type {dtype.str!r}")
    file.seek(head.tell())
    return _Header(dtype, fortran_order, shape, head.tell())


def _read_data(file: IO[bytes], header: _Header, size: int, what: str, warn: Warn) -> NDArray[Any]:
    """Read the array, C-contiguous and in native byte order, and check the rest of the file, whose size is known.

    Reading beyond the array makes zipfile verify the checksum.
    """
    data, rest = file.read(header.data_bytes), file.read(MAX_PADDING)
    if len(data) < header.data_bytes:
        raise InputError(f"truncated: got {len(data)} of {header.data_bytes} bytes: copy or export the file again")
    check_end(rest, size - header.header_bytes - header.data_bytes, header.row_bytes, what, warn)
    # Bytes other than 0 and 1 are not valid bools.
    values = np.frombuffer(data, np.uint8 if header.dtype.kind == "b" else header.dtype)
    values = values.reshape(header.shape, order="F" if header.fortran_order else "C")
    if header.dtype.kind == "b":
        values = values != 0
    return np.ascontiguousarray(values, dtype=header.dtype.newbyteorder("=")).reshape(header.shape)


def _plain(column: NDArray[Any]) -> NDArray[Any]:
    """Return a field (N,) of an array of records as a separate array."""
    plain = np.ascontiguousarray(column)
    return plain.view(np.uint8) != 0 if plain.dtype.kind == "b" else plain


def write_npy(path: Path, cloud: Cloud, warn: Warn) -> None:
    """Write only the points, (N, 3) float64; a warning lists what else the cloud has.

    Raises:
        OSError: the file cannot be written; an existing file is then unchanged.
    """
    others = {"the normals": cloud.normals, "the colours": cloud.colors, "the crs": cloud.crs, "the unit": cloud.unit}
    if line := left_out_warning(".npy", {**others, **cloud.attributes}):
        warn(line)
    with atomic_write(path) as file:
        _write_array(file, cloud.points)


def write_npz(path: Path, cloud: Cloud, warn: Warn) -> None:
    """Write all data of a cloud: points, normals, colors, attributes under their names, crs and unit as texts.

    Raises:
        InputError: an attribute does not consist of numbers.
        OSError: the file cannot be written; an existing file is then unchanged.
    """
    from zipfile import ZipFile, ZipInfo

    standard_arrays = {"points": cloud.points, "normals": cloud.normals, "colors": cloud.colors}
    texts = {"crs": cloud.crs, "unit": cloud.unit}
    arrays = {name: array for name, array in standard_arrays.items() if array is not None}
    arrays |= {name: np.array(text) for name, text in texts.items() if text}
    reserved = {*standard_arrays, *texts}
    arrays |= stored_attributes(cloud.attributes, "NPZ", warn, reserved=reserved, forbidden=r"[^\w !-~]")
    with atomic_write(path) as file:
        with ZipFile(file, "w") as archive:
            for name, array in arrays.items():
                # A ZipInfo without the current time, so that the same cloud gives the same bytes.
                with archive.open(ZipInfo(f"{name}.npy"), "w", force_zip64=True) as member:
                    _write_array(member, array)


def _write_array(file: IO[bytes], array: NDArray[Any]) -> None:
    # Not numpy.save: on a full disk it reports "3 requested and 1 written" instead of "No space left on device".
    array = np.ascontiguousarray(array).reshape(array.shape)
    np.lib.format.write_array_header_1_0(file, np.lib.format.header_data_from_array_1_0(array))
    file.write(array.reshape(-1).view(np.uint8).data)
