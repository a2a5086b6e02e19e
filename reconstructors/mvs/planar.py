"""Planes for surface without texture, from the reliable depths around it (Xu and Tao 2020, sec. 3.2).

Correlation cannot measure depths inside a plain roof or field, but it can at the edges and marks around it. These
depths are the vertices of a triangulation, and each triangle offers its plane to the plain pixels inside it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.cameras import Intrinsics
from reconstructors.mvs.maps import DepthMap
from reconstructors.mvs.patchmatch import GrayView, noise_variance, projection_between, window_variances

if TYPE_CHECKING:
    from scipy.spatial import Delaunay

_PATCH_SIDE_PX = 9
_MAX_PLAIN_DEVIATION = 4.0  # maximum standard deviation of the grey values in a plain patch
_MAX_PLAIN_TO_NOISE = 2.5  # maximum ratio of the variances of a plain patch and of the image's noise
_MAX_UNRELIABLE_CONFIDENCE = 0.3
_MIN_VERTEX_CONFIDENCE = 0.6
_CELL_PX = 4  # one vertex per cell of this side
_MAX_EDGE_PX = 80.0
_MAX_NORMAL_DEG = 45.0  # between a triangle and the depths at its vertices
_MEAN_SIDE_PX = 3  # side of the window whose mean grey values are compared between images
_MAX_GRAY_DIFFERENCE = 8.0
_MIN_SIMILAR_SOURCES = 2


def fill_plain_surface(reference: GrayView, sources: Sequence[GrayView], depth_map: DepthMap) -> DepthMap:
    """Return the depth map with planes at plain pixels whose depth is unreliable.

    A pixel gets the plane of its triangle if the normals at the triangle's vertices agree with it, and if at least two
    sources have nearly the same grey value where the plane projects the pixel. The confidence is the least of the
    vertices. Other pixels are unchanged.

    Args:
        reference: photograph of the map.
        sources: photographs of the same surface.
        depth_map: depth map of the reference.
    """
    wanted = _is_plain(reference.gray) & (depth_map.confidence < _MAX_UNRELIABLE_CONFIDENCE)
    if reference.valid is not None:
        wanted &= reference.valid
    triangles = _triangulate(reference.camera.intrinsics, depth_map)
    if triangles is None:
        return depth_map
    row, column = np.nonzero(wanted)
    triangle = triangles.mesh.find_simplex(np.column_stack([column, row]))
    inside = (triangle >= 0) & triangles.usable[triangle]
    row, column, triangle = row[inside], column[inside], triangle[inside]
    rays = _rays(reference.camera.intrinsics, row, column)
    depth = triangles.offsets[triangle] / np.einsum("ni,ni->n", triangles.normals[triangle], rays)

    similar = np.zeros(len(row), dtype=np.int64)
    means = _local_means(reference.gray)[row, column]
    for source in sources:
        similar += _has_gray(source, means, reference, row, column, depth)
    kept = similar >= _MIN_SIMILAR_SOURCES
    pixels, triangle = (row[kept], column[kept]), triangle[kept]
    depths, normals, confidence = depth_map.depth.copy(), depth_map.normal.copy(), depth_map.confidence.copy()
    depths[pixels] = depth[kept]
    normals[pixels] = triangles.normals[triangle]
    confidence[pixels] = triangles.confidence[triangle]
    return DepthMap(depths, normals, confidence)


class _Triangles(NamedTuple):
    """Triangles between reliable pixels; planes are normal . x = offset in the camera's frame.

    Args:
        mesh: triangulation of the image; coordinates are columns and rows.
        normals: (T, 3) unit normals that face the camera.
        offsets: (T,) offsets of the planes, negative in front of the camera.
        confidence: (T,) least confidence of the vertices.
        usable: (T,) True for triangles with short edges whose plane agrees with the normals at its vertices.
    """

    mesh: Delaunay
    normals: FloatArray
    offsets: FloatArray
    confidence: NDArray[np.float32]
    usable: NDArray[np.bool_]


def _triangulate(k: Intrinsics, depth_map: DepthMap) -> _Triangles | None:
    """Triangulate the most confident pixel of each cell; None if there is no triangle."""
    from scipy.spatial import Delaunay, QhullError

    row, column = _vertices(depth_map)
    pixels = np.column_stack([column, row])
    try:
        mesh = Delaunay(pixels)
    except (QhullError, ValueError):  # fewer than three vertices, or all on one line
        return None
    corners = mesh.simplices
    points = _rays(k, row, column) * depth_map.depth[row, column, None]
    a, b, c = points[corners].transpose(1, 0, 2)
    normals = np.cross(b - a, c - a)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    normals[np.einsum("ni,ni->n", normals, a) > 0] *= -1
    offsets = np.einsum("ni,ni->n", normals, a)
    cosines = np.einsum("nvi,ni->nv", depth_map.normal[row, column][corners], normals)
    edges = np.linalg.norm(pixels[corners] - pixels[np.roll(corners, 1, axis=1)], axis=2)
    agree = (cosines > np.cos(np.radians(_MAX_NORMAL_DEG))).all(axis=1)
    usable = agree & (edges < _MAX_EDGE_PX).all(axis=1) & (offsets < 0)
    return _Triangles(mesh, normals, offsets, depth_map.confidence[row, column][corners].min(axis=1), usable)


def _vertices(depth_map: DepthMap) -> tuple[IntArray, IntArray]:
    """Return rows and columns of the most confident pixel in each cell that has a reliable one."""
    rows, columns = (size // _CELL_PX for size in depth_map.depth.shape)
    confidence = np.where(depth_map.known, depth_map.confidence, 0)[: rows * _CELL_PX, : columns * _CELL_PX]
    blocks = confidence.reshape(rows, _CELL_PX, columns, _CELL_PX).transpose(0, 2, 1, 3)
    cells = blocks.reshape(rows, columns, _CELL_PX**2)
    row, column = np.nonzero(cells.max(axis=2) >= _MIN_VERTEX_CONFIDENCE)
    down, across = np.divmod(cells[row, column].argmax(axis=1), _CELL_PX)
    return row * _CELL_PX + down, column * _CELL_PX + across


def _rays(k: Intrinsics, row: IntArray, column: IntArray) -> FloatArray:
    """Return directions (N, 3) of unit depth through the centres of pixels of a pinhole."""
    return k.directions(np.column_stack([column + 0.5, row + 0.5]))


def _has_gray(
    source: GrayView, means: FloatArray, reference: GrayView, row: IntArray, column: IntArray, depth: FloatArray
) -> NDArray[np.bool_]:
    """Return whether a source has nearly the given mean grey values where pixels with depths project, (N,)."""
    projection = projection_between(reference.camera, source.camera).astype(np.float64)
    x, y, z = ((m[0] * column + m[1] * row + m[2]) * depth + m[3] for m in projection)
    height, width = source.gray.shape
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v = np.round(x / z), np.round(y / z)
    seen: NDArray[np.bool_] = (z > 0) & (u >= 0) & (u < width) & (v >= 0) & (v < height)
    pixels = (v[seen].astype(np.int64), u[seen].astype(np.int64))
    similar = np.abs(_local_means(source.gray)[pixels] - means[seen]) < _MAX_GRAY_DIFFERENCE
    seen[seen] = similar if source.valid is None else similar & source.valid[pixels]
    return seen


def _local_means(gray: NDArray[np.uint8]) -> FloatArray:
    from scipy.ndimage import uniform_filter

    means: FloatArray = uniform_filter(gray.astype(np.float64), _MEAN_SIDE_PX)
    return means


def _is_plain(gray: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Return where the patch around a pixel has no texture, (H, W)."""
    limit = max(_MAX_PLAIN_DEVIATION**2, _MAX_PLAIN_TO_NOISE * noise_variance(gray))
    return np.asarray(window_variances(gray, _PATCH_SIDE_PX) < limit)
