"""Read STL meshes, binary and ascii.

Why not trimesh: trimesh 5.2 reads a truncated file, or one with a wrong triangle count, as an empty mesh. In ascii
files it drops a facet of two vertices if the counts add up, and accepts a loop without an end. It would also be a
dependency. Reading a binary file only requires a check of its size (0.2 s for 80,000 facets; trimesh in a child process
takes 1.7 s).
"""

from __future__ import annotations

import re
import struct
from pathlib import Path

import numpy as np

from pcbench.errors import InputError
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.mesh import Mesh
from pcbench.io.files import Warn
from pcbench.io.polygons import merge_vertices

_MAX_WORD = 32  # characters per word in an ascii file
_FACET_RECORD = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("color", "<u2")])
_FACET_WORDS = b"facet normal 0 0 0 outer loop vertex 0 0 0 vertex 0 0 0 vertex 0 0 0 endloop endfacet".split()
_KEYWORD_POSITIONS = [position for position, word in enumerate(_FACET_WORDS) if word != b"0"]
_CORNER_POSITIONS = [8, 9, 10, 12, 13, 14, 16, 17, 18]


def read_stl(path: Path, warn: Warn) -> Mesh:
    """Read the triangles of an STL file; equal corners become one vertex.

    Raises:
        InputError: the file is truncated, damaged, or has no facet.
        OSError: the file cannot be read.
    """
    # Many binary files start with "solid" too, so the size is checked first.
    data = path.read_bytes()
    count = struct.unpack_from("<I", data, 80)[0] if len(data) >= 84 else 0
    extra = len(data) - 84 - _FACET_RECORD.itemsize * count
    is_ascii = data[:512].lstrip()[:5].lower() == b"solid"
    if len(data) >= 84 and (extra == 0 or (extra > 0 and count and not (is_ascii and b"facet" in data[:1024].lower()))):
        if extra:
            more = extra // _FACET_RECORD.itemsize if data[-extra:].strip(b"\0") else 0
            fit = f", where {more} more would fit" if more else ""
            warn(f"left out {extra} bytes after the last of {count} triangles{fit}")
        corners = np.frombuffer(data, _FACET_RECORD, count, 84)["corners"].astype(np.float64)
    elif is_ascii:
        corners = _ascii_stl(data)
    elif len(data) < 84:
        raise InputError(
            f"expected an STL file of at least 84 bytes or the word 'solid', got {len(data)} bytes: export it again"
        )
    else:
        complete = (len(data) - 84) // _FACET_RECORD.itemsize
        if complete < count:
            raise InputError(f"truncated: got {complete} of {count} triangles: copy or export the file again")
        raise InputError(f"expected triangles, got a count of 0 before {extra} bytes: export the file again")
    vertices = corners.reshape(-1, 3)
    return merge_vertices(Mesh(vertices, np.arange(len(vertices)).reshape(-1, 3)))


def _ascii_stl(data: bytes) -> FloatArray:
    """Parse the corners (F, 3, 3) of an ascii file as a table, since each facet has the same 21 words."""
    data = data.rstrip(b"\0\x1a")
    if b"endsolid" not in data[-512:].lower():
        raise InputError("truncated: expected 'endsolid' at the end of an ascii STL file: copy or export it again")
    words = re.sub(rb"(?i)(?:\A|[\r\n])[ \t]*(end)?solid\b[^\r\n]*", b"\n", data).split()
    if not words:
        raise InputError("expected a mesh with at least one face, got an STL file without facets: export it again")
    if max(map(len, words)) > _MAX_WORD:
        raise InputError(f"expected words of at most {_MAX_WORD} characters, got a longer one: export the file again")
    complete_words = len(words) - len(words) % len(_FACET_WORDS)
    table = np.array(words[:complete_words], dtype=f"S{_MAX_WORD}").reshape(-1, len(_FACET_WORDS))
    damaged = np.flatnonzero(
        (np.char.lower(table[:, _KEYWORD_POSITIONS]) != np.array(_FACET_WORDS)[_KEYWORD_POSITIONS]).any(axis=1)
    )
    if len(damaged) or complete_words < len(words):
        facet = damaged[0] if len(damaged) else len(table)
        raise InputError(
            f"facet {facet}: expected 'facet normal x y z outer loop vertex x y z ... endloop endfacet'"
            ": export it again"
        )
    try:
        return table[:, _CORNER_POSITIONS].astype(np.float64).reshape(-1, 3, 3)
    except ValueError as error:
        raise InputError(f"expected coordinates as numbers: {str(error)[:80]}: export the file again") from error
