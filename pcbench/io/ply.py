"""PLY: ascii and binary, any order of elements and properties, list properties anywhere.

The header is data from a stranger: nothing is allocated on its word. The body is read in one go into a buffer of the
size the file has, and every count is checked against that buffer. Greg Turk, "The PLY Polygon File Format", 1994.
"""

from __future__ import annotations

import struct
from array import array
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, Literal

import numpy as np
from numpy.typing import DTypeLike, NDArray

from pcbench.errors import InputError
from pcbench.geometry.cloud import Cloud
from pcbench.io.files import Fields, Warn, atomic_write, read_rest

_HEADER_LIMIT = 1 << 20  # bytes
_BYTE_ORDERS: dict[str, Literal["<", ">"] | None] = {
    "ascii": None,
    "binary_little_endian": "<",
    "binary_big_endian": ">",
}
_TYPES = {
    "char": "i1",
    "uchar": "u1",
    "short": "i2",
    "ushort": "u2",
    "int": "i4",
    "uint": "u4",
    "float": "f4",
    "double": "f8",
    "int8": "i1",
    "uint8": "u1",
    "int16": "i2",
    "uint16": "u2",
    "int32": "i4",
    "uint32": "u4",
    "float32": "f4",
    "float64": "f8",
}
_NAMES = {code: name for name, code in reversed(_TYPES.items())}  # the older family: every reader knows it
_XYZ = ("x", "y", "z")
_NORMALS = ("nx", "ny", "nz")
_COLORS = (("red", "green", "blue"), ("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue"))

_FACES = ("vertex_indices", "vertex_index")  # what the list of a face is called

Columns = dict[str, NDArray[Any]]


@dataclass(frozen=True)
class _Property:
    """A scalar, or a list whose length is stored before it with the type `length`."""

    name: str
    dtype: np.dtype[Any]
    length: np.dtype[Any] | None = None


@dataclass(frozen=True)
class _Element:
    name: str
    count: int
    properties: list[_Property] = field(default_factory=list)

    @property
    def scalars(self) -> list[_Property]:
        return [p for p in self.properties if p.length is None]

    def counted(self, count: int) -> str:
        plural = {"vertex": "vertices", "face": "faces", "edge": "edges"}.get(self.name, f"{self.name[:40]!r} elements")
        return f"{count} of {self.count} {plural}"


@dataclass(frozen=True)
class _Header:
    byte_order: Literal["<", ">"] | None  # None: ascii
    elements: list[_Element]
    comments: list[str]

    def tagged(self, tag: str) -> str | None:
        """What follows a tag in a comment line: `comment crs EPSG:32617`."""
        return next((c.removeprefix(tag).strip() for c in self.comments if c.startswith(f"{tag} ")), None)


def read_ply(path: Path, warn: Warn) -> Fields:
    """The vertices of a PLY file: x y z, normals, 8-bit colours, and every other scalar as an attribute.

    Coordinates become float64 (an ascii file keeps the digits it has, whatever type it declares). Attributes keep their
    type and, where the byte order is native, are strided views into the bytes read. List properties and other elements
    are checked for their size and left out. Normals that are all zero, as in Gaussian splats, count as none. Lines
    `comment crs EPSG:32617` and `comment unit m` give the cloud's crs and unit.

    Raises:
        InputError: the file is not a complete PLY file with at least one vertex.
        OSError: it cannot be read.
    """
    with path.open("rb") as file:
        header = _read_header(file)
        _check_vertex(header)
        body = read_rest(file)
    # Damaged floats may be signalling NaNs or overflow a narrower type: they become NaN or Inf and are dropped later.
    with np.errstate(invalid="ignore", over="ignore"):
        if header.byte_order is None:
            columns = _ascii_columns(body.tobytes(), header)
        else:
            columns = _binary_columns(body, header)
        points = _stacked(columns, _XYZ, np.float64)
        normals = _stacked(columns, _NORMALS, np.float64) if columns.keys() >= set(_NORMALS) else None
        colors = None
        for names in _COLORS:
            if columns.keys() >= set(names) and all(columns[name].dtype == np.uint8 for name in names):
                colors = _stacked(columns, names, np.uint8)
                break
    return Fields(
        points=points,
        normals=normals if normals is not None and normals.any() else None,
        colors=colors,
        attributes={name: c.astype(c.dtype.newbyteorder("="), copy=False) for name, c in columns.items()},
        crs=header.tagged("crs"),
        unit=header.tagged("unit"),
    )


