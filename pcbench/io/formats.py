"""The file formats, one line per extension.

To add a format, write a module with a reader (and a writer if needed), add its line here, and a test in tests/io.
A reader takes (path, warn). It calls `warn` with one line for each item that it leaves out, and raises InputError if
the file is invalid. Its messages do not name the path. It keeps points that are NaN or Inf, and does not check that
the file exists: `read_cloud` and `read_mesh` handle these for all formats.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple

from pcbench.errors import InputError
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.mesh import Mesh
from pcbench.io.ascii_grid import look_at_ascii_grid, read_ascii_grid_mesh
from pcbench.io.colmap import read_colmap
from pcbench.io.e57 import read_e57
from pcbench.io.ept import read_ept
from pcbench.io.files import Fields, Look, Warn
from pcbench.io.geotiff_heights import look_at_geotiff, read_geotiff_mesh, read_geotiff_points
from pcbench.io.gltf import read_glb, read_gltf
from pcbench.io.gltf_points import look_at_gltf, read_gltf_points, read_gltf_vertices
from pcbench.io.ksplat import read_ksplat
from pcbench.io.las import read_las, write_las
from pcbench.io.lidar_bin import read_lidar_bin
from pcbench.io.numpy_files import read_npy, read_npz, write_npy, write_npz
from pcbench.io.obj import look_at_obj, read_obj, read_obj_points, read_obj_vertices
from pcbench.io.off import read_off
from pcbench.io.pcd import read_pcd, write_pcd
from pcbench.io.ply import look_at_ply, read_ply, read_ply_mesh, read_ply_vertices, write_ply
from pcbench.io.ptx import read_ptx
from pcbench.io.splat import read_splat, write_splat
from pcbench.io.spz import read_spz, write_spz
from pcbench.io.stl import read_stl
from pcbench.io.text import read_text, write_text


class CloudFormat(NamedTuple):
    """Reader of a cloud format, and its writer if the format can be written."""

    read: Callable[..., Fields]  # (path, warn); if `filtered`, also `classes`, `returns`, `allow_empty`; or `header`
    write: Callable[[Path, Cloud, Warn], None] | None = None  # calls Warn with one line for each loss
    filtered: bool = False


class MeshFormat(NamedTuple):
    """Readers of a mesh format.

    Attributes:
        read: (path, warn) to the mesh; also `header` if a look finds one.
        read_vertices: the same arguments to the fields of its vertices; None: they have none but their coordinates.
        look: looks whether a file of this extension holds a mesh; None: always.
    """

    read: Callable[..., Mesh]
    read_vertices: Callable[..., Fields] | None = None
    look: Callable[[Path], Look] | None = None


CLOUDS = {  # by lower-case extension or complete file name
    ".asc": CloudFormat(read_text, write_text),
    ".bin": CloudFormat(read_lidar_bin),  # KITTI; .pcd.bin of nuScenes
    ".csv": CloudFormat(read_text, write_text),
    ".e57": CloudFormat(read_e57),
    ".glb": CloudFormat(read_gltf_points),
    ".gltf": CloudFormat(read_gltf_points),
    ".ksplat": CloudFormat(read_ksplat),
    ".las": CloudFormat(read_las, write_las, filtered=True),
    ".laz": CloudFormat(read_las, write_las, filtered=True),  # .copc.laz too
    ".npy": CloudFormat(read_npy, write_npy),
    ".npz": CloudFormat(read_npz, write_npz),
    ".obj": CloudFormat(read_obj_points),
    ".pcd": CloudFormat(read_pcd, write_pcd),
    ".ply": CloudFormat(read_ply, write_ply),
    ".pts": CloudFormat(read_text),
    ".ptx": CloudFormat(read_ptx),
    ".splat": CloudFormat(read_splat, write_splat),
    ".spz": CloudFormat(read_spz, write_spz),
    ".tif": CloudFormat(read_geotiff_points),
    ".tiff": CloudFormat(read_geotiff_points),
    ".txt": CloudFormat(read_text, write_text),
    ".xyz": CloudFormat(read_text, write_text),
    ".xyzi": CloudFormat(read_text),
    ".xyzn": CloudFormat(read_text),
    ".xyzrgb": CloudFormat(read_text),
    "ept.json": CloudFormat(read_ept, filtered=True),
    "points3D.bin": CloudFormat(read_colmap),
    "points3D.txt": CloudFormat(read_colmap),
}

FILTERABLE_EXTENSIONS = tuple(extension for extension, form in CLOUDS.items() if form.filtered)  # classes and returns

MESHES = {
    ".stl": MeshFormat(read_stl),
    ".obj": MeshFormat(read_obj, read_obj_vertices, look_at_obj),
    ".ply": MeshFormat(read_ply_mesh, read_ply_vertices, look_at_ply),
    ".glb": MeshFormat(read_glb, read_gltf_vertices, look_at_gltf),
    ".gltf": MeshFormat(read_gltf, read_gltf_vertices, look_at_gltf),
    ".off": MeshFormat(read_off),
    ".asc": MeshFormat(read_ascii_grid_mesh, read_text, look_at_ascii_grid),
    ".tif": MeshFormat(read_geotiff_mesh, read_geotiff_points, look_at_geotiff),
    ".tiff": MeshFormat(read_geotiff_mesh, read_geotiff_points, look_at_geotiff),
}


def format_of(path: Path, formats: Mapping[str, CloudFormat] = CLOUDS) -> CloudFormat:
    """Return the format of a file by its name.

    Raises:
        InputError: the extension is unknown. The message does not name the path.
    """
    form = formats.get(path.name) or formats.get(path.suffix.lower())
    if form is None and path.suffix.lower() in MESHES:
        raise InputError(
            "expected a point cloud, got a mesh: sample points on it with `pcbench convert MESH CLOUD.ply --sample N`"
        )
    if form is None:
        extensions = ", ".join(extension for extension in formats if extension.startswith("."))
        got = path.suffix.lower() or "none"
        raise InputError(f"expected a file with extension {extensions}; got {got}: rename or convert the file")
    return form
