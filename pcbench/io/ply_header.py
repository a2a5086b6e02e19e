"""Read the header of a PLY file: elements, properties and comments.

The header is untrusted: no memory is allocated from its counts alone, and unknown lines are refused.
Greg Turk, "The PLY Polygon File Format", 1994.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field, replace
from typing import Any, BinaryIO, Literal

import numpy as np

from pcbench.errors import InputError
from pcbench.io.columns import excerpt
from pcbench.io.files import errors_named, with_line_feeds
from pcbench.io.names import XYZ, repeated_name, standard_names

_MAX_HEADER_BYTES = 1 << 20
_MAX_COUNT_DIGITS = 18  # 10^18 rows are more than any file contains; products with row sizes are checked later
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
TYPE_NAMES = {code: name for name, code in reversed(_TYPES.items())}  # the older names, which all readers support
_SURFACE = re.compile(r"^(tri|quad|poly|face|mesh|patch)|(strip|fan|grid)s?$")  # names of elements
_POLYGONS = ("vertex_indices", "vertex_index")  # names of the list of a face


@dataclass(frozen=True)
class Property:
    """Scalar, or list whose length is stored before it with the type `length`."""

    name: str
    dtype: np.dtype[Any]
    length: np.dtype[Any] | None = None


@dataclass(frozen=True)
class Element:
    """Element with `count` rows, each with the same properties in the same order."""

    name: str
    count: int
    properties: list[Property] = field(default_factory=list)

    @property
    def scalars(self) -> list[Property]:
        """Scalar properties, in order."""
        return [prop for prop in self.properties if prop.length is None]

    @property
    def lists(self) -> list[Property]:
        """List properties, in order."""
        return [prop for prop in self.properties if prop.length is not None]

    @property
    def polygon(self) -> Property | None:
        """List of a row's vertex indices: the first with one of the usual names."""
        return next((prop for prop in self.lists if prop.name in _POLYGONS), None)

    @property
    def least_bytes(self) -> int:
        """Bytes of the smallest row, with three corners in each list."""
        lists = sum(prop.length.itemsize + 3 * prop.dtype.itemsize for prop in self.properties if prop.length)
        return sum(prop.dtype.itemsize for prop in self.scalars) + lists

    @property
    def least_characters(self) -> int:
        """Characters of the shortest row of an ascii file: one for each number, and the spaces between them."""
        return 2 * (len(self.scalars) + 4 * len(self.lists)) - 1

    @property
    def is_grid(self) -> bool:
        """Return whether the element is the grid of a range scan, which arranges its points."""
        return "grid" in self.name.lower()

    def count_text(self, count: int | None = None) -> str:
        """Describe the number of rows, such as "8 vertices", or a part of it, such as "3 of 8 vertices"."""
        plural = {"vertex": "vertices", "face": "faces", "edge": "edges"}.get(self.name, f"{self.name[:40]!r} elements")
        return f"{self.count} {plural}" if count is None else f"{count} of {self.count} {plural}"

    def place_after(self, complete: int) -> str:
        """Return the place after `complete` rows, for a message."""
        return f"after {self.count_text(complete)}"

    def truncation_error(self, complete: int) -> InputError:
        """Return the error of a file that ends after `complete` rows."""
        return InputError(f"truncated: got {self.count_text(complete)}: copy or export the file again")


@dataclass(frozen=True)
class PlyHeader:
    """Parsed header of a PLY file."""

    byte_order: Literal["<", ">"] | None  # None: ascii
    elements: list[Element]
    comments: list[str]
    nbytes: int  # up to the first element

    def element(self, name: str) -> Element | None:
        """Return the element of a name, or None."""
        return next((element for element in self.elements if element.name == name), None)

    @property
    def surface(self) -> list[Element]:
        """Elements that describe a surface between the vertices, whether they can be read or not."""
        named = (e for e in self.elements if e.name != "vertex" and e.count)
        return [e for e in named if e.polygon is not None or _SURFACE.search(e.name.lower())]

    def tag_value(self, tag: str) -> str | None:
        """Return the text after a tag in a comment line, such as `comment crs EPSG:32617`."""
        return next((c.removeprefix(tag).strip() for c in self.comments if c.startswith(f"{tag} ")), None)


def check_vertices(header: PlyHeader) -> None:
    """Raise InputError if there are no vertices with x, y and z as numbers."""
    vertex = header.element("vertex")
    if vertex is None:
        names = ", ".join(repr(element.name[:40]) for element in header.elements[:10]) or "none"
        raise InputError(f"expected an element 'vertex', got {names}: export the file again")
    for prop in vertex.properties:
        if prop.name in XYZ and prop.length is not None:
            raise InputError(f"expected property {prop.name!r} as a number, got a list: export the file again")
    properties = [prop.name for prop in vertex.properties]
    if missing := [name for name in XYZ if name not in properties]:
        raise InputError(
            f"expected vertex properties x, y, z; missing: {', '.join(missing)} among {', '.join(properties)[:100]}:"
            " export it with coordinates"
        )
    if not vertex.count:
        raise InputError("expected at least one point, got 0 vertices: export the file again")