def holds_faces(path: Path) -> bool:
    """Whether the header, all that is read, tells of faces.

    Raises:
        InputError: it is not the header of a PLY file.
        OSError: the file cannot be read.
    """
    with path.open("rb") as file:
        return any(element.name == "face" and element.count for element in _read_header(file).elements)


def read_ply_faces(path: Path) -> tuple[Fields, NDArray[np.int64], NDArray[np.int64]]:
    """A PLY file's points, crs and unit, and its faces: corners of each (F,), then all their vertex numbers in a row.

    Raises:
        InputError: the file is not a complete PLY file with at least one vertex and lists of vertices a face.
        OSError: it cannot be read.
    """
    with path.open("rb") as file:
        header = _read_header(file)
        _check_vertex(header)
        _check_face(header)
        body = read_rest(file)
    with np.errstate(invalid="ignore", over="ignore"):
        if header.byte_order is None:
            columns, (lengths, corners) = _ascii_columns(body.tobytes(), header), _ascii_lists(body.tobytes(), header)
        else:
            columns, (lengths, corners) = _binary_columns(body, header), _binary_lists(body, header)
        points = _stacked(columns, _XYZ, np.float64)
    return Fields(points=points, crs=header.tagged("crs"), unit=header.tagged("unit")), lengths, corners


def _stacked(columns: Columns, names: tuple[str, str, str], dtype: DTypeLike) -> NDArray[Any]:
    """Three columns taken out of `columns` as one (N, 3) array: the only copy of them."""
    taken = [columns.pop(name) for name in names]
    stacked = np.empty((len(taken[0]), 3), dtype=dtype)
    for axis, column in enumerate(taken):
        stacked[:, axis] = column
    return stacked


# ---- header -------------------------------------------------------------------------------------------------------


def _read_header(file: BinaryIO) -> _Header:
    """Reads up to and including the line `end_header`: the file then stands at the body."""
    magic = file.readline(16)
    if magic.rstrip() != b"ply":
        raise InputError(f"expected a PLY file that starts with a line 'ply', got {magic!r}")
    byte_order: Literal["<", ">"] | None = None
    formats: list[str] = []
    elements: dict[str, _Element] = {}
    comments: list[str] = []
    used, number = len(magic), 1
    while True:
        line = file.readline(_HEADER_LIMIT - used + 1)
        used, number = used + len(line), number + 1
        if used > _HEADER_LIMIT:
            raise InputError(f"expected a PLY header of at most {_HEADER_LIMIT} bytes, got no end_header until there")
        if not line:
            raise InputError(f"header without end_header: the file ends after line {number - 1}")
        if b"\0" in line:
            raise InputError(f"header line {number}: expected text, got a NUL byte")
        words = line.split()
        if not words:
            continue
        if words[0] in (b"comment", b"obj_info"):  # free text, in whatever encoding its writer had
            if words[0] == b"comment":
                comments.append(b" ".join(words[1:]).decode("utf-8", errors="replace"))
            continue
        if not line.isascii() or not b" ".join(words).decode().isprintable():
            raise InputError(f"header line {number}: expected ASCII text, got {_shown(line)}")
        match [word.decode() for word in words]:
            case ["end_header"]:
                break
            case ["format", name, "1.0"] if name in _BYTE_ORDERS and not formats:
                byte_order = _BYTE_ORDERS[name]
                formats.append(name)
            case ["format", *_] if formats:
                raise InputError(f"header line {number}: a second format line")
            case ["format", *_]:
                known = ", ".join(_BYTE_ORDERS)
                raise InputError(f"header line {number}: expected 'format {known} 1.0', got {_shown(line)}")
            case ["element", name, count]:
                if name in elements:
                    raise InputError(f"header line {number}: a second element {name[:40]!r}")
                elements[name] = current = _Element(name, _count(count, name, number))
            case ["property", *rest] if elements:
                current.properties.append(_property(rest, number))
            case ["property", *_]:
                raise InputError(f"header line {number}: a property before the first element")
            case _:
                known = "format, element, property, comment or end_header"
                raise InputError(f"header line {number}: expected {known}, got {_shown(line)}")
    if not formats:
        raise InputError(f"header without a format line: expected one of {', '.join(_BYTE_ORDERS)}")
    ordered = [_ordered(element, byte_order or "=") for element in elements.values()]
    return _Header(byte_order, ordered, comments)


