"""Triangle meshes from files: STL, OBJ, OFF and PLY by own readers, glTF by trimesh in a process of its own."""

from __future__ import annotations

import importlib.util
import json
import os
import re
import struct
import tempfile
import warnings
from array import array
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from pcbench.children import Limits, run_script
from pcbench.errors import InputError, MissingExtra
from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.mesh import Mesh
from pcbench.io import trimesh_child
from pcbench.io.files import Warn, check_readable
from pcbench.io.ply import holds_faces, read_ply_faces

_WORD_LIMIT = 32  # characters of a number in a text file


def read_mesh(path: str | os.PathLike[str], on_warning: Callable[[str], None] | None = None) -> Mesh:
    """The triangle mesh in a file; polygons are cut into fans of triangles.

    Where a format repeats a vertex for each face (STL) or texture seam (glTF), exactly equal vertices are merged, so
    that a closed surface is closed. glTF's axes stay as they are in the file, y up.

    Args:
        path: an .stl, .obj, .ply, .glb, .gltf or .off file, in upper or lower case.
        on_warning: called with one line for each thing left out; `warnings.warn` if not given.

    Raises:
        InputError: the file cannot be read or is not what its extension says; the message starts with the path.
        MissingExtra: the format needs trimesh, which is not installed.
    """
    path = Path(path)
    notes: list[str] = []
    try:
        check_readable(path)
        mesh = _reader(path)(path, notes.append)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    except MemoryError as error:
        raise InputError(f"{path}: does not fit into memory") from error
    for note in notes:
        if on_warning is None:
            warnings.warn(f"{path}: {note}", stacklevel=2)
        else:
            on_warning(f"{path}: {note}")
    return mesh


def holds_mesh(path: str | os.PathLike[str]) -> bool:
    """Whether the file is a mesh by its extension, or a PLY file whose header, all that is read, tells of faces."""
    path = Path(path)
    if path.suffix.lower() != ".ply":
        return path.suffix.lower() in _READERS
    try:
        check_readable(path)
        return holds_faces(path)
    except (InputError, OSError):
        return False  # whoever reads it says what is wrong


def _reader(path: Path) -> Callable[[Path, Warn], Mesh]:
    extension = path.suffix.lower()
    if extension not in _READERS:
        known = ", ".join(_READERS)
        raise InputError(f"expected a mesh file that ends in {known}; got {extension or 'no extension'!r}")
    return _READERS[extension]


def _merged(mesh: Mesh) -> Mesh:
    """The same faces, of vertices of which no two are equal."""
    order = np.lexsort(mesh.vertices.T)
    ordered = mesh.vertices[order]
    first = np.ones(len(order), dtype=bool)
    first[1:] = (ordered[1:] != ordered[:-1]).any(axis=1)
    number = np.empty(len(order), dtype=np.int64)
    number[order] = np.cumsum(first) - 1
    return replace(mesh, vertices=ordered[first], faces=number[mesh.faces])


def _fans(lengths: IntArray, corners: IntArray, warn: Warn) -> IntArray:
    """Triangles (F, 3) of polygons that have `lengths` (P,) of the vertex numbers `corners`, one after the other."""
    if small := int(np.count_nonzero(lengths < 3)):
        warn(f"left out {small} of {len(lengths)} faces with fewer than three corners")
    triangles = np.maximum(lengths - 2, 0)
    first = np.repeat(np.cumsum(lengths) - lengths, triangles)
    step = np.arange(len(first)) - np.repeat(np.cumsum(triangles) - triangles, triangles)
    return np.stack([corners[first], corners[first + step + 1], corners[first + step + 2]], axis=1)


# ---- PLY ----------------------------------------------------------------------------------------------------------


def _read_ply(path: Path, warn: Warn) -> Mesh:
    fields, polygons = read_ply_faces(path)
    return Mesh(fields["points"], _fans(*polygons, warn), crs=fields["crs"], unit=fields["unit"])


# ---- STL ----------------------------------------------------------------------------------------------------------

_STL_ROW = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("color", "<u2")])
_STL_FACET = b"facet normal 0 0 0 outer loop vertex 0 0 0 vertex 0 0 0 vertex 0 0 0 endloop endfacet".split()
_STL_WORDS = [place for place, word in enumerate(_STL_FACET) if word != b"0"]
_STL_CORNERS = [8, 9, 10, 12, 13, 14, 16, 17, 18]


