"""Read the body of a PLY file, ascii or binary, in one pass over its elements.

The complete body is read into one buffer, and each count is checked against the size of that buffer.
"""

from __future__ import annotations

import struct
from array import array
from collections.abc import Collection, Sequence
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.errors import InputError
from pcbench.io.columns import as_integers, not_numbers_error, parse_rows
from pcbench.io.files import MAX_PADDING, Warn, check_end, read_rest
from pcbench.io.names import XYZ, Columns
from pcbench.io.ply_header import TYPE_NAMES, Element, PlyHeader, Property


class Polygons(NamedTuple):
    """Vertex indices of one polygon per row: `lengths` (rows,) are corner counts, `corners` lists those of all rows."""

    lengths: NDArray[np.int64]
    corners: NDArray[np.int64]


class Table(NamedTuple):
    """Requested data of an element: its scalar properties by name, each (rows,), and its polygons."""

    columns: Columns
    polygons: Polygons | None


class _Selection(NamedTuple):
    scalars: bool
    polygons: bool


def read_elements(
    file: BinaryIO, header: PlyHeader, warn: Warn, *, scalars: Collection[str], polygons: Collection[str] = ()
) -> dict[str, Table]:
    """Read the elements of a file by name, from its body. Elements that are not requested are only checked for size.

    Coordinates of an ascii file are float64, whatever type it declares, and keep all digits. All other columns have
    their declared type. Those of a binary file are strided views into the bytes read if possible.

    Args:
        file: input file at the position after `read_header`.
        header: its header.
        warn: callback for warnings.
        scalars: names of the elements whose scalar properties are returned.
        polygons: names of the elements whose list of vertex indices (`Element.polygon`) is returned.

    Raises:
        InputError: the length or content of the body does not match the header.
        OSError: the file cannot be read.
    """
    body = read_rest(file)
    selection = {
        element.name: _Selection(element.name in scalars, element.name in polygons and element.polygon is not None)
        for element in header.elements
    }
    return (
        _ascii_tables(body.tobytes(), header, selection, warn)
        if header.byte_order is None
        else _tables(body, header, selection, warn)
    )


def _polygons(lengths: NDArray[np.int64], numbers: NDArray[Any]) -> Polygons:
    """Convert vertex indices, which may be declared as floats, to integers."""
    corners = numbers.astype(np.int64)
    if numbers.dtype.kind == "f" and not (corners == numbers).all():
        raise InputError("expected integer vertex indices in the faces, got fractions: export the file again")
    return Polygons(lengths, corners)


# ---- binary -------------------------------------------------------------------------------------------------------


def _tables(
    body: NDArray[np.uint8], header: PlyHeader, selection: dict[str, _Selection], warn: Warn
) -> dict[str, Table]:
    tables: dict[str, Table] = {}
    start = 0
    for element in header.elements:
        tables[element.name], start = _table(body, start, element, selection[element.name])
    rest = body[start : start + MAX_PADDING].tobytes()
    check_end(rest, len(body) - start, header.elements[-1].least_bytes, "the last element", warn)
    return tables


def _table(body: NDArray[np.uint8], start: int, element: Element, selection: _Selection) -> tuple[Table, int]:
    """Read the selected data of an element; also return the start of the next element."""
    if not element.count or not element.properties:
        return Table({}, Polygons(np.empty(0, np.int64), np.empty(0, np.int64)) if selection.polygons else None), start
    # Usually the lists of all rows have one length (triangles), so the length in the first row is tried first.
    first = _list_lengths(body, start, element, rows=1)[0]
    uniform = _uniform_rows(body, start, element, first.tolist(), selection)
    if uniform is not None:
        return uniform
    lengths = _list_lengths(body, start, element, rows=element.count)
    return _varying_rows(body, start, element, lengths, selection)


