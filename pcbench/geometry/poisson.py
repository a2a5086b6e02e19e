"""Surface reconstruction from an oriented cloud."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from pcbench.errors import InputError
from pcbench.extras import require
from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.mesh import Mesh
from pcbench.geometry.meshlab import screened_poisson
from pcbench.geometry.neighbors import Index
from pcbench.geometry.normals import unit
from pcbench.geometry.sampling import median_spacing
from pcbench.geometry.voxels import voxel_downsample_to

_MAX_SPACINGS_FROM_POINTS = 4.0  # distance in point spacings beyond which the surface is extrapolated, not measured
_MIN_POINTS = 50  # with a normal
_MAX_ORIENTATION_POINTS = 100_000  # points over which the signs of normals are propagated
_FLATNESS = 1e-9  # thickness over extent below which points count as those of a plane


def poisson_mesh(cloud: Cloud, depth: int | None = None) -> Mesh:
    """Reconstruct a surface from a cloud with normals by screened Poisson reconstruction (Kazhdan and Hoppe 2013).

    The method closes every surface, over holes and beyond borders. Vertices farther from every point than 4 times the
    cloud's median spacing are removed with their faces, so that the mesh ends where the data end. Open3D computes the
    surface, on one thread, because its result is not reproducible with more.

    Args:
        cloud: points with outward normals of any length.
        depth: octree depth; a cell is the (padded) bounding cube's side / 2^depth. By default a cell is about the
            median spacing, with the depth clamped to 5 to 11.

    Raises:
        InputError: there are no normals or fewer than 50 points with one, the depth is not 1 to 14, or no surface
            passes near the points.
        MissingExtra: Open3D is not installed or does not load.
    """
    return _trimmed_surface(cloud, depth, _by_open3d)


def poisson_mesh_by_meshlab(cloud: Cloud, depth: int | None = None) -> Mesh:
    """Reconstruct a surface as `poisson_mesh` does, by pymeshlab in a child process.

    Raises:
        InputError: see `poisson_mesh`, or pymeshlab fails.
        MissingExtra: pymeshlab is not installed or does not load.
    """
    return _trimmed_surface(cloud, depth, screened_poisson)


_Reconstruct = Callable[[FloatArray, FloatArray, int], tuple[FloatArray, IntArray]]


def _trimmed_surface(cloud: Cloud, depth: int | None, reconstruct: _Reconstruct) -> Mesh:
    """Return the part near the points of the surface that `reconstruct` makes of points, unit normals and depth."""
    if cloud.normals is None:
        raise InputError(
            "expected a cloud with normals to reconstruct a surface, got none; estimate and orient them first"
        )
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
    vertices, faces = reconstruct(points, normals, depth)
    near = np.zeros(len(vertices), dtype=bool)
    if len(vertices):
        near = index.query(vertices).distances <= _MAX_SPACINGS_FROM_POINTS * spacing
    faces = faces[near[faces].all(axis=1)]
    if not len(faces):
        raise InputError(
            f"expected a surface within {_MAX_SPACINGS_FROM_POINTS:g} spacings of the {count} points, got none;"
            " check the directions of the normals"
        )
    used, faces = np.unique(faces, return_inverse=True)
    return Mesh(vertices[used] + origin, faces.reshape(-1, 3), crs=cloud.crs, unit=cloud.unit)


def orient_normals(cloud: Cloud) -> Cloud:
    """Orient the normals of a cloud consistently over the surface, most of them upwards.

    Open3D propagates signs along a minimum spanning tree of neighbours (Hoppe et al. 1992, section 3.3) over at most
    about 100,000 points (about 4 s). Every other point takes the sign of the nearest of them.

    Raises:
        MissingExtra: Open3D is not installed or does not load. Without it, only clouds with oriented normals can be
            reconstructed (by `poisson_mesh_by_meshlab`).
    """
    open3d = require("open3d")
    assert cloud.normals is not None
    index = Index(cloud.points)
    rows = voxel_downsample_to(cloud.points, _MAX_ORIENTATION_POINTS, start=median_spacing(index))
    points, signed = cloud.points[rows], cloud.normals[rows]
    if _is_flat(points):  # Open3D needs Delaunay tetrahedra, which points of a plane do not have
        signed = np.where(signed @ signed[0] < 0, -1, 1)[:, None] * signed
    else:
        data = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
        data.normals = open3d.utility.Vector3dVector(signed)
        data.orient_normals_consistent_tangent_plane(10)
        signed = np.asarray(data.normals)
    if signed[:, 2].sum() < 0:
        signed = -signed
    nearest = Index(points).query(cloud.points).indices
    away = np.einsum("ni,ni->n", cloud.normals, signed[nearest]) < 0
    return replace(cloud, normals=np.where(away[:, None], -cloud.normals, cloud.normals))


def _is_flat(points: FloatArray) -> bool:
    """Return whether points (N, 3) lie in a plane, but for rounding."""
    singular = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(singular[-1] <= _FLATNESS * singular[0])


def _by_open3d(points: FloatArray, normals: FloatArray, depth: int) -> tuple[FloatArray, IntArray]:
    """Return vertices (V, 3) and faces (F, 3) of the untrimmed surface."""
    open3d = require("open3d")
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    cloud.normals = open3d.utility.Vector3dVector(normals)
    poisson = open3d.geometry.TriangleMesh.create_from_point_cloud_poisson
    with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
        mesh, _ = poisson(cloud, depth=depth, n_threads=1)
    return np.array(mesh.vertices, dtype=np.float64), np.array(mesh.triangles, dtype=np.int64)
