"""Arrays of numbers in MATLAB files of version 5 to 7 (MAT-File Format, MathWorks 2024, chapter 1).

Other readers crash on damaged files. Cells, structures, text and sparse or complex arrays are not read.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.errors import InputError
from pcbench.io.files import errors_named
from pcbench.regular_files import read_bytes

_HEADER_BYTES, _VERSION, _VERSION_OF_HDF5 = 128, 0x0100, 0x0200
_MAX_FILE_BYTES = _MAX_UNPACKED_BYTES = 2 << 30
_NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_MATRIX, _COMPRESSED = 14, 15
_FIRST_NUMERIC_CLASS, _LAST_NUMERIC_CLASS, _COMPLEX = 6, 15, 0x0800
_MAX_AXES = 32


def read_matlab_arrays(path: Path, *names: str) -> list[NDArray[Any]]:
    """Read variables of a MATLAB file by their names, as arrays with two or more axes.

    Raises:
        InputError: the file is of another version, damaged, or lacks a variable that is an array of real numbers. The
            message starts with the path.
        OSError: it cannot be read.
    """
    with errors_named(path):
        content = memoryview(read_bytes(path, _MAX_FILE_BYTES))
        order = _byte_order(content)
        arrays: dict[str, NDArray[Any]] = {}
        try:
            for variable in _variables(content[_HEADER_BYTES:], order):
                if (array := _array(variable, order)) is not None and array.name in names:
                    arrays[array.name] = array.values
        except InputError:  # also a ValueError, but its message is complete
            raise
        except (ValueError, struct.error, zlib.error, OverflowError, UnicodeDecodeError):
            raise InputError("expected a MATLAB file, got a damaged one: download it again") from None
        for name in names:
            if name not in arrays:
                raise InputError(f"expected a variable {name} of real numbers, got none: name another file")
    return [arrays[name] for name in names]


class _Element(NamedTuple):
    """A data element: its type, its bytes, and those after it."""

    kind: int
    data: memoryview
    rest: memoryview


class _Array(NamedTuple):
    """A variable."""

    name: str
    values: NDArray[Any]


def _byte_order(content: memoryview) -> str:
    """Return the byte order as in `struct`, from the header."""
    orders = {b"IM": "<", b"MI": ">"}
    if len(content) < _HEADER_BYTES or (order := orders.get(bytes(content[126:128]))) is None:
        raise InputError("expected a MATLAB file of version 5 to 7, got other content")
    (version,) = struct.unpack_from(f"{order}H", content, 124)
    if version == _VERSION_OF_HDF5:
        raise InputError(
            "expected a MATLAB file of version 5 to 7, got version 7.3 (HDF5): save it with save(..., '-v7')"
        )
    if version != _VERSION:
        raise InputError(f"expected a MATLAB file of version 5 to 7, got version {version:#06x}")
    return order


def _variables(content: memoryview, order: str) -> Iterator[memoryview]:
    """Yield the content of each matrix, decompressed.

    Raises:
        InputError: all compressed ones together are larger than `_MAX_UNPACKED_BYTES`.
    """
    left = _MAX_UNPACKED_BYTES
    while len(content):
        element = _element(content, order)
        content = element.rest
        if element.kind == _COMPRESSED:
            stream = zlib.decompressobj()
            data = stream.decompress(element.data, left)
            left -= len(data)
            if left <= 0:
                raise InputError(f"expected variables of at most {_MAX_UNPACKED_BYTES >> 30} GiB, got more: save fewer")
            if not stream.eof:
                raise ValueError("incomplete")
            element = _element(memoryview(data), order)
        if element.kind == _MATRIX:
            yield element.data


def _array(matrix: memoryview, order: str) -> _Array | None:
    """Return the array in a matrix; None: it is of another kind."""
    flags = _element(matrix, order)
    (word,) = struct.unpack_from(f"{order}I", flags.data)
    if not _FIRST_NUMERIC_CLASS <= word & 0xFF <= _LAST_NUMERIC_CLASS or word & _COMPLEX:
        return None
    axes = _element(flags.rest, order)
    name = _element(axes.rest, order)
    stored = _element(name.rest, order)
    shape = np.frombuffer(axes.data, f"{order}i4")
    if stored.kind not in _NUMBERS or len(shape) > _MAX_AXES or (shape < 0).any():
        raise ValueError("expected numbers")
    values = np.frombuffer(stored.data, order + _NUMBERS[stored.kind])
    return _Array(bytes(name.data).decode("ascii"), values.reshape(tuple(map(int, shape)), order="F"))


def _element(content: memoryview, order: str) -> _Element:
    """Return the first data element; short ones have their size in the type, and others are padded to eight bytes."""
    kind, size = struct.unpack_from(f"{order}II", content)
    start, end = 8, 8 + size
    if kind >> 16:
        kind, start, end = kind & 0xFFFF, 4, 4 + (kind >> 16)
    if end > len(content):
        raise ValueError("truncated")
    after = end if kind == _COMPRESSED else -(-end // 8) * 8
    return _Element(kind, content[start:end], content[min(after, len(content)) :])