def _list_lengths(body: NDArray[np.uint8], start: int, element: Element, rows: int) -> NDArray[np.int64]:
    """Return the lengths (rows, lists) of the lists in the first `rows` rows, read row by row."""
    steps = []  # for each list: bytes of scalars before it, reader of its length, bytes of the length and of an item
    before = 0
    for prop in element.properties:
        if prop.length is None:
            before += prop.dtype.itemsize
        else:
            order = ">" if prop.length.str[0] == ">" else "<"
            counter = struct.Struct(order + prop.length.char)
            steps.append((before, counter.unpack_from, counter.size, prop.dtype.itemsize))
            before = 0
    lengths = array("q")
    data = body.data
    offset = start
    for row in range(rows if steps else 0):
        for skip, unpack, counter_bytes, item_bytes in steps:
            offset += skip
            if offset + counter_bytes > len(data):
                raise element.truncation_error(row)
            length = unpack(data, offset)[0]
            if length < 0:
                raise InputError(
                    f"expected a list length of 0 or more, got {length} after {element.count_text(row)}"
                    ": export it again"
                )
            lengths.append(length)
            offset += counter_bytes + length * item_bytes
        if offset + before > len(data):
            raise element.truncation_error(row)
        offset += before
    return np.frombuffer(lengths, dtype=np.int64).reshape(rows, len(steps)) if steps else np.empty((rows, 0), np.int64)