def _shown(line: bytes) -> str:
    text = line.strip()
    return repr(text[:60])[1:] + ("..." if len(text) > 60 else "")


def _count(word: str, element: str, number: int) -> int:
    if word.startswith("-") and word[1:].isdigit():
        raise InputError(f"header line {number}: expected a count of {element!r} >= 0, got {word[:40]}")
    if not word.isdigit():
        raise InputError(f"header line {number}: expected a whole number of {element!r}, got {word[:40]!r}")
    if len(word) > 18:  # 10^18 rows are more than any file holds, and fit an int64 however they are multiplied here
        raise InputError(f"header line {number}: no file holds {word[:40]} of {element!r}: the header is damaged")
    return int(word)


def _property(words: list[str], number: int) -> _Property:
    match words:
        case ["list", length, item, name]:
            counter = _type(length, number)
            if counter.kind == "f":
                raise InputError(f"header line {number}: expected a list length of an integer type, got {length!r}")
            return _Property(name, _type(item, number), counter)
        case [item, name] if item != "list":
            return _Property(name, _type(item, number))
    raise InputError(
        f"header line {number}: expected 'property TYPE NAME' or 'property list TYPE TYPE NAME',"
        f" got {' '.join(['property', *words])[:60]!r}"
    )


def _type(word: str, number: int) -> np.dtype[Any]:
    if word not in _TYPES:
        raise InputError(f"header line {number}: expected a type of {', '.join(_TYPES)}; got {word[:40]!r}")
    return np.dtype(_TYPES[word])


def _ordered(element: _Element, byte_order: Literal["<", ">", "="]) -> _Element:
    properties = [
        _Property(p.name, p.dtype.newbyteorder(byte_order), p.length and p.length.newbyteorder(byte_order))
        for p in element.properties
    ]
    return _Element(element.name, element.count, properties)


def _check_vertex(header: _Header) -> None:
    vertex = next((element for element in header.elements if element.name == "vertex"), None)
    if vertex is None:
        names = ", ".join(repr(element.name[:40]) for element in header.elements[:10]) or "none"
        raise InputError(f"expected an element 'vertex', got {names}")
    seen: set[str] = set()
    for prop in vertex.properties:
        if prop.name in seen:
            raise InputError(f"property {prop.name[:40]!r} stands twice in the vertex element")
        if prop.name in _XYZ and prop.length is not None:
            raise InputError(f"expected property {prop.name!r} as a number, got a list")
        seen.add(prop.name)
    if missing := [name for name in _XYZ if name not in seen]:
        raise InputError(f"expected vertex properties x, y, z; missing: {', '.join(missing)}")
    if not vertex.count:
        raise InputError("expected at least one point, got 0 vertices")


def _check_face(header: _Header) -> None:
    for element in header.elements:
        if element.name == "face" and any(prop.name in _FACES and prop.length for prop in element.properties):
            return
    raise InputError(f"expected an element 'face' with a list {' or '.join(_FACES)}: there are no faces in this file")


def _truncated(element: _Element, complete: int) -> InputError:
    return InputError(f"truncated: {element.counted(complete)}: copy or export the file again")


# ---- binary body --------------------------------------------------------------------------------------------------


def _binary_columns(body: NDArray[np.uint8], header: _Header) -> Columns:
    vertices: Columns = {}
    start = 0
    for element in header.elements:
        columns, start = _binary_element(body, start, element)
        if element.name == "vertex":
            vertices = columns
    if start < len(body):
        raise InputError(
            f"{len(body) - start} bytes after the last element: header and body disagree, export the file again"
        )
    return vertices


