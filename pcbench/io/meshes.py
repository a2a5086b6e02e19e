"""Read triangle meshes, and clouds or meshes. The file extension selects the format, see `formats.MESHES`."""

from __future__ import annotations

import os
from collections.abc import Callable

from pcbench.geometry.cloud import Cloud
from pcbench.geometry.mesh import Mesh
from pcbench.io import CloudLike, is_path, to_cloud
from pcbench.io.files import as_path, check_readable, errors_named, report_warnings
from pcbench.io.source import Source


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
    path, lines = as_path(path), list[str]()
    with errors_named(path):
        check_readable(path)  # a folder is none of tiles
    mesh = Source.open(path).read_mesh(lines.append)
    report_warnings(lines, on_warning)
    return mesh


def to_shape(value: Mesh | CloudLike) -> Cloud | Mesh:
    """Return a cloud or a mesh unchanged, wrap an (N, 3) array, or read the file at a path.

    Raises:
        InputError, MissingExtra: see `Source.read` and `Cloud`.
    """
    if isinstance(value, Mesh):
        return value
    if not is_path(value):
        return to_cloud(value)
    lines: list[str] = []
    shape = Source.open(value).read(lines.append)
    report_warnings(lines, None)
    return shape