def check_faces(header: PlyHeader) -> None:
    """Raise InputError if a surface is not stored as lists of vertex indices, or there is none."""
    got = next((repr(e.name[:40]) for e in header.surface if e.polygon is None or e.is_grid), None)
    if got is not None or not header.surface:
        raise InputError(
            f"expected an element 'face' or 'tristrips' with a list {' or '.join(_POLYGONS)}, got {got or 'no faces'}:"
            " export it as a mesh of triangles"
        )


def read_header(file: BinaryIO) -> PlyHeader:
    """Read the header including the line `end_header`, so that the file position is at the body.

    Raises:
        InputError: the file does not start with a PLY header.
        OSError: the file cannot be read.
    """
    header = _parse_header(with_line_feeds(file, _MAX_HEADER_BYTES + 1))
    file.seek(header.nbytes)
    return header


def _parse_header(file: BinaryIO) -> PlyHeader:
    magic = file.readline(16)
    if magic.rstrip() != b"ply":
        if magic.startswith(b"LASF"):
            raise InputError("expected a PLY file, got a LAS file: rename it to .las or .laz")
        raise InputError(f"expected a PLY file that starts with a line 'ply', got {magic!r}: export it again as PLY")
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
                f"expected end_header within {_MAX_HEADER_BYTES} header bytes, got none: export the file again"
            )
        if not line:
            raise InputError(
                f"truncated: the header ends after line {number - 1} without end_header: copy the file again"
            )
        words = line.split()
        if words == [b"end_header"]:
            break
        with errors_named(f"header line {number}"):
            if b"\0" in line:
                raise InputError("expected text, got a NUL byte: export the file again")
            if words and words[0] in (b"comment", b"obj_info"):  # free text in any encoding
                if words[0] == b"comment":
                    comments.append(b" ".join(words[1:]).decode("utf-8", errors="replace"))
                continue
            if not line.isascii() or not b" ".join(words).decode().isprintable():
                raise InputError(f"expected ASCII text, got {excerpt(line)}: export it again")
            match [word.decode() for word in words]:
                case []:
                    pass
                case ["format", name, "1.0"] if name in _BYTE_ORDERS and not formats:
                    byte_order = _BYTE_ORDERS[name]
                    formats.append(name)
                case ["format", *_] if formats:
                    raise InputError("expected one format line, got a second: export the file again")
                case ["format", *_]:
                    raise InputError(
                        f"expected 'format {', '.join(_BYTE_ORDERS)} 1.0', got {excerpt(line)}: export it again"
                    )
                case ["element", name, count]:
                    if name in elements:
                        raise InputError(f"expected unique elements, got {name[:40]!r} twice: export it again")
                    elements[name] = current = Element(name, _count(count, name))
                case ["property", *rest] if elements:
                    current.properties.append(_property(rest))
                case ["property", *_]:
                    raise InputError("expected an element before the first property: export it again")
                case _:
                    raise InputError(
                        f"expected format, element, property, comment or end_header, got {excerpt(line)}"
                        ": export it again"
                    )
    if not formats:
        raise InputError(f"header: expected a format line ({', '.join(_BYTE_ORDERS)}), got none: export the file again")
    if (vertex := elements.get("vertex")) is not None:
        elements["vertex"] = _with_standard_names(vertex)
    ordered = [_with_byte_order(element, byte_order or "=") for element in elements.values()]
    return PlyHeader(byte_order, ordered, comments, used)


def _count(word: str, element: str) -> int:
    if not word.isdigit():
        raise InputError(
            f"expected the count of {element!r} as an integer of at least 0, got {word[:40]!r}: export it again"
        )
    if len(word) > _MAX_COUNT_DIGITS:
        raise InputError(f"{word[:40]} of {element!r} are more than any file contains: export it again")
    return int(word)


def _property(words: list[str]) -> Property:
    match words:
        case ["list", length, item, name]:
            counter = _type(length)
            if counter.kind == "f":
                raise InputError(f"expected an integer type for the list length, got {length!r}: export it again")
            return Property(name, _type(item), counter)
        case [item, name] if item != "list":
            return Property(name, _type(item))
    raise InputError(
        f"expected 'property TYPE NAME' or 'property list TYPE TYPE NAME', got {' '.join(['property', *words])[:60]!r}:"
        " export it again"
    )


def _type(word: str) -> np.dtype[Any]:
    if word not in _TYPES:
        raise InputError(f"expected a type of {', '.join(_TYPES)}; got {word[:40]!r}: export it again")
    return np.dtype(_TYPES[word])


def _with_standard_names(vertex: Element) -> Element:
    names = [prop.name for prop in vertex.properties]
    if twice := repeated_name(names):
        raise InputError(f"expected unique vertex properties, got {twice[:40]!r} twice: rename one of them")
    properties = [replace(prop, name=name) for prop, name in zip(vertex.properties, standard_names(names), strict=True)]
    return replace(vertex, properties=properties)


def _with_byte_order(element: Element, byte_order: Literal["<", ">", "="]) -> Element:
    properties = [
        Property(p.name, p.dtype.newbyteorder(byte_order), p.length and p.length.newbyteorder(byte_order))
        for p in element.properties
    ]
    return Element(element.name, element.count, properties)
