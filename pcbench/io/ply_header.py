"""The header of a PLY file: its elements, their properties, its comments.

The header is data from a stranger: nothing is allocated on its word, and a line that is not understood is refused.
Greg Turk, "The PLY Polygon File Format", 1994.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, BinaryIO, Literal

import numpy as np

from pcbench.errors import InputError

_MAX_HEADER_BYTES = 1 << 20
_MAX_COUNT_DIGITS = 18  # 10^18 rows are more than any file holds, and fit an int64 however they are multiplied here
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
TYPE_NAMES = {code: name for name, code in reversed(_TYPES.items())}  # the older family: every reader knows it
XYZ = ("x", "y", "z")
_POLYGONS = ("vertex_indices", "vertex_index")  # what the list of a face is called


@dataclass(frozen=True)
class Property:
    """A scalar, or a list whose length is stored before it with the type `length`."""

    name: str
    dtype: np.dtype[Any]
    length: np.dtype[Any] | None = None


@dataclass(frozen=True)
class Element:
    """So many rows, each with the same properties in the same order."""

    name: str
    count: int
    properties: list[Property] = field(default_factory=list)

    @property
    def scalars(self) -> list[Property]:
        return [prop for prop in self.properties if prop.length is None]

    @property
    def lists(self) -> list[Property]:
        return [prop for prop in self.properties if prop.length is not None]

    @property
    def polygon(self) -> Property | None:
        """The list of a row's vertex numbers: the first one that has a name of such lists."""
        return next((prop for prop in self.lists if prop.name in _POLYGONS), None)

    def count_text(self, count: int) -> str:
        plural = {"vertex": "vertices", "face": "faces", "edge": "edges"}.get(self.name, f"{self.name[:40]!r} elements")
        return f"{count} of {self.count} {plural}"

    def truncated(self, complete: int) -> InputError:
        return InputError(f"truncated: {self.count_text(complete)}: copy or export the file again")


@dataclass(frozen=True)
class PlyHeader:
    byte_order: Literal["<", ">"] | None  # None: ascii
    elements: list[Element]
    comments: list[str]

    def element(self, name: str) -> Element | None:
        return next((element for element in self.elements if element.name == name), None)

    def tag_value(self, tag: str) -> str | None:
        """What follows a tag in a comment line: `comment crs EPSG:32617`."""
        return next((c.removeprefix(tag).strip() for c in self.comments if c.startswith(f"{tag} ")), None)


def check_vertices(header: PlyHeader) -> None:
    """Raises InputError where there is no vertex, or the vertices have no coordinates or two properties of one name."""
    vertex = header.element("vertex")
    if vertex is None:
        names = ", ".join(repr(element.name[:40]) for element in header.elements[:10]) or "none"
        raise InputError(f"expected an element 'vertex', got {names}")
    seen: set[str] = set()
    for prop in vertex.properties:
        if prop.name in seen:
            raise InputError(f"property {prop.name[:40]!r} stands twice in the vertex element")
        if prop.name in XYZ and prop.length is not None:
            raise InputError(f"expected property {prop.name!r} as a number, got a list")
        seen.add(prop.name)
    if missing := [name for name in XYZ if name not in seen]:
        raise InputError(f"expected vertex properties x, y, z; missing: {', '.join(missing)}")
    if not vertex.count:
        raise InputError("expected at least one point, got 0 vertices")


def check_faces(header: PlyHeader) -> None:
    """Raises InputError where no element holds the vertex numbers of faces."""
    face = header.element("face")
    if face is None or face.polygon is None:
        raise InputError(
            f"expected an element 'face' with a list {' or '.join(_POLYGONS)}: there are no faces in this file"
        )


def read_header(file: BinaryIO) -> PlyHeader:
    """Reads up to and including the line `end_header`: the file then stands at the body.

    Raises:
        InputError: these are not the first lines of a PLY file.
        OSError: the file cannot be read.
    """
    magic = file.readline(16)
    if magic.rstrip() != b"ply":
        raise InputError(f"expected a PLY file that starts with a line 'ply', got {magic!r}")
    byte_order: Literal["<", ">"] | None = None
    formats: list[str] = []
    elements: dict[str, Element] = {}
    comments: list[str] = []
    used, number = len(magic), 1
    while True:
        line = file.readline(_MAX_HEADER_BYTES - used + 1)
        used, number = used + len(line), number + 1
        if used > _MAX_HEADER_BYTES:
            raise InputError(
                f"expected a PLY header of at most {_MAX_HEADER_BYTES} bytes, got no end_header until there"
            )
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
            raise InputError(f"header line {number}: expected ASCII text, got {excerpt(line)}")
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
                raise InputError(f"header line {number}: expected 'format {known} 1.0', got {excerpt(line)}")
            case ["element", name, count]:
                if name in elements:
                    raise InputError(f"header line {number}: a second element {name[:40]!r}")
                elements[name] = current = Element(name, _count(count, name, number))
            case ["property", *rest] if elements:
                current.properties.append(_property(rest, number))
            case ["property", *_]:
                raise InputError(f"header line {number}: a property before the first element")
            case _:
                known = "format, element, property, comment or end_header"
                raise InputError(f"header line {number}: expected {known}, got {excerpt(line)}")
    if not formats:
        raise InputError(f"header without a format line: expected one of {', '.join(_BYTE_ORDERS)}")
    ordered = [_with_byte_order(element, byte_order or "=") for element in elements.values()]
    return PlyHeader(byte_order, ordered, comments)


def excerpt(line: bytes) -> str:
    """The start of a line, for an error message."""
    text = line.strip()
    return repr(text[:60])[1:] + ("..." if len(text) > 60 else "")


def _count(word: str, element: str, number: int) -> int:
    if word.startswith("-") and word[1:].isdigit():
        raise InputError(f"header line {number}: expected a count of {element!r} >= 0, got {word[:40]}")
    if not word.isdigit():
        raise InputError(f"header line {number}: expected a whole number of {element!r}, got {word[:40]!r}")
    if len(word) > _MAX_COUNT_DIGITS:
        raise InputError(f"header line {number}: no file holds {word[:40]} of {element!r}: the header is damaged")
    return int(word)


def _property(words: list[str], number: int) -> Property:
    match words:
        case ["list", length, item, name]:
            counter = _type(length, number)
            if counter.kind == "f":
                raise InputError(f"header line {number}: expected a list length of an integer type, got {length!r}")
            return Property(name, _type(item, number), counter)
        case [item, name] if item != "list":
            return Property(name, _type(item, number))
    raise InputError(
        f"header line {number}: expected 'property TYPE NAME' or 'property list TYPE TYPE NAME',"
        f" got {' '.join(['property', *words])[:60]!r}"
    )


def _type(word: str, number: int) -> np.dtype[Any]:
    if word not in _TYPES:
        raise InputError(f"header line {number}: expected a type of {', '.join(_TYPES)}; got {word[:40]!r}")
    return np.dtype(_TYPES[word])


def _with_byte_order(element: Element, byte_order: Literal["<", ">", "="]) -> Element:
    properties = [
        Property(p.name, p.dtype.newbyteorder(byte_order), p.length and p.length.newbyteorder(byte_order))
        for p in element.properties
    ]
    return Element(element.name, element.count, properties)
