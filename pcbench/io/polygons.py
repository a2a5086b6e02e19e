"""Faces as mesh files have them, made into the triangles of a Mesh."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pcbench.geometry.arrays import IntArray
from pcbench.geometry.mesh import Mesh
from pcbench.io.files import Warn


def merged(mesh: Mesh) -> Mesh:
    """The same faces, of vertices of which no two are equal."""
    order = np.lexsort(mesh.vertices.T)
    ordered = mesh.vertices[order]
    first = np.ones(len(order), dtype=bool)
    first[1:] = (ordered[1:] != ordered[:-1]).any(axis=1)
    number = np.empty(len(order), dtype=np.int64)
    number[order] = np.cumsum(first) - 1
    return replace(mesh, vertices=ordered[first], faces=number[mesh.faces])


def fans(lengths: IntArray, corners: IntArray, warn: Warn) -> IntArray:
    """Triangles (F, 3) of polygons that have `lengths` (P,) of the vertex numbers `corners`, one after the other."""
    if small := int(np.count_nonzero(lengths < 3)):
        warn(f"left out {small} of {len(lengths)} faces with fewer than three corners")
    triangles = np.maximum(lengths - 2, 0)
    first = np.repeat(np.cumsum(lengths) - lengths, triangles)
    step = np.arange(len(first)) - np.repeat(np.cumsum(triangles) - triangles, triangles)
    return np.stack([corners[first], corners[first + step + 1], corners[first + step + 2]], axis=1)