def _read_stl(path: Path, warn: Warn) -> Mesh:
    # Many binary files start with "solid" too: the size decides, then the word.
    data = path.read_bytes()
    count = struct.unpack_from("<I", data, 80)[0] if len(data) >= 84 else 0
    if len(data) >= 84 and len(data) == 84 + _STL_ROW.itemsize * count:
        corners = np.frombuffer(data, _STL_ROW, count, 84)["corners"].astype(np.float64)
    elif data[:512].lstrip()[:5].lower() == b"solid":
        corners = _ascii_stl(data)
    elif len(data) < 84:
        raise InputError(f"expected an STL file: 84 bytes or more, or the word 'solid'; got {len(data)} bytes")
    else:
        there = (len(data) - 84) // _STL_ROW.itemsize
        if there < count:
            raise InputError(f"truncated: {there} of {count} triangles: copy or export the file again")
        raise InputError(
            f"expected {84 + 50 * count} bytes for {count} triangles, got {len(data)}: header and body disagree"
        )
    vertices = corners.reshape(-1, 3)
    return _merged(Mesh(vertices, np.arange(len(vertices)).reshape(-1, 3)))


def _ascii_stl(data: bytes) -> FloatArray:
    """Corners (F, 3, 3). Every facet is the same 21 words: a table."""
    if b"endsolid" not in data[-512:].lower():
        raise InputError("truncated: expected an ascii STL file to end with 'endsolid': copy or export it again")
    words = re.sub(rb"(?im)^[ \t]*(end)?solid\b.*$", b"", data).split()
    if not words:
        raise InputError("expected a mesh with at least one face, got an STL file without facets")
    if max(map(len, words)) > _WORD_LIMIT:
        raise InputError(f"expected words of at most {_WORD_LIMIT} characters: the file is damaged")
    whole = len(words) - len(words) % len(_STL_FACET)
    table = np.array(words[:whole]).reshape(-1, len(_STL_FACET))
    wrong = np.flatnonzero((np.char.lower(table[:, _STL_WORDS]) != np.array(_STL_FACET)[_STL_WORDS]).any(axis=1))
    if len(wrong) or whole < len(words):
        facet = wrong[0] if len(wrong) else len(table)
        raise InputError(f"facet {facet}: expected 'facet normal x y z outer loop vertex x y z ... endloop endfacet'")
    try:
        return table[:, _STL_CORNERS].astype(np.float64).reshape(-1, 3, 3)
    except ValueError as error:
        raise InputError(f"expected coordinates as numbers: {str(error)[:80]}") from error


# ---- OBJ ----------------------------------------------------------------------------------------------------------


def _read_obj(path: Path, warn: Warn) -> Mesh:
    """Lines `v x y z` and `f a b c ...`; a corner `7/2/3` is vertex 7, and -1 is the last one so far."""
    coordinates, lengths, corners = array("d"), array("q"), array("q")
    left_out = 0
    for number, line in enumerate(path.read_bytes().replace(b"\\\r\n", b" ").replace(b"\\\n", b" ").splitlines(), 1):
        words = line.split()
        if not words or words[0] not in (b"v", b"f", b"l", b"p"):
            continue
        try:
            if b"_" in line:  # Python reads 1_000 as a number; OBJ does not
                raise ValueError
            if words[0] == b"v":
                x, y, z = words[1:4]
                coordinates.extend((float(x), float(y), float(z)))
            elif words[0] == b"f":
                known = len(coordinates) // 3
                for word in words[1:]:
                    corner = int(word.partition(b"/")[0])
                    if not -known <= corner or not corner:  # too high a number may name a vertex still to come
                        raise ValueError
                    corners.append(corner - 1 if corner > 0 else known + corner)
                lengths.append(len(words) - 1)
            else:
                left_out += 1
        except (ValueError, OverflowError):
            expected = "'v x y z'" if words[0] == b"v" else f"'f a b c' with vertices 1 to {len(coordinates) // 3}"
            shown = repr(line.strip()[:60])[1:]
            raise InputError(f"line {number}: expected {expected}, got {shown}") from None
    if left_out:
        warn(f"left out {left_out} points and lines")
    vertices = np.frombuffer(coordinates, dtype=np.float64).reshape(-1, 3)
    faces = _fans(np.frombuffer(lengths, dtype=np.int64), np.frombuffer(corners, dtype=np.int64), warn)
    return Mesh(vertices, faces)


# ---- OFF ----------------------------------------------------------------------------------------------------------

_OFF = (b"OFF", b"COFF", b"NOFF", b"CNOFF")  # colours and normals follow the coordinates