def _uniform_rows(
    body: NDArray[np.uint8], start: int, element: Element, lengths: Sequence[int], selection: _Selection
) -> tuple[Table, int] | None:
    """Return columns as strided views if the lists of all rows have the given lengths (lists,), else None."""
    remaining = iter(lengths)
    scalars: list[tuple[Property, int]] = []
    lists: list[tuple[Property, np.dtype[Any], int, int]] = []
    row_bytes = 0
    for prop in element.properties:
        if prop.length is None:
            scalars.append((prop, row_bytes))
            row_bytes += prop.dtype.itemsize
        else:
            length = next(remaining)
            lists.append((prop, prop.length, row_bytes, length))
            row_bytes += prop.length.itemsize + length * prop.dtype.itemsize
    end = start + element.count * row_bytes
    if end > len(body):
        if not lists:
            raise element.truncation_error((len(body) - start) // row_bytes)
        return None

    def column(dtype: np.dtype[Any], offset: int) -> NDArray[Any]:
        return np.ndarray(element.count, dtype, body.data, start + offset, (row_bytes,))

    if not all((column(counter, offset) == length).all() for _, counter, offset, length in lists):
        return None
    columns = {prop.name: column(prop.dtype, offset) for prop, offset in scalars} if selection.scalars else {}
    if not selection.polygons:
        return Table(columns, None), end
    prop, counter, offset, length = next(entry for entry in lists if entry[0] is element.polygon)
    items = start + offset + counter.itemsize
    strides = (row_bytes, prop.dtype.itemsize)
    numbers: NDArray[Any] = np.ndarray((element.count, length), prop.dtype, body.data, items, strides)
    return Table(columns, _polygons(np.full(element.count, length), numbers.reshape(-1))), end


def _varying_rows(
    body: NDArray[np.uint8], start: int, element: Element, lengths: NDArray[np.int64], selection: _Selection
) -> tuple[Table, int]:
    """Gather columns row by row; the list lengths (rows, lists) have been checked against the body."""
    fixed_bytes = sum((prop.length or prop.dtype).itemsize for prop in element.properties)
    row_bytes = fixed_bytes + lengths @ np.array([prop.dtype.itemsize for prop in element.lists], dtype=np.int64)
    ends = start + np.cumsum(row_bytes)
    offsets = ends - row_bytes  # of the current property, in each row
    columns: Columns = {}
    polygons: Polygons | None = None
    counts = iter(lengths.T)
    for prop in element.properties:
        if prop.length is None:
            if selection.scalars:
                columns[prop.name] = _gather(body, offsets, prop.dtype)
            offsets = offsets + prop.dtype.itemsize
            continue
        count = next(counts)
        offsets = offsets + prop.length.itemsize
        if selection.polygons and prop is element.polygon:
            item_index = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
            items = np.repeat(offsets, count) + item_index * prop.dtype.itemsize
            polygons = _polygons(count, _gather(body, items, prop.dtype))
        offsets = offsets + count * prop.dtype.itemsize
    return Table(columns, polygons), int(ends[-1])


def _gather(body: NDArray[np.uint8], offsets: NDArray[np.int64], dtype: np.dtype[Any]) -> NDArray[Any]:
    """Return the value at each byte offset (N,)."""
    if not len(offsets):
        return np.empty(0, dtype)
    return np.lib.stride_tricks.sliding_window_view(body, dtype.itemsize)[offsets].view(dtype)[:, 0]


# ---- ascii --------------------------------------------------------------------------------------------------------


def _ascii_tables(text: bytes, header: PlyHeader, selection: dict[str, _Selection], warn: Warn) -> dict[str, Table]:
    lines = [line for line in text.splitlines() if line.strip()]
    tables: dict[str, Table] = {}
    start = 0
    for element in header.elements:
        if not element.properties:
            continue
        rows = lines[start : start + element.count]
        if len(rows) < element.count:
            raise element.truncation_error(len(rows))
        start += len(rows)
        tables[element.name] = _ascii_table(rows, element, selection[element.name])
    rest = b"\n".join(lines[start:])
    check_end(rest[:MAX_PADDING], len(rest), header.elements[-1].least_characters, "the last element", warn)
    return tables


def _ascii_table(rows: list[bytes], element: Element, selection: _Selection) -> Table:
    polygons: Polygons | None = None
    if selection.scalars and not element.lists:
        values = parse_rows(rows, len(element.scalars), element.place_after)
    else:
        scalars: list[list[float]] = []
        lengths, words = array("q"), list[bytes]()
        for number, row in enumerate(rows):
            line, polygon = _ascii_row(row, number, element)
            if selection.scalars:
                scalars.append(line)
            if selection.polygons:
                lengths.append(len(polygon))
                words += polygon
        if selection.polygons:
            polygons = _polygons(np.frombuffer(lengths, dtype=np.int64), _numbers(words))
        values = np.array(scalars, dtype=np.float64)
    if not selection.scalars:
        return Table({}, polygons)
    values = values.reshape(len(rows), len(element.scalars))
    columns = {prop.name: _typed(values[:, k], prop, element) for k, prop in enumerate(element.scalars)}
    return Table(columns, polygons)


def _ascii_row(row: bytes, number: int, element: Element) -> tuple[list[float], list[bytes]]:
    """Parse the scalars of one line and the words of its polygon.

    The number of words must match the properties and list lengths.
    """
    words = row.split()
    values: list[float] = []
    polygon: list[bytes] = []
    selection = element.polygon
    offset = 0
    try:
        for prop in element.properties:
            if prop.length is None:
                values.append(float(words[offset]))
                offset += 1
            else:
                length = int(words[offset])
                if length < 0:
                    raise ValueError
                if prop is selection:
                    polygon = words[offset + 1 : offset + 1 + length]
                offset += 1 + length
    except IndexError:
        offset += 1
    except ValueError:
        offset = -1
    if offset < 0 or b"_" in row:  # Python reads 1_000 as a number; PLY does not
        raise not_numbers_error(element.place_after(number), row)
    if offset != len(words):
        more = "at least " if offset > len(words) else ""
        raise InputError(
            f"{element.place_after(number)}: expected {more}{offset} values, got {len(words)}: export the file again"
        )
    return values, polygon


def _numbers(words: list[bytes]) -> NDArray[np.float64]:
    try:
        return np.array([float(word) for word in words])
    except ValueError as error:
        raise InputError(f"expected vertex indices in the faces, got other text: {str(error)[:60]}") from error


def _typed(values: NDArray[np.float64], prop: Property, element: Element) -> NDArray[Any]:
    """Convert an ascii column to its declared type; coordinates stay float64 to keep all digits."""
    if prop.dtype.kind == "f":
        return values if prop.name in XYZ else values.astype(prop.dtype)
    return as_integers(values, prop.dtype, prop.name, TYPE_NAMES[prop.dtype.str[1:]], element.place_after)
