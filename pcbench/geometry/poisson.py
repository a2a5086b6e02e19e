"""A surface through an oriented cloud."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pcbench.errors import InputError, MissingExtra
from pcbench.extras import require, unavailable
from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.mesh import Mesh
from pcbench.geometry.neighbors import Index, median_spacing
from pcbench.geometry.normals import unit
from pcbench.geometry.voxels import voxel_downsample_to

_REACH = 4.0  # spacings between points beyond which the surface is invented, not measured
_MIN_POINTS = 50
_ORIENTED = 100_000  # points that signs are spread over


def poisson_mesh(cloud: Cloud, depth: int | None = None) -> Mesh:
    """The surface of screened Poisson reconstruction (Kazhdan and Hoppe 2013) through a cloud with normals.

    The method closes every surface, over holes and beyond borders. Vertices farther from every point than 4 times the
    cloud's median spacing are taken away with their faces, so the mesh ends where the data end. Open3D does the work,
    or pymeshlab where Open3D cannot be used; Open3D runs on one thread, because more give other bits every time.

    Args:
        cloud: points with outward normals of any length.
        depth: of the octree; its cells are the (inflated) bounding cube's side / 2^depth. By default such that a cell
            is about the median spacing, within 5 to 11.

    Raises:
        InputError: there are no normals, fewer than 50 points with a normal, the depth is not 1 to 14, or no surface
            stays near the points.
        MissingExtra: neither library is installed and loads.
    """
    if cloud.normals is None:
        raise InputError("expected a cloud with normals to reconstruct a surface: estimate and orient them first")
    if depth is not None and not 1 <= depth <= 14:
        raise InputError(f"expected a depth of 1 to 14, got {depth}")
    normals, valid = unit(cloud.normals)
    if (count := int(np.count_nonzero(valid))) < _MIN_POINTS:
        raise InputError(f"expected at least {_MIN_POINTS} points with normals to reconstruct a surface, got {count}")
    low, high = cloud.bounds
    origin = low / 2 + high / 2
    points, normals = cloud.points[valid] - origin, normals[valid]
    index = Index(points)
    spacing = median_spacing(index, index.nearest_other())
    if depth is None:
        cells = float((high - low).max()) / spacing if spacing > 0 else np.inf
        depth = int(np.clip(np.ceil(np.log2(max(cells, 1.0))), 5, 11))
    vertices, faces = _reconstruct(points, normals, depth)
    near = np.zeros(len(vertices), dtype=bool)
    if len(vertices):
        near = index.query(vertices).distances <= _REACH * spacing
    faces = faces[near[faces].all(axis=1)]
    if not len(faces):
        raise InputError(f"no surface passes within {_REACH:g} spacings of the {count} points: are the normals right?")
    used, faces = np.unique(faces, return_inverse=True)
    return Mesh(vertices[used] + origin, faces.reshape(-1, 3), crs=cloud.crs, unit=cloud.unit)


def oriented(cloud: Cloud) -> Cloud:
    """The cloud with signs of its normals that agree over the surface, most of them upwards.

    Signs spread along a minimum spanning tree of neighbours (Hoppe et al. 1992, section 3.3), through Open3D, over at
    most about 100,000 points (some 4 s); every other point takes the sign of the nearest of those.

    Raises:
        MissingExtra: Open3D is not installed or does not load. (pymeshlab's surface then needs a cloud that came with
            normals.)
    """
    open3d = require("open3d")
    assert cloud.normals is not None
    index = Index(cloud.points)
    few = voxel_downsample_to(cloud.points, _ORIENTED, start=float(np.median(index.nearest_other().distances)))
    data = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(cloud.points[few]))
    data.normals = open3d.utility.Vector3dVector(cloud.normals[few])
    data.orient_normals_consistent_tangent_plane(10)
    signed = np.asarray(data.normals)
    if signed[:, 2].sum() < 0:
        signed = -signed
    nearest = Index(cloud.points[few]).query(cloud.points).indices
    away = np.einsum("ni,ni->n", cloud.normals, signed[nearest]) < 0
    return replace(cloud, normals=np.where(away[:, None], -cloud.normals, cloud.normals))


def _reconstruct(points: FloatArray, normals: FloatArray, depth: int) -> tuple[FloatArray, IntArray]:
    """Vertices (V, 3) and faces (F, 3) of the untrimmed surface."""
    try:
        open3d = require("open3d")
    except MissingExtra:
        if unavailable("pymeshlab"):
            raise
        return _with_pymeshlab(points, normals, depth)
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    cloud.normals = open3d.utility.Vector3dVector(normals)
    poisson = open3d.geometry.TriangleMesh.create_from_point_cloud_poisson
    with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
        mesh, _ = poisson(cloud, depth=depth, n_threads=1)
    return np.array(mesh.vertices, dtype=np.float64), np.array(mesh.triangles, dtype=np.int64)


def _with_pymeshlab(points: FloatArray, normals: FloatArray, depth: int) -> tuple[FloatArray, IntArray]:
    import pymeshlab

    meshes = pymeshlab.MeshSet(verbose=False)
    meshes.add_mesh(pymeshlab.Mesh(vertex_matrix=points, v_normals_matrix=normals))
    meshes.generate_surface_reconstruction_screened_poisson(depth=depth, threads=1)
    mesh = meshes.current_mesh()
    return np.array(mesh.vertex_matrix(), dtype=np.float64), np.array(mesh.face_matrix(), dtype=np.int64)