def _read_off(path: Path, warn: Warn) -> Mesh:
    """The word OFF, three counts, a line `x y z ...` a vertex, a line `3 a b c ...` a face; # starts a comment."""
    lines = [line.partition(b"#")[0].split() for line in path.read_bytes().splitlines()]
    lines = [words for words in lines if words]
    if not lines or lines[0][0] not in _OFF:
        raise InputError(f"expected an OFF file that starts with 'OFF', got {b' '.join(lines[0])[:20]!r}" if lines
                         else "expected an OFF file, got an empty one")  # fmt: skip
    counts = lines[0][1:] or (lines[1] if len(lines) > 1 else [])
    if len(counts) not in (2, 3) or not all(word.isdigit() and len(word) < 19 for word in counts):
        raise InputError(f"expected counts of vertices, faces and edges, got {b' '.join(counts)[:40]!r}")
    vertex_count, face_count = int(counts[0]), int(counts[1])
    body = lines[1 if lines[0][1:] else 2 :]
    if len(body) < vertex_count + face_count:
        what = f"{len(body)} of {vertex_count} vertices"
        if len(body) >= vertex_count:
            what = f"{len(body) - vertex_count} of {face_count} faces"
        raise InputError(f"truncated: {what}: copy or export the file again")
    if extra := len(body) - vertex_count - face_count:
        raise InputError(f"{extra} lines after the last face: header and body disagree, export the file again")
    vertices = np.empty((vertex_count, 3))
    lengths, corners = array("q"), array("q")
    for number, words in enumerate(body):
        try:
            if number < vertex_count:
                vertices[number] = [float(word) for word in words[:3]]
            else:
                length = int(words[0])
                corners.extend([int(word) for word in words[1 : 1 + length]])
                lengths.append(length)
                if not 0 <= length < len(words):
                    raise ValueError
        except (ValueError, OverflowError):
            what = f"vertex {number}" if number < vertex_count else f"face {number - vertex_count}"
            expected = "x y z" if number < vertex_count else "a count and as many vertices"
            raise InputError(f"{what}: expected {expected}, got {b' '.join(words)[:60]!r}") from None
    faces = _fans(np.frombuffer(lengths, dtype=np.int64), np.frombuffer(corners, dtype=np.int64), warn)
    return Mesh(vertices, faces)


# ---- glTF ----------------------------------------------------------------------------------------------------


def _read_glb(path: Path, warn: Warn) -> Mesh:
    """The chunks are followed before anything is parsed: glTF 2.0, section 4.4."""
    size = path.stat().st_size
    with path.open("rb") as file:
        magic, version, length = struct.unpack("<4sII", file.read(12).ljust(12, b"\0"))
        if magic != b"glTF" or version != 2:
            raise InputError(f"expected a binary glTF 2 file, got {magic!r} version {version}")
        if length != size:
            raise InputError(
                f"truncated: {size} of {length} bytes" if length > size else f"{size - length} bytes too many"
            )
        place = 12
        while place < size:
            file.seek(place)
            (chunk,) = struct.unpack("<I", file.read(4).ljust(4, b"\0"))
            place += 8 + chunk
        if place != size:
            raise InputError(f"truncated: the last chunk ends at byte {place} of {size}")
    return _read_with_trimesh(path)


def _read_gltf(path: Path, warn: Warn) -> Mesh:
    try:
        json.loads(path.read_bytes())
    except (ValueError, RecursionError) as error:
        raise InputError(f"expected glTF, which is JSON: {str(error)[:100]}") from error
    return _read_with_trimesh(path)


def _read_with_trimesh(path: Path) -> Mesh:
    """All meshes of the file's scene, each where its node puts it; glTF's unit is the metre."""
    if importlib.util.find_spec("trimesh") is None:
        raise MissingExtra("trimesh", "mesh")
    size = path.stat().st_size
    memory, seconds = (2 << 30) + 60 * size, 30 + size // 1_000_000
    # One thread: a thread pool takes address space, which is what is limited.
    one_thread = {"OPENBLAS_NUM_THREADS": "1"}
    with tempfile.TemporaryDirectory(prefix="pcbench-") as folder:
        outputs = [Path(folder) / "vertices.npy", Path(folder) / "faces.npy"]
        limits = Limits(seconds=2 * seconds, cpu_seconds=seconds, memory=memory)
        done = run_script(
            trimesh_child.__file__, str(path.resolve()), *map(str, outputs), limits=limits, environment=one_thread
        )
        if done.timed_out:
            raise InputError(f"cannot be read: trimesh is not through with it after {2 * seconds} s")
        if done.code:
            said = done.last_words or f"it ended with {done.code}"
            reason = "".join(c if c.isprintable() else " " for c in said)[:200]
            raise InputError(f"trimesh cannot read it: {reason}")
        vertices, faces = (np.load(output, allow_pickle=False) for output in outputs)
    return _merged(Mesh(vertices, faces, unit="m"))


_READERS: dict[str, Callable[[Path, Warn], Mesh]] = {
    ".stl": _read_stl,
    ".obj": _read_obj,
    ".ply": _read_ply,
    ".glb": _read_glb,
    ".gltf": _read_gltf,
    ".off": _read_off,
}
