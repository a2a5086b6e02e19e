"""Convert the faces of mesh files to the triangles of a Mesh."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pcbench.errors import InputError
from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.mesh import Mesh
from pcbench.io.files import Warn

_MAX_EAR_CORNERS = 1000  # of a polygon, because the time grows with the cube; larger ones stay fans


def merge_vertices(mesh: Mesh) -> Mesh:
    """Merge exactly equal vertices; the faces stay the same."""
    order = np.lexsort(mesh.vertices.T)
    ordered = mesh.vertices[order]
    is_distinct = np.ones(len(order), dtype=bool)
    is_distinct[1:] = (ordered[1:] != ordered[:-1]).any(axis=1)
    new_index = np.empty(len(order), dtype=np.int64)
    new_index[order] = np.cumsum(is_distinct) - 1
    return replace(mesh, vertices=ordered[is_distinct], faces=new_index[mesh.faces])


def left_out_surface(vertices: int, surface: str) -> str:
    """Return the warning that the vertices of a mesh were read as a cloud.

    Args:
        vertices: their number.
        surface: what was left out, such as "12 faces".
    """
    return (
        f"read the {vertices:,} vertices of a mesh, not its surface of {surface}: sample points on it with"
        " `pcbench convert MESH CLOUD.ply --sample N`"
    )


def triangulate(vertices: FloatArray, lengths: IntArray, corners: IntArray, warn: Warn) -> IntArray:
    """Triangulate polygons as (F, 3): convex ones as fans of their first corner, others by cutting off ears.

    Args:
        vertices: (V, 3) coordinates.
        lengths: number of corners of each polygon (P,).
        corners: vertex indices of all polygons, one after the other.
        warn: callback for warnings.

    Raises:
        InputError: a corner is no vertex.
    """
    if len(corners) and not (corners.min() >= 0 and corners.max() < len(vertices)):
        wrong = corners.min() if corners.min() < 0 else corners.max()
        raise InputError(
            f"expected vertex indices from 0 to {len(vertices) - 1} in faces, got {wrong}: export it again"
        )
    if small := int(np.count_nonzero(lengths < 3)):
        warn(f"left out {small} of {len(lengths)} faces with fewer than three corners")
    counts = np.maximum(lengths - 2, 0)
    starts = np.cumsum(lengths) - lengths
    owner = np.repeat(np.arange(len(lengths)), counts)
    step = np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts)
    first = starts[owner]
    faces: IntArray = np.stack([corners[first], corners[first + step + 1], corners[first + step + 2]], axis=1)
    if not (lengths > 3).any():
        return faces
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    with np.errstate(over="ignore", invalid="ignore"):
        areas = np.cross(b - a, c - a)
        sums = np.column_stack([np.bincount(owner, areas[:, axis], len(lengths)) for axis in range(3)])
        folded = np.unique(owner[np.einsum("ni,ni->n", areas, sums[owner]) < 0])
    for polygon in folded[lengths[folded] <= _MAX_EAR_CORNERS]:
        ring = corners[starts[polygon] : starts[polygon] + lengths[polygon]]
        ends = np.searchsorted(owner, [polygon, polygon + 1])
        faces[ends[0] : ends[1]] = _cut_ears(vertices, ring, sums[polygon])
    return faces


def _cut_ears(vertices: FloatArray, ring: IntArray, normal: FloatArray) -> IntArray:
    """Triangulate a simple polygon with a normal (3,) by cutting off convex corners that hold no other corner."""
    axis = int(np.abs(normal).argmax())
    flat = np.delete(vertices[ring], axis, axis=1) * ((1, 1) if (normal[axis] > 0) == (axis != 1) else (-1, 1))
    left, faces, crosses = list(range(len(ring))), [], False
    while len(left) > 3:
        best, points = None, flat[left]
        for k, tip in enumerate(() if crosses else left):
            corners = flat[[left[k - 1], tip, left[(k + 1) % len(left)]]]
            if _turns(corners[0], corners[1], corners[2:])[0] > 0 and not _any_inside(points, corners):
                best = k
                break
        crosses = best is None  # a polygon without an ear crosses itself
        k = best or 0
        faces.append((left[k - 1], left[k], left[(k + 1) % len(left)]))
        del left[k]
    triangles: IntArray = ring[np.array([*faces, tuple(left)])]
    return triangles


def _turns(a: FloatArray, b: FloatArray, points: FloatArray) -> FloatArray:
    """Return twice the signed areas (N,) of the triangles of a, b and each point in the plane, positive to the left."""
    turns: FloatArray = (b[0] - a[0]) * (points[:, 1] - a[1]) - (b[1] - a[1]) * (points[:, 0] - a[0])
    return turns


def _any_inside(points: FloatArray, corners: FloatArray) -> bool:
    """Return whether a point (N, 2) lies in an anticlockwise triangle (3, 2) or on its border, but is not a corner."""
    inside = np.logical_and.reduce([_turns(corners[k], corners[(k + 1) % 3], points) >= 0 for k in range(3)])
    return any(not (corners == point).all(axis=1).any() for point in points[inside])


def triangulate_strips(lengths: IntArray, corners: IntArray) -> IntArray:
    """Return the triangles (F, 3) of triangle strips; every second one is reversed, so that all face the same way.

    Args:
        lengths: number of entries of each row (R,).
        corners: vertex indices of all rows, one after the other; -1 ends a strip within a row.
    """
    marked = np.insert(corners, np.cumsum(lengths), -1)
    places = np.arange(len(marked))
    strip_start = np.maximum.accumulate(np.where(marked == -1, places + 1, 0))
    first = places[:-2][(marked[:-2] != -1) & (marked[1:-1] != -1) & (marked[2:] != -1)]
    odd = (first - strip_start[first]) % 2
    faces: IntArray = np.stack([marked[first], marked[first + 1 + odd], marked[first + 2 - odd]], axis=1)
    a, b, c = faces.T
    proper: IntArray = faces[(a != b) & (b != c) & (c != a)]  # repeated vertices join strips
    return proper
