"""glTF meshes, .glb and .gltf: by trimesh in a process of its own, after a look at the file's own sizes."""

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
from pcbench.regular_files import regular_status
from pcbench.scratch import scratch_folder


def read_glb(path: Path, warn: Warn) -> Mesh:
    """All triangles of a binary glTF file.

    The chunks are followed before anything is parsed: glTF 2.0, section 4.4.

    Raises:
        InputError: the file is cut off, or trimesh cannot read it.
        MissingExtra: trimesh is not installed.
        OSError: the file cannot be read.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        magic, version, length = struct.unpack("<4sII", file.read(12).ljust(12, b"\0"))
        if magic != b"glTF" or version != 2:
            raise InputError(f"expected a binary glTF 2 file, got {magic!r} version {version}")
        if length != size:
            raise InputError(
                f"truncated: {size} of {length} bytes" if length > size else f"{size - length} bytes too many"
            )
        offset = 12
        while offset < size:
            file.seek(offset)
            (chunk,) = struct.unpack("<I", file.read(4).ljust(4, b"\0"))
            offset += 8 + chunk
        if offset != size:
            raise InputError(f"truncated: the last chunk ends at byte {offset} of {size}")
    return _read_with_trimesh(path)


def read_gltf(path: Path, warn: Warn) -> Mesh:
    """All triangles of a glTF file and the files beside it; raises as `read_glb` does."""
    try:
        content = json.loads(path.read_bytes())
    except (ValueError, RecursionError) as error:
        raise InputError(f"expected glTF, which is JSON: {str(error)[:100]}") from error
    for uri in _external_uris(content):
        try:
            regular_status(path.parent / unquote(uri))
        except InputError as error:
            raise InputError(f"{uri}, which belongs to it: {error}") from error
        except OSError:  # trimesh says what it lacks
            continue
    return _read_with_trimesh(path)


def _external_uris(content: Any) -> list[str]:
    """The files beside a glTF file that it names."""
    parts = [content.get(kind) for kind in ("buffers", "images")] if isinstance(content, dict) else []
    entries = [entry for part in parts if isinstance(part, list) for entry in part if isinstance(entry, dict)]
    uris = [entry.get("uri") for entry in entries]
    return [uri for uri in uris if isinstance(uri, str) and not uri.startswith("data:")]


def _read_with_trimesh(path: Path) -> Mesh:
    """All meshes of the file's scene, each where its node puts it; glTF's unit is the metre."""
    size = path.stat().st_size
    memory, seconds = (2 << 30) + 60 * size, 30 + size // 1_000_000
    # One thread: a thread pool takes address space, which is what is limited.
    one_thread = {"OPENBLAS_NUM_THREADS": "1"}
    with scratch_folder() as folder:
        outputs = [folder / "vertices.npy", folder / "faces.npy"]
        limits = Limits(seconds=2 * seconds, cpu_seconds=seconds, memory=memory)
        done = run_script(
            trimesh_child.__file__, str(path.resolve()), *map(str, outputs), limits=limits, environment=one_thread
        )
        if done.timed_out:
            raise InputError(f"cannot be read: trimesh is not through with it after {2 * seconds} s")
        if done.code:
            require("trimesh")
            reason_given = done.last_words or f"it ended with {done.code}"
            reason = "".join(c if c.isprintable() else " " for c in reason_given)[:200]
            raise InputError(f"trimesh cannot read it: {reason}")
        vertices, faces = (np.load(output, allow_pickle=False) for output in outputs)
    return merge_vertices(Mesh(vertices, faces, unit="m"))
