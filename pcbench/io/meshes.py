"""Triangle meshes from files: the extension picks the format, see `formats.MESHES`."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

from pcbench.errors import InputError
from pcbench.geometry.mesh import Mesh
from pcbench.io.files import Warn, as_path, check_readable, read_named
from pcbench.io.formats import CLOUDS, MESHES
from pcbench.io.ply import has_faces


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
    return read_named(as_path(path), _read, on_warning)


def holds_mesh(path: str | os.PathLike[str]) -> bool:
    """Whether the file is a mesh by its extension, or a PLY file whose header, all that is read, tells of faces."""
    path = Path(path)
    if path.suffix.lower() != ".ply":
        return path.suffix.lower() in MESHES
    try:
        check_readable(path)
        return has_faces(path)
    except (InputError, OSError):
        return False  # whoever reads it says what is wrong


def is_mesh_alone(path: str | os.PathLike[str]) -> bool:
    """Whether the file's format holds meshes and no clouds."""
    suffix = Path(path).suffix.lower()
    return suffix in MESHES and suffix not in CLOUDS


def _read(path: Path, warn: Warn) -> Mesh:
    extension = path.suffix.lower()
    if extension not in MESHES:
        known = ", ".join(MESHES)
        raise InputError(f"expected a mesh file that ends in {known}; got {extension or 'no extension'!r}")
    return MESHES[extension](path, warn)
