"""Read glTF meshes (.glb and .gltf) with trimesh in a child process, after checking the sizes in the file."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import unquote

import numpy as np

from pcbench.children import Limits, run_script
from pcbench.errors import InputError
from pcbench.extras import require
from pcbench.geometry.mesh import Mesh
from pcbench.io import trimesh_child
from pcbench.io.files import MAX_PADDING, Warn, check_end
from pcbench.io.polygons import merge_vertices
from pcbench.regular_files import read_bytes, regular_status
from pcbench.scratch import scratch_folder

_TRIANGLES, _FAN = "4", "6"  # modes of primitives: glTF 2.0, section 5.24.4
_LINES_AND_POINTS = {"0": "points", "1": "lines", "2": "lines", "3": "lines"}
COMPRESSED = ("KHR_draco", "EXT_meshopt", "KHR_meshopt")
"""Starts of the names of extensions that replace the plain arrays."""
_LEAST_CHUNK_BYTES = 12  # size, type, and data in steps of four bytes
INSTANCED = "EXT_mesh_gpu_instancing"
"""Extension that repeats a mesh."""


class Document(NamedTuple):
    """The JSON of a file, and the binary chunk of a .glb file if it has one."""

    content: Any
    body: bytes | None = None


def read_document(path: Path, warn: Warn) -> Document:
    """Read the JSON and the binary chunk of a .glb file, or the JSON of a .gltf file.

    The chunk lengths are checked before anything is parsed: glTF 2.0, section 4.4.

    Raises:
        InputError: the file is truncated or no glTF.
        OSError: the file cannot be read.
    """
    if path.suffix.lower() == ".gltf":
        return Document(_parse(path.read_bytes()))
    size = path.stat().st_size
    chunks = []
    with path.open("rb") as file:
        magic, version, length = struct.unpack("<4sII", file.read(12).ljust(12, b"\0"))
        if magic != b"glTF" or version != 2:
            raise InputError(f"expected a binary glTF 2 file, got {magic!r} version {version}: export it as glTF 2")
        if length > size:
            raise InputError(f"truncated: got {size} of {length} bytes: copy or export the file again")
        file.seek(length)
        check_end(file.read(MAX_PADDING), size - length, _LEAST_CHUNK_BYTES, "the last chunk", warn)
        offset = 12
        while offset < length:
            file.seek(offset)
            chunk, kind = struct.unpack("<I4s", file.read(8).ljust(8, b"\0"))
            chunks.append((kind, offset + 8, chunk))
            offset += 8 + chunk
        if offset != length:
            raise InputError(
                f"truncated: the last chunk ends at byte {offset} of {length}: copy or export the file again"
            )
        kind, start, length = chunks[0] if chunks else (b"", 12, 0)
        if kind != b"JSON":
            raise InputError(f"expected JSON as the first chunk, got {kind!r}: export the file again")
        file.seek(start)
        content = _parse(file.read(length))
        body = None
        if len(chunks) > 1 and chunks[1][0] == b"BIN\0":
            file.seek(chunks[1][1])
            body = file.read(chunks[1][2])
    return Document(content, body)


def read_glb(path: Path, warn: Warn) -> Mesh:
    """Read all triangles of a binary glTF file.

    Raises:
        InputError: the file is truncated, or trimesh cannot read it.
        MissingExtra: trimesh is not installed.
        OSError: the file cannot be read.
    """
    return _read_with_trimesh(path, read_document(path, warn).content, warn)


def read_gltf(path: Path, warn: Warn) -> Mesh:
    """Read all triangles of a glTF file and the files that it refers to; raises as `read_glb` does."""
    content = _parse(path.read_bytes())
    for uri in _external_uris(content):
        try:
            regular_status(local_file(path, uri))
        except InputError as error:
            raise InputError(f"referenced file {uri}: {error}") from error
        except OSError:  # trimesh reports missing files
            continue
    return _read_with_trimesh(path, content, warn)


def _parse(text: bytes) -> Any:
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(f"expected glTF, which is JSON: {str(error)[:100]}: export the file again") from error


def _check_geometry(content: Any, warn: Warn) -> None:
    """Check that trimesh reads all surfaces of a file: it leaves out others, or reads them wrongly, without a word.

    Raises:
        InputError: the file has surfaces of another kind, or no surface.
    """
    unsupported = [name for name in entries(content, "extensionsRequired") if str(name).startswith(COMPRESSED)]
    unsupported += [name for name in entries(content, "extensionsUsed") if name == INSTANCED]
    if unsupported:
        raise InputError(f"expected plain triangles, got {str(unsupported[0])[:60]}: export it without this extension")
    if any(isinstance(entry, dict) and "sparse" in entry for entry in entries(content, "accessors")):
        raise InputError("expected plain arrays, got sparse accessors: export the file without them")
    primitives = [p for mesh in entries(content, "meshes") for p in entries(mesh, "primitives")]
    modes = [str(p.get("mode", _TRIANGLES)) for p in primitives if isinstance(p, dict)]
    if _FAN in modes:
        raise InputError("expected triangles or triangle strips, got triangle fans: export it as triangles")
    if any(_is_normalized(content, primitive) for primitive in primitives):
        raise InputError("expected positions as lengths, got normalized integers: export them as floats")
    if any(isinstance(mesh, dict) and any(entries(mesh, "weights")) for mesh in entries(content, "meshes")):
        warn("the shape is that without its morph targets, which have weights: export it with its modifiers applied")
    left_out = [_LINES_AND_POINTS[mode] for mode in modes if mode in _LINES_AND_POINTS]
    if left_out:
        kinds = " and ".join(sorted(set(left_out)))
        if len(left_out) == len(modes):
            raise InputError(f"expected triangles, got only {kinds}: export a mesh, or points as PLY")
        warn(f"left out {len(left_out)} of {len(modes)} parts, which are {kinds}")


def _is_normalized(content: Any, primitive: Any) -> bool:
    """Return whether positions are integers from -1 to 1, which trimesh does not scale."""
    attributes = primitive.get("attributes") if isinstance(primitive, dict) else None
    number = attributes.get("POSITION") if isinstance(attributes, dict) else None
    accessors = entries(content, "accessors")
    accessor = accessors[number] if isinstance(number, int) and 0 <= number < len(accessors) else None
    return isinstance(accessor, dict) and accessor.get("normalized") is True


def entries(content: Any, name: str) -> list[Any]:
    """Return a list of the document; empty if it has none of this name."""
    values = content.get(name) if isinstance(content, dict) else None
    return values if isinstance(values, list) else []


def external_files(path: Path) -> list[Path]:
    """Return the existing files that a glTF file refers to; none if it is no valid glTF file."""
    if path.suffix.lower() != ".gltf":
        return []
    try:
        uris = _external_uris(json.loads(read_bytes(path, path.stat().st_size)))
    except (ValueError, RecursionError):  # `read_gltf` says so
        return []
    return [file for file in dict.fromkeys(local_file(path, uri) for uri in uris) if file.is_file()]


def local_file(path: Path, uri: str) -> Path:
    """Return the path of a file that a glTF file refers to."""
    return path.parent / unquote(uri)


def _external_uris(content: Any) -> list[str]:
    """Return the names of the external files that a glTF file refers to."""
    parts = [e for kind in ("buffers", "images") for e in entries(content, kind) if isinstance(e, dict)]
    uris = [entry.get("uri") for entry in parts]
    return [uri for uri in uris if isinstance(uri, str) and not uri.startswith("data:")]


def _read_with_trimesh(path: Path, content: Any, warn: Warn) -> Mesh:
    """Read all meshes of the file's scene, each transformed by its node. The unit of glTF is the metre."""
    _check_geometry(content, warn)
    size = path.stat().st_size
    memory, seconds = (2 << 30) + 60 * size, 30 + size // 1_000_000
    # One thread: each thread of a pool takes address space, which is limited.
    one_thread = {"OPENBLAS_NUM_THREADS": "1"}
    with scratch_folder() as folder:
        outputs = [folder / "vertices.npy", folder / "faces.npy"]
        limits = Limits(seconds=2 * seconds, cpu_seconds=seconds, memory=memory)
        done = run_script(
            trimesh_child.__file__, str(path.resolve()), *map(str, outputs), limits=limits, environment=one_thread
        )
        if done.timed_out:
            raise InputError(f"trimesh did not finish within {2 * seconds} s: simplify the mesh or convert it to PLY")
        if done.code:
            require("trimesh")
            reason_given = done.last_error_line or f"exit status {done.code}"
            reason = "".join(c if c.isprintable() else " " for c in reason_given)[:200]
            raise InputError(f"trimesh cannot read it: {reason}")
        vertices, faces = (np.load(output, allow_pickle=False) for output in outputs)
    return merge_vertices(Mesh(vertices, faces, unit="m"))
