"""Convert the faces of mesh files to the triangles of a Mesh."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pcbench.geometry.arrays import IntArray
from pcbench.geometry.mesh import Mesh
from pcbench.io.files import Warn


def merge_vertices(mesh: Mesh) -> Mesh:
    """Merge exactly equal vertices; the faces stay the same."""
    order = np.lexsort(mesh.vertices.T)
    ordered = mesh.vertices[order]
    is_distinct = np.ones(len(order), dtype=bool)
    is_distinct[1:] = (ordered[1:] != ordered[:-1]).any(axis=1)
    new_index = np.empty(len(order), dtype=np.int64)
    new_index[order] = np.cumsum(is_distinct) - 1
    return replace(mesh, vertices=ordered[is_distinct], faces=new_index[mesh.faces])


def triangulate_fans(lengths: IntArray, corners: IntArray, warn: Warn) -> IntArray:
    """Triangulate polygons as fans, (F, 3).

    Args:
        lengths: number of corners of each polygon (P,).
        corners: vertex indices of all polygons, one after the other.
        warn: callback for warnings.
    """
    if small := int(np.count_nonzero(lengths < 3)):
        warn(f"left out {small} of {len(lengths)} faces with fewer than three corners")
    triangles = np.maximum(lengths - 2, 0)
    first_corner = np.repeat(np.cumsum(lengths) - lengths, triangles)
    step = np.arange(len(first_corner)) - np.repeat(np.cumsum(triangles) - triangles, triangles)
    return np.stack([corners[first_corner], corners[first_corner + step + 1], corners[first_corner + step + 2]], axis=1)
