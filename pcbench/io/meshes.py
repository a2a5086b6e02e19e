"""Read triangle meshes. The file extension selects the format, see `formats.MESHES`."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

from pcbench.errors import InputError
from pcbench.geometry.mesh import Mesh
from pcbench.io import obj, ply
from pcbench.io.files import Warn, as_path, check_readable, read_named
from pcbench.io.formats import CLOUDS, MESHES


def read_mesh(path: str | os.PathLike[str], on_warning: Callable[[str], None] | None = None) -> Mesh:
    """Read a triangle mesh from a file; polygons become fans of triangles.

    STL repeats vertices in each face, and glTF along texture seams. Exactly equal vertices of these formats are merged,
    so that a closed surface stays closed. glTF axes are not changed (y up).

    Args:
        path: .stl, .obj, .ply, .glb, .gltf or .off file (upper or lower case).
        on_warning: callback, called with one line per warning. Defaults to `warnings.warn`.

    Raises:
        InputError: the file cannot be read or does not match its extension. The message starts with the path.
        MissingExtra: the format needs trimesh, which is not installed.
    """
    return read_named(as_path(path), _read, on_warning)


def holds_mesh(path: str | os.PathLike[str]) -> bool:
    """Return whether a file is a mesh by its extension, or by its faces if it is PLY or OBJ."""
    path = Path(path)
    has_faces = {".ply": ply.has_faces, ".obj": obj.has_faces}.get(path.suffix.lower())
    if has_faces is None:
        return path.suffix.lower() in MESHES
    try:
        check_readable(path)
        return has_faces(path)
    except (InputError, OSError):
        return False  # its reader reports the error


def is_mesh_only(path: str | os.PathLike[str]) -> bool:
    """Return whether the file's format stores meshes but not clouds."""
    suffix = Path(path).suffix.lower()
    return suffix in MESHES and suffix not in CLOUDS


def _read(path: Path, warn: Warn) -> Mesh:
    extension = path.suffix.lower()
    if extension not in MESHES:
        known = ", ".join(MESHES)
        raise InputError(f"expected a mesh file with extension {known}; got {extension or 'no extension'!r}")
    return MESHES[extension](path, warn)
