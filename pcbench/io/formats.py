"""The file formats: one line for each extension.

A new format is one module with a reader, and perhaps a writer, and its line here; a test of it stands in tests/io.
A reader takes (path, warn). It calls `warn` with a line for each thing that it leaves out, and raises InputError where
the file is not what it should be. It names the path in neither, keeps points that are NaN or Inf, and need not look
whether there is a file: `read_cloud` and `read_mesh` do that for all of them.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from pcbench.geometry.cloud import Cloud
from pcbench.geometry.mesh import Mesh
from pcbench.io.colmap import read_colmap
from pcbench.io.e57 import read_e57
from pcbench.io.files import Fields, Warn
from pcbench.io.gltf import read_glb, read_gltf
from pcbench.io.las import read_las, write_las
from pcbench.io.numpy_files import read_npy, read_npz, write_npy, write_npz
from pcbench.io.obj import read_obj
from pcbench.io.off import read_off
from pcbench.io.pcd import read_pcd, write_pcd
from pcbench.io.ply import read_ply, read_ply_mesh, write_ply
from pcbench.io.stl import read_stl
from pcbench.io.text import read_text, write_text


class CloudFormat(NamedTuple):
    """How the clouds of a format are read, and written where they can be."""

    read: Callable[..., Fields]  # (path, warn); where `filtered`, also `classes` and `returns` by name
    write: Callable[[Path, Cloud], None] | None = None
    filtered: bool = False


CLOUDS = {  # by extension in lower case, or by the whole name of the file
    ".asc": CloudFormat(read_text, write_text),
    ".csv": CloudFormat(read_text, write_text),
    ".e57": CloudFormat(read_e57),
    ".las": CloudFormat(read_las, write_las, filtered=True),
    ".laz": CloudFormat(read_las, write_las, filtered=True),  # .copc.laz too
    ".npy": CloudFormat(read_npy, write_npy),
    ".npz": CloudFormat(read_npz, write_npz),
    ".pcd": CloudFormat(read_pcd, write_pcd),
    ".ply": CloudFormat(read_ply, write_ply),
    ".pts": CloudFormat(read_text),
    ".txt": CloudFormat(read_text, write_text),
    ".xyz": CloudFormat(read_text, write_text),
    "points3D.bin": CloudFormat(read_colmap),
    "points3D.txt": CloudFormat(read_colmap),
}

MESHES: dict[str, Callable[[Path, Warn], Mesh]] = {
    ".stl": read_stl,
    ".obj": read_obj,
    ".ply": read_ply_mesh,
    ".glb": read_glb,
    ".gltf": read_gltf,
    ".off": read_off,
}
