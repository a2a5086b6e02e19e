"""Read glTF meshes (.glb and .gltf) with trimesh in a child process, after checking the sizes in the file."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np

from pcbench.children import Limits, run_script
from pcbench.errors import InputError
from pcbench.extras import require
from pcbench.geometry.mesh import Mesh
from pcbench.io import trimesh_child
from pcbench.io.files import Warn
from pcbench.io.polygons import merge_vertices
from pcbench.regular_files import read_bytes, regular_status
from pcbench.scratch import scratch_folder


def read_glb(path: Path, warn: Warn) -> Mesh:
    """Read all triangles of a binary glTF file.

    The chunk lengths are checked before anything is parsed: glTF 2.0, section 4.4.

    Raises:
        InputError: the file is truncated, or trimesh cannot read it.
        MissingExtra: trimesh is not installed.
        OSError: the file cannot be read.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        magic, version, length = struct.unpack("<4sII", file.read(12).ljust(12, b"\0"))
        if magic != b"glTF" or version != 2:
            raise InputError(f"expected a binary glTF 2 file, got {magic!r} version {version}: export it as glTF 2")
        if length != size:
            raise InputError(
                f"truncated: got {size} of {length} bytes: copy or export the file again"
                if length > size
                else f"expected {length} bytes as the header states, got {size}: export the file again"
            )
        offset = 12
        while offset < size:
            file.seek(offset)
            (chunk,) = struct.unpack("<I", file.read(4).ljust(4, b"\0"))
            offset += 8 + chunk
        if offset != size:
            raise InputError(
                f"truncated: the last chunk ends at byte {offset} of {size}: copy or export the file again"
            )
    return _read_with_trimesh(path)


def read_gltf(path: Path, warn: Warn) -> Mesh:
    """Read all triangles of a glTF file and the files that it refers to; raises as `read_glb` does."""
    try:
        content = json.loads(path.read_bytes())
    except (ValueError, RecursionError) as error:
        raise InputError(f"expected glTF, which is JSON: {str(error)[:100]}: export the file again") from error
    for uri in _external_uris(content):
        try:
            regular_status(_local(path, uri))
        except InputError as error:
            raise InputError(f"referenced file {uri}: {error}") from error
        except OSError:  # trimesh reports missing files
            continue
    return _read_with_trimesh(path)


def external_files(path: Path) -> list[Path]:
    """Return the existing files that a glTF file refers to; none if it is no valid glTF file."""
    if path.suffix.lower() != ".gltf":
        return []
    try:
        uris = _external_uris(json.loads(read_bytes(path, path.stat().st_size)))
    except (ValueError, RecursionError):  # `read_gltf` says so
        return []
    return [file for file in dict.fromkeys(_local(path, uri) for uri in uris) if file.is_file()]


def _local(path: Path, uri: str) -> Path:
    return path.parent / unquote(uri)


def _external_uris(content: Any) -> list[str]:
    """Return the names of the external files that a glTF file refers to."""
    parts = [content.get(kind) for kind in ("buffers", "images")] if isinstance(content, dict) else []
    entries = [entry for part in parts if isinstance(part, list) for entry in part if isinstance(entry, dict)]
    uris = [entry.get("uri") for entry in entries]
    return [uri for uri in uris if isinstance(uri, str) and not uri.startswith("data:")]


def _read_with_trimesh(path: Path) -> Mesh:
    """Read all meshes of the file's scene, each transformed by its node. The unit of glTF is the metre."""
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
