"""Read triangle meshes. The file extension selects the format, see `formats.MESHES`."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from pcbench.errors import InputError
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.mesh import Mesh
from pcbench.geometry.mesh_samples import vertex_cloud
from pcbench.io import CloudLike, is_path, obj, ply, read_cloud, to_cloud
from pcbench.io.files import Warn, as_path, check_readable, finite_cloud, read_named
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


def read_shape(
    path: str | os.PathLike[str],
    on_warning: Callable[[str], None] | None = None,
    *,
    vertices: bool = False,
    **filters: Any,
) -> Cloud | Mesh:
    """Read a file as a mesh if it holds one, and as a cloud otherwise.

    Args:
        path: file of a mesh, or path of a cloud as for `pcbench.read_cloud`.
        on_warning: callback, called with one line per warning. Defaults to `warnings.warn`.
        vertices: whether to return the vertices of a mesh instead.
        filters: filters of `pcbench.read_cloud`, for clouds.

    Raises:
        InputError, MissingExtra: see `read_mesh` and `pcbench.read_cloud`.
    """
    if holds_mesh(path):
        return read_vertices(path, on_warning) if vertices else read_mesh(path, on_warning)
    return read_cloud(path, on_warning=on_warning, **filters)


def to_shape(value: Mesh | CloudLike) -> Cloud | Mesh:
    """Return a cloud or a mesh unchanged, wrap an (N, 3) array, or read the file at a path.

    Raises:
        InputError, MissingExtra: see `read_shape` and `Cloud`.
    """
    if isinstance(value, Mesh):
        return value
    return read_shape(value) if is_path(value) else to_cloud(value)


def read_vertices(path: str | os.PathLike[str], on_warning: Callable[[str], None] | None = None) -> Cloud:
    """Read the vertices of a file that holds a mesh; those of PLY and OBJ have normals, colours and attributes.

    Raises:
        InputError, MissingExtra: see `read_mesh`.
    """

    def read(path: Path, warn: Warn) -> Cloud:
        vertices = {".ply": ply.read_ply_vertices, ".obj": obj.read_obj_vertices}.get(path.suffix.lower())
        return vertex_cloud(_read(path, warn)) if vertices is None else finite_cloud(vertices(path, warn), warn)

    return read_named(as_path(path), read, on_warning)


def holds_mesh(path: str | os.PathLike[str]) -> bool:
    """Return whether a file is a mesh by its extension, or by its faces if it is PLY or OBJ."""
    path = Path(path)
    has_surface = {".ply": ply.has_faces, ".obj": obj.has_surface}.get(path.suffix.lower())
    if has_surface is None:
        return path.suffix.lower() in MESHES
    try:
        check_readable(path)
        return has_surface(path)
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