def _binary_element(body: NDArray[np.uint8], start: int, element: _Element) -> tuple[Columns, int]:
    """The scalar columns of an element, and where the next one starts."""
    if not element.count or not element.properties:
        return {}, start
    # Most lists have one length throughout (triangles): suppose that of the first row, and check.
    first = _list_lengths(body, start, element, rows=1)[0]
    even = _even_rows(body, start, element, first.tolist())
    if even is not None:
        return even
    lengths = _list_lengths(body, start, element, rows=element.count)
    return _uneven_rows(body, start, element, lengths)


def _even_rows(
    body: NDArray[np.uint8], start: int, element: _Element, lengths: Sequence[int]
) -> tuple[Columns, int] | None:
    """Columns as strided views, if every row's lists have the given lengths (lists,); else None."""
    remaining = iter(lengths)
    scalars: list[tuple[_Property, int]] = []
    counters: list[tuple[np.dtype[Any], int, int]] = []
    row_bytes = 0
    for prop in element.properties:
        if prop.length is None:
            scalars.append((prop, row_bytes))
            row_bytes += prop.dtype.itemsize
        else:
            length = next(remaining)
            counters.append((prop.length, row_bytes, length))
            row_bytes += prop.length.itemsize + length * prop.dtype.itemsize
    end = start + element.count * row_bytes
    if end > len(body):
        if not counters:
            raise _truncated(element, (len(body) - start) // row_bytes)
        return None

    def column(dtype: np.dtype[Any], place: int) -> NDArray[Any]:
        return np.ndarray(element.count, dtype, body.data, start + place, (row_bytes,))

    if not all((column(dtype, place) == length).all() for dtype, place, length in counters):
        return None
    return {prop.name: column(prop.dtype, place) for prop, place in scalars}, end


def _list_lengths(body: NDArray[np.uint8], start: int, element: _Element, rows: int) -> NDArray[np.int64]:
    """Lengths (rows, lists) of the lists in the first `rows` rows, which are walked one by one."""
    steps = []  # for each list: bytes of scalars before it, how to read its length, bytes of that and of an item
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
    place = start
    for row in range(rows if steps else 0):
        for skip, unpack, counter_bytes, item_bytes in steps:
            place += skip
            if place + counter_bytes > len(data):
                raise _truncated(element, row)
            length = unpack(data, place)[0]
            if length < 0:
                raise InputError(f"{element.counted(row)} read, then a list of length {length}: the file is damaged")
            lengths.append(length)
            place += counter_bytes + length * item_bytes
        if place + before > len(data):
            raise _truncated(element, row)
        place += before
    return np.frombuffer(lengths, dtype=np.int64).reshape(rows, len(steps)) if steps else np.empty((rows, 0), np.int64)


def _uneven_rows(
    body: NDArray[np.uint8], start: int, element: _Element, lengths: NDArray[np.int64]
) -> tuple[Columns, int]:
    """Columns gathered row by row; lengths (N, lists) are known to stay inside the body."""
    row_bytes = np.zeros(element.count, dtype=np.int64)
    list_bytes: list[NDArray[np.int64]] = []
    for prop in element.properties:
        if prop.length is None:
            row_bytes += prop.dtype.itemsize
        else:
            list_bytes.append(prop.length.itemsize + lengths[:, len(list_bytes)] * prop.dtype.itemsize)
            row_bytes += list_bytes[-1]
    ends = start + np.cumsum(row_bytes)
    places = ends - row_bytes
    columns: Columns = {}
    if element.name == "vertex":
        skips = iter(list_bytes)
        for prop in element.properties:
            if prop.length is not None:
                places = places + next(skips)
                continue
            windows = np.lib.stride_tricks.sliding_window_view(body, prop.dtype.itemsize)
            columns[prop.name] = windows[places].view(prop.dtype)[:, 0]
            places = places + prop.dtype.itemsize
    return columns, int(ends[-1])


def _binary_lists(body: NDArray[np.uint8], header: _Header) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Lengths (F,) of the faces' lists and all their items; the body is known to be complete."""
    start = 0
    for element in header.elements:
        if element.name == "face":
            break
        start = _binary_element(body, start, element)[1]
    first = _list_lengths(body, start, element, rows=min(1, element.count))
    if element.count and _even_rows(body, start, element, first[0].tolist()) is not None:
        lengths = np.repeat(first, element.count, axis=0)
    else:
        lengths = _list_lengths(body, start, element, rows=element.count)
    sizes = np.empty((element.count, len(element.properties)), dtype=np.int64)  # bytes of each property
    taken, column = -1, 0
    for place, prop in enumerate(element.properties):
        if prop.length is None:
            sizes[:, place] = prop.dtype.itemsize
        else:
            if prop.name in _FACES and taken < 0:
                taken, wanted, counts = place, prop, lengths[:, column]
                header_bytes = prop.length.itemsize
            sizes[:, place] = prop.length.itemsize + lengths[:, column] * prop.dtype.itemsize
            column += 1
    rows = start + np.cumsum(sizes.sum(axis=1)) - sizes.sum(axis=1)
    begin = rows + sizes[:, :taken].sum(axis=1) + header_bytes
    within = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    places = np.repeat(begin, counts) + within * wanted.dtype.itemsize
    if not len(places):
        return counts, np.empty(0, dtype=np.int64)
    items = np.lib.stride_tricks.sliding_window_view(body, wanted.dtype.itemsize)[places].view(wanted.dtype)[:, 0]
    return counts, _whole(items)


def _whole(items: NDArray[Any]) -> NDArray[np.int64]:
    """Vertex numbers, which a file may declare as floats."""
    whole = items.astype(np.int64)
    if items.dtype.kind == "f" and not (whole == items).all():
        raise InputError("expected whole numbers of vertices in the faces, got fractions: the file is damaged")
    return whole


# ---- ascii body ---------------------------------------------------------------------------------------------------


def _ascii_columns(text: bytes, header: _Header) -> Columns:
    lines = [line for line in text.splitlines() if line.strip()]
    vertices: Columns = {}
    start = 0
    for element in header.elements:
        if not element.properties:
            continue
        rows = lines[start : start + element.count]
        if len(rows) < element.count:
            raise _truncated(element, len(rows))
        start += len(rows)
        if element.name == "vertex":
            table = _ascii_table(rows, element)
            vertices = {p.name: _typed(table[:, k], p) for k, p in enumerate(element.scalars)}
        else:
            for number, row in enumerate(rows):
                _ascii_row(row, number, element)
    if start < len(lines):
        raise InputError(
            f"{len(lines) - start} lines after the last element: header and body disagree, export it again"
        )
    return vertices


def _ascii_lists(text: bytes, header: _Header) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Lengths (F,) of the faces' lists and all their items; the rows are known to be complete."""
    lines = [line for line in text.splitlines() if line.strip()]
    start = 0
    for element in header.elements:
        if element.name == "face":
            break
        start += element.count if element.properties else 0
    lengths = array("q")
    words: list[bytes] = []
    wanted = next(place for place, prop in enumerate(element.properties) if prop.name in _FACES and prop.length)
    for line in lines[start : start + element.count]:
        row = line.split()
        place = 0
        for prop in element.properties[:wanted]:
            place += 1 if prop.length is None else 1 + int(row[place])
        length = int(row[place])
        lengths.append(length)
        words += row[place + 1 : place + 1 + length]
    try:
        items = np.array([float(word) for word in words])
    except ValueError as error:
        raise InputError(f"expected vertex numbers in the faces, got something else: {str(error)[:60]}") from error
    return np.frombuffer(lengths, dtype=np.int64), _whole(items)


def _ascii_table(rows: list[bytes], element: _Element) -> NDArray[np.float64]:
    """The scalars (N, scalars) of an element; float64 holds every PLY type exactly."""
    if len(element.scalars) == len(element.properties):
        try:
            table = np.loadtxt(rows, dtype=np.float64, comments=None, ndmin=2)
            if table.shape == (element.count, len(element.scalars)):
                return table
        except ValueError:
            pass  # the walk below says which row is wrong
    return np.array([_ascii_row(row, number, element) for number, row in enumerate(rows)], dtype=np.float64)


def _ascii_row(row: bytes, number: int, element: _Element) -> list[float]:
    """The scalars of one line, whose values must be as many as the properties and list lengths say."""
    words = row.split()
    values: list[float] = []
    place = 0
    try:
        for prop in element.properties:
            if prop.length is None:
                values.append(float(words[place]))
                place += 1
            else:
                length = int(words[place])
                if length < 0:
                    raise ValueError
                place += 1 + length
    except IndexError:
        place += 1
    except ValueError:
        place = -1
    if place < 0 or b"_" in row:  # Python reads 1_000 as a number; PLY does not
        raise InputError(f"{element.counted(number)} read, then expected numbers, got {_shown(row)}")
    if place != len(words):
        more = "at least " if place > len(words) else ""
        raise InputError(f"{element.counted(number)} read, then expected {more}{place} values, got {len(words)}")
    return values


def _typed(values: NDArray[np.float64], prop: _Property) -> NDArray[Any]:
    """An ascii column in its declared type; coordinates keep the digits of the text even if they are declared float."""
    if prop.dtype.kind == "f":
        return values if prop.name in _XYZ else values.astype(prop.dtype)
    typed = values.astype(prop.dtype)
    if len(wrong := np.flatnonzero(typed != values)):
        name = _NAMES[prop.dtype.str[1:]]
        raise InputError(f"vertex {wrong[0]}: expected {prop.name!r} as {name}, got {values[wrong[0]]:g}")
    return typed


# ---- writer -------------------------------------------------------------------------------------------------------


def write_ply(path: Path, cloud: Cloud) -> None:
    """Writes binary little-endian PLY: x y z double, nx ny nz float, red green blue uchar, attributes in their type.

    Normals are directions: float's 7 digits are enough. An attribute of a type that PLY does not have becomes the first
    of int, uint and double that holds its values (bool: uchar; integers beyond 2^53 lose digits in the double). `crs`
    and `unit` go into comment lines.

    Raises:
        InputError: an attribute's name or type cannot stand in a PLY file.
        OSError: the file cannot be written; an existing one is then unchanged.
    """
    columns: Columns = {name: cloud.points[:, axis] for axis, name in enumerate(_XYZ)}
    if cloud.normals is not None:
        columns |= {name: cloud.normals[:, axis].astype(np.float32) for axis, name in enumerate(_NORMALS)}
    if cloud.colors is not None:
        columns |= {name: cloud.colors[:, axis] for axis, name in enumerate(_COLORS[0])}
    for name, values in cloud.attributes.items():
        if name in columns:
            raise InputError(f"{path}: attribute {name!r} has the name of a coordinate, normal or colour: rename it")
        if not name or not name.isascii() or not name.isprintable() or " " in name:
            raise InputError(f"{path}: expected attribute names of ASCII without spaces, got {name!r}: rename it")
        columns[name] = _as_ply_type(name, values, path)

    types = {name: column.dtype.newbyteorder("=").str[1:] for name, column in columns.items()}
    rows = np.empty(len(cloud), dtype=[(name, f"<{code}") for name, code in types.items()])
    for name, column in columns.items():
        rows[name] = column
    tags = [f"comment {tag} {_one_line(text)}" for tag, text in (("crs", cloud.crs), ("unit", cloud.unit)) if text]
    properties = [f"property {_NAMES[code]} {name}" for name, code in types.items()]
    lines = ["ply", "format binary_little_endian 1.0", *tags, f"element vertex {len(cloud)}", *properties, "end_header"]
    with atomic_write(path) as file:
        file.write(("\n".join(lines) + "\n").encode())
        file.write(rows.view(np.uint8).data)


def _one_line(text: str) -> str:
    return " ".join("".join(char if char.isprintable() else " " for char in text).split())


def _as_ply_type(name: str, values: NDArray[Any], path: Path) -> NDArray[Any]:
    if values.dtype.kind not in "biuf":
        raise InputError(f"{path}: expected attribute {name!r} as numbers, got {values.dtype}")
    if values.dtype.newbyteorder("=").str[1:] in _NAMES:
        return values
    if values.dtype.kind == "b":
        return values.astype(np.uint8)
    if values.dtype == np.float16:
        return values.astype(np.float32)
    if values.dtype.kind in "iu":
        low, high = int(values.min()), int(values.max())
        for dtype in (np.int32, np.uint32):
            if np.iinfo(dtype).min <= low and high <= np.iinfo(dtype).max:
                return values.astype(dtype)
    with np.errstate(over="ignore"):
        return values.astype(np.float64)
