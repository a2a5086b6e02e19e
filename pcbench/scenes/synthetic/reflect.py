"""Reflections in glass and water: one reflected ray for each rendered sample of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.mesh import Mesh, MeshIndex

_RAY_OFFSET_SHARE = 1e-5  # of the scene's size: distance from a surface at which its reflected rays start
_SKY = np.array([[0.86, 0.90, 0.94], [0.52, 0.68, 0.86]])  # colours at the horizon and at the zenith

Samples = NDArray[np.float32]  # (N, 3), 0 to 255


@dataclass(frozen=True, eq=False)
class Mirrors:
    """Traces reflected rays in the city.

    Args:
        index: index of the mesh's faces (F, 3).
        uv: (F, 3, 2) texture coordinates of the faces' corners on their texture pages.
        page: (F,) texture page of each face.
        shade: (F, 3) light at the corners, 0 to 255.
        pages: colours (rows, columns, 3) of each texture page.
    """

    index: MeshIndex
    uv: NDArray[np.float32]
    page: IntArray
    shade: NDArray[np.uint8]
    pages: Sequence[NDArray[np.uint8]]

    def trace_reflections(self, eye: FloatArray, directions: FloatArray) -> tuple[Samples, NDArray[np.float32]]:
        """Trace rays from `eye` (3,) along `directions` (N, 3) and reflect them once.

        Returns:
            Colours (N, 3), and cosines (N,) of the angles of incidence, which determine the reflectance.
        """
        mesh = self.index.mesh
        hits = self.index.cast(eye, directions)
        unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
        normals = mesh.normals()[hits.faces]
        cosines_in = np.einsum("ni,ni->n", unit, normals)
        reflected = unit - 2 * cosines_in[:, None] * normals
        lift = _RAY_OFFSET_SHARE * float(np.ptp(mesh.vertices, axis=0).max())
        starts = eye + hits.distances[:, None] * directions - np.sign(cosines_in)[:, None] * lift * normals
        missed = hits.faces < 0  # a sample at an edge may show a face that its central ray misses
        starts[missed], reflected[missed] = eye, [0, 0, 1]
        return self.colors(starts, reflected), np.where(missed, 1.0, np.abs(cosines_in)).astype(np.float32)

    def colors(self, starts: FloatArray, directions: FloatArray) -> Samples:
        """Return the colours of the first surface that rays hit, or of the sky, which is paler near the horizon."""
        hits = self.index.cast(starts, directions)
        rise = directions[:, 2] / np.linalg.norm(directions, axis=1)
        result: Samples = (255 * (_SKY[0] + np.clip(rise, 0, 1)[:, None] * (_SKY[1] - _SKY[0]))).astype(np.float32)
        hit_rows = np.flatnonzero(hits.faces >= 0)
        faces = hits.faces[hit_rows]
        corners = self.index.mesh.vertices[self.index.mesh.faces[faces]]
        weights = _barycentric(corners, starts[hit_rows] + hits.distances[hit_rows, None] * directions[hit_rows])
        uv = np.einsum("nk,nkc->nc", weights, self.uv[faces])
        light = np.einsum("nk,nk->n", weights, self.shade[faces] / np.float32(255))
        for page_number in np.unique(self.page[faces]):
            on_page = self.page[faces] == page_number
            result[hit_rows[on_page]] = _texels(self.pages[page_number], uv[on_page]) * light[on_page, None].astype(
                np.float32
            )
        return result


def build_mirrors(
    corners: NDArray[np.float32],
    uv: NDArray[np.float32],
    page: IntArray,
    shade: NDArray[np.uint8],
    pages: Sequence[NDArray[np.uint8]],
) -> Mirrors:
    """Build the tracer from faces given by their corners (F, 3, 3)."""
    mesh = Mesh(corners.reshape(-1, 3).astype(np.float64), np.arange(3 * len(corners)).reshape(-1, 3))
    return Mirrors(MeshIndex(mesh), uv, page, shade, pages)


def reflectance(
    normal_reflectance: NDArray[np.float32], coverage: NDArray[np.float32], cosines: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Return the share of reflected light by Schlick's approximation of Fresnel's equations.

    F0 + (1 - F0) (1 - cos)^5, from "An inexpensive BRDF model for physically-based rendering", 1994.

    Args:
        normal_reflectance: (N,) F0 times the coverage.
        coverage: (N,) share of a sample covered by glass or water.
        cosines: (N,) cosines of the angles of incidence.
    """
    grazing = (1 - cosines) ** 5
    share: NDArray[np.float32] = normal_reflectance * (1 - grazing) + coverage * grazing
    return share


def _barycentric(corners: FloatArray, points: FloatArray) -> FloatArray:
    """Return weights (N, 3) of the corners (N, 3, 3) at points (N, 3) of the triangles."""
    a, b, c = corners.transpose(1, 0, 2)
    normals = np.cross(b - a, c - a)
    area = np.einsum("ni,ni->n", normals, normals)
    second = np.einsum("ni,ni->n", np.cross(points - a, c - a), normals) / area
    third = np.einsum("ni,ni->n", np.cross(b - a, points - a), normals) / area
    weights: FloatArray = np.clip(np.stack([1 - second - third, second, third], axis=1), 0, 1)
    return weights


def _texels(page: NDArray[np.uint8], uv: FloatArray) -> Samples:
    """Return colours (N, 3) of a page at uv (N, 2), linearly interpolated between texel centres."""
    rows, columns = page.shape[:2]
    x, y = (np.clip(uv[:, k] * n - 0.5, 0, n - 1.001) for k, n in ((0, columns), (1, rows)))
    j, i = x.astype(int), y.astype(int)
    s, t = (x - j)[:, None].astype(np.float32), (y - i)[:, None].astype(np.float32)
    upper, lower = ((1 - s) * page[k, j] + s * page[k, j + 1] for k in (i, i + 1))
    color: Samples = (1 - t) * upper + t * lower
    return color
