"""Directories of TIFF 6.0 and BigTIFF files: tags with their values."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

SHORT, LONG, ASCII, DOUBLE = 3, 4, 2, 12
"""Types of values."""
PLACE = 16
"""Type of places in the file: integers of 64 bits in BigTIFF, of 32 bits in other files."""

Tags = Mapping[int, tuple[int, Sequence[float] | bytes]]
"""The type and the values of each tag, by its number."""

_FORMATS = {SHORT: "H", LONG: "I", DOUBLE: "d", PLACE: "Q"}


class _Variant(NamedTuple):
    """Structures of a kind of TIFF: its header, the number of tags, a tag, and a place in the file."""

    version: int
    header: struct.Struct
    number: struct.Struct
    tag: struct.Struct
    place: struct.Struct


_CLASSIC = _Variant(42, *map(struct.Struct, ("<2sHI", "<H", "<HHI4s", "<I")))
_BIG = _Variant(43, *map(struct.Struct, ("<2sHIQ", "<Q", "<HHQ8s", "<Q")))


def file_header(directories: Sequence[Tags], *, is_big: bool) -> bytes:
    """Return the start of a file, before its pixels: the header and all directories in their order.

    The length depends on the number of values of each tag, and not on the values.

    Args:
        directories: the tags of each image.
        is_big: whether the file is a BigTIFF.
    """
    variant = _BIG if is_big else _CLASSIC
    header = variant.header.pack(b"II", variant.version, *([8] if is_big else []), variant.header.size)
    for number, tags in enumerate(directories, 1):
        header += _directory(tags, len(header), variant, is_last=number == len(directories))
    return header


def read_directory(data: bytes) -> dict[int, Any]:
    """Return the values of the tags in the first directory of a file: bytes of texts, and tuples of numbers.

    Raises:
        ValueError: the file is no little-endian TIFF.
        struct.error: the file is cut off.
        KeyError: a type of values is unknown.
    """
    variant = next((v for v in (_CLASSIC, _BIG) if data[:4] == struct.pack("<2sH", b"II", v.version)), None)
    if variant is None:
        raise ValueError("it is no little-endian TIFF")
    *_, first = variant.header.unpack_from(data)
    (count,) = variant.number.unpack_from(data, first)
    tags: dict[int, Any] = {}
    start = first + variant.number.size
    for entry in range(start, start + count * variant.tag.size, variant.tag.size):
        tag, kind, length, _ = variant.tag.unpack_from(data, entry)
        form = f"<{length}{'s' if kind == ASCII else _FORMATS[kind]}"
        place = entry + variant.tag.size - variant.place.size
        if struct.calcsize(form) > variant.place.size:
            (place,) = variant.place.unpack_from(data, place)
        values = struct.unpack_from(form, data, place)
        tags[tag] = values[0] if kind == ASCII else values
    return tags


def _directory(tags: Tags, start: int, variant: _Variant, *, is_last: bool) -> bytes:
    """Return the directory at a byte offset, followed by the values that do not fit into it."""
    entries, beyond = [], b""
    end = start + variant.number.size + variant.tag.size * len(tags) + variant.place.size
    for tag, (kind, values) in sorted(tags.items()):
        kind = LONG if kind == PLACE and variant is _CLASSIC else kind
        data = values if isinstance(values, bytes) else struct.pack(f"<{len(values)}{_FORMATS[kind]}", *values)
        if len(data) > variant.place.size:
            place, beyond = end + len(beyond), beyond + data + b"\0" * (len(data) % 2)
            data = variant.place.pack(place)
        entries.append(variant.tag.pack(tag, kind, len(values), data))
    following = variant.place.pack(0 if is_last else end + len(beyond))
    return variant.number.pack(len(tags)) + b"".join(entries) + following + beyond
