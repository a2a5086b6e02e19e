"""Columns of numbers in the rows of files: lines of text, and binary rows of one size."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcbench.errors import InputError
from pcbench.geometry.arrays import FloatArray
from pcbench.io.names import Columns


def parse_rows(lines: Sequence[bytes], width: int, place_of: Callable[[int], str]) -> FloatArray:
    """Return the numbers in lines of text (N, width); float64 holds all types of less than 64 bits exactly.

    Args:
        lines: the lines, each with `width` numbers between blanks.
        width: number of values on each line.
        place_of: function from the index of a line to its name in messages, such as "point 3".

    Raises:
        InputError: a line has other values.
    """
    try:
        table = np.loadtxt(lines, dtype=np.float64, comments=None, ndmin=2)
        if table.shape == (len(lines), width):
            return table
    except ValueError:
        pass  # the loop finds the line
    for number, line in enumerate(lines):
        words = line.split()
        if not all(map(_is_number, words)):
            raise not_numbers_error(place_of(number), line)
        if len(words) != width:
            raise InputError(f"{place_of(number)}: expected {width} values, got {len(words)}: export the file again")
    raise InputError("expected lines of numbers, got other text: export the file again")


def not_numbers_error(place: str, line: bytes) -> InputError:
    """Return the error of a line that is not numbers."""
    return InputError(f"{place}: expected numbers, got {excerpt(line)}: export the file again")


def excerpt(line: bytes) -> str:
    """Return the start of a line, for an error message."""
    text = line.strip()
    return repr(text[:60])[1:] + ("..." if len(text) > 60 else "")


def as_integers(
    values: NDArray[Any], dtype: np.dtype[Any], name: str, type_name: str, place_of: Callable[[int], str]
) -> NDArray[Any]:
    """Return numbers from text, (N,) or (N, M), as integers.

    Raises:
        InputError: a row has another number; the message names it as `type_name` and the row by `place_of`.
    """
    integers = values.astype(dtype)
    if len(wrong := np.argwhere(integers != values)):
        row, value = int(wrong[0][0]), values[tuple(wrong[0])]
        raise InputError(f"{place_of(row)}: expected {name!r} as {type_name}, got {value:g}: export the file again")
    return integers


def plain_type(values: NDArray[Any]) -> NDArray[Any]:
    """Return numbers in a little-endian type of other programs: bool as uint8, half as float32, long double as double.

    Other types stay.
    """
    dtype = values.dtype.newbyteorder("<")
    if dtype.kind == "b":
        dtype = np.dtype(np.uint8)
    elif dtype.kind == "f" and dtype.itemsize not in (4, 8):
        dtype = np.dtype("<f4" if dtype.itemsize < 4 else "<f8")
    with np.errstate(over="ignore"):
        return values.astype(dtype, copy=False)


def packed_rows(columns: Columns) -> NDArray[Any]:
    """Return columns (N,) as rows (N,) without gaps, in little-endian byte order."""
    count = len(next(iter(columns.values())))
    rows = np.empty(count, dtype=[(name, column.dtype.newbyteorder("<")) for name, column in columns.items()])
    for name, column in columns.items():
        rows[name] = column
    return rows


def _is_number(word: bytes) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return b"_" not in word  # Python reads 1_000 as a number
