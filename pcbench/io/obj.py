"""Read Wavefront OBJ: meshes, and points with colours and normals.

Why not trimesh: trimesh 5.2 reads vertex 0, which is invalid, as the last vertex. Other invalid indices cause an
IndexError without a line number. It silently leaves out points and lines, and refuses files in which only some vertices
have colours. It would also be a dependency.
"""

from __future__ import annotations

import re
from array import array
from pathlib import Path

import numpy as np

from pcbench.errors import InputError
from pcbench.geometry.mesh import Mesh
from pcbench.io.columns import excerpt
from pcbench.io.files import Fields, Look, Warn
from pcbench.io.names import COLORS, NORMALS, Columns, take_fields
from pcbench.io.polygons import left_out_surface, triangulate

_CURVED = (b"surf", b"bsp", b"bzp", b"cdp")  # free-form surfaces and patches
_KEYWORDS = (b"v", b"f", b"fo", b"l", b"p", b"curv", *_CURVED)  # "fo" is "f" in old files

_SURFACES = (b"f", b"fo", *_CURVED)
_SURFACE = re.compile(rb"(?:^|\r)[ \t]*(fo?|surf|bsp|bzp|cdp)[ \t]", re.MULTILINE)


def look_at_obj(path: Path) -> Look:
    """Search for faces or curved surfaces, without which a file is a cloud.

    Raises:
        OSError: the file cannot be read.
    """
    return Look(_SURFACE.search(path.read_bytes()) is not None)


def read_obj_points(path: Path, warn: Warn) -> Fields:
    """Read the vertices as `read_obj_vertices` does, with a warning if they belong to a mesh."""
    data = path.read_bytes()
    fields = _vertices(data, warn)
    if surfaces := len(_SURFACE.findall(data)):
        warn(left_out_surface(len(fields["points"]), f"{surfaces} face{'s' * (surfaces > 1)}"))
    return fields


def read_obj_vertices(path: Path, warn: Warn) -> Fields:
    """Read lines `v x y z` or `v x y z r g b`, and the normals of lines `vn` if there is one for each vertex.

    Raises:
        InputError: a line is malformed, or there are no vertices.
        OSError: the file cannot be read.
    """
    return _vertices(path.read_bytes(), warn)


def _vertices(data: bytes, warn: Warn) -> Fields:
    rows: dict[bytes, list[list[float]]] = {b"v": [], b"vn": []}
    with_faces = False
    for number, line in enumerate(_lines(data), 1):
        words = line.split()
        if not words or words[0] not in rows:
            with_faces |= bool(words) and words[0] in _SURFACES
            continue
        try:
            if b"_" in line or len(words) < 4:
                raise ValueError
            rows[words[0]].append([float(word) for word in words[1:]])
        except ValueError:
            raise InputError(
                f"line {number}: expected '{words[0].decode()} x y z', got {excerpt(line)}: export it again"
            ) from None
    vertices, normals = rows[b"v"], rows[b"vn"]
    if not vertices:
        raise InputError("expected at least one line 'v x y z', got none: export the file again")
    points = np.array([row[:3] for row in vertices])
    columns: Columns = {}
    colored = sum(len(row) >= 6 for row in vertices)
    if colored == len(vertices):
        columns |= dict(zip(COLORS, np.array([row[3:6] for row in vertices]).T, strict=True))
    elif colored:
        warn(f"left out the colours, which only {colored} of {len(vertices)} vertices have")
    if len(normals) == len(vertices) and not with_faces:  # faces assign normals to corners
        columns |= dict(zip(NORMALS, np.array([row[:3] for row in normals]).T, strict=True))
    fields = take_fields(columns, warn)
    return Fields(points=points, normals=fields.normals, colors=fields.colors, attributes=fields.attributes)


def _lines(data: bytes) -> list[bytes]:
    """Return the lines without a byte order mark, which would hide the first vertex; a backslash joins two."""
    data = data.removeprefix(b"\xef\xbb\xbf")
    return re.sub(rb"\\(\r\n?|\n)", b" ", data).splitlines()


def read_obj(path: Path, warn: Warn) -> Mesh:
    """Read lines `v x y z` and `f a b c ...`; a corner `7/2/3` is vertex 7, and -1 is the last vertex so far.

    Raises:
        InputError: a line is malformed, refers to a vertex that does not exist, or is a curved surface.
        OSError: the file cannot be read.
    """
    coordinates, lengths, corners = array("d"), array("q"), array("q")
    left_out = 0
    for number, line in enumerate(_lines(path.read_bytes()), 1):
        words = line.split()
        if not words or words[0] not in _KEYWORDS:
            continue
        if words[0] in _CURVED:
            curved = words[0].decode()
            raise InputError(f"line {number}: expected polygons (f), got a curved surface ({curved}): export polygons")
        try:
            if b"_" in line:  # Python reads 1_000 as a number; OBJ does not
                raise ValueError
            if words[0] == b"v":
                x, y, z = words[1:4]
                coordinates.extend((float(x), float(y), float(z)))
            elif words[0] in (b"f", b"fo"):
                count = len(coordinates) // 3
                for word in words[1:]:
                    corner = int(word.partition(b"/")[0])
                    if not -count <= corner or not corner:  # a larger index may refer to a later vertex
                        raise ValueError
                    corners.append(corner - 1 if corner > 0 else count + corner)
                lengths.append(len(words) - 1)
            else:
                left_out += 1
        except (ValueError, OverflowError):
            expected = "'v x y z'" if words[0] == b"v" else f"'f a b c' with vertices 1 to {len(coordinates) // 3}"
            raise InputError(f"line {number}: expected {expected}, got {excerpt(line)}: export it again") from None
    if left_out:
        warn(f"left out {left_out} point and line elements")
    if not lengths:
        raise InputError("expected a mesh with at least one face (f), got none: export it as a mesh, or points as PLY")
    vertices = np.frombuffer(coordinates, dtype=np.float64).reshape(-1, 3)
    faces = triangulate(vertices, np.frombuffer(lengths, dtype=np.int64), np.frombuffer(corners, dtype=np.int64), warn)
    return Mesh(vertices, faces)
