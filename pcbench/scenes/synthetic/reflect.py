"""What glass and water mirror: one reflected ray for each sample that a camera takes of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.mesh import Mesh, MeshIndex

_LIFT = 1e-5  # of the scene's size: reflected rays must not meet what they start from
_SKY = np.array([[0.86, 0.90, 0.94], [0.52, 0.68, 0.86]])  # at the horizon and overhead

Samples = NDArray[np.float32]  # (N, 3), 0 to 255


@dataclass(frozen=True, eq=False)
class Mirrors:
    """The city as rays see it.

    Args:
        index: of its faces (F, 3).
        uv: (F, 3, 2) of their corners on their pages; page (F,) which one; shade (F, 3) light at their corners of 255.
        pages: colours (rows, columns, 3).
    """

    index: MeshIndex
    uv: NDArray[np.float32]
    page: IntArray
    shade: NDArray[np.uint8]
    pages: Sequence[NDArray[np.uint8]]

    def mirrored(self, eye: FloatArray, directions: FloatArray) -> tuple[Samples, NDArray[np.float32]]:
        """What rays from `eye` (3,) along `directions` (N, 3) show after they were reflected once: colours, and cosines
        (N,) of the angles of incidence, by which the share of the reflected light goes.
        """
        mesh = self.index.mesh
        hits = self.index.cast(eye, directions)
        unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
        normals = mesh.normals()[hits.faces]
        across = np.einsum("ni,ni->n", unit, normals)
        turned = unit - 2 * across[:, None] * normals
        lift = _LIFT * float(np.ptp(mesh.vertices, axis=0).max())
        starts = eye + hits.distances[:, None] * directions - np.sign(across)[:, None] * lift * normals
        missed = hits.faces < 0  # between two samples of a picture an edge may lie
        starts[missed], turned[missed] = eye, [0, 0, 1]
        return self.colors(starts, turned), np.where(missed, 1.0, np.abs(across)).astype(np.float32)

    def colors(self, starts: FloatArray, directions: FloatArray) -> Samples:
        """Colours of the first thing that rays meet, or of the sky, which is paler towards the horizon."""
        hits = self.index.cast(starts, directions)
        rise = directions[:, 2] / np.linalg.norm(directions, axis=1)
        result: Samples = (255 * (_SKY[0] + np.clip(rise, 0, 1)[:, None] * (_SKY[1] - _SKY[0]))).astype(np.float32)
        met = np.flatnonzero(hits.faces >= 0)
        faces = hits.faces[met]
        corners = self.index.mesh.vertices[self.index.mesh.faces[faces]]
        weights = _barycentric(corners, starts[met] + hits.distances[met, None] * directions[met])
        at = np.einsum("nk,nkc->nc", weights, self.uv[faces])
        light = np.einsum("nk,nk->n", weights, self.shade[faces] / np.float32(255))
        for number in np.unique(self.page[faces]):
            own = self.page[faces] == number
            result[met[own]] = _texels(self.pages[number], at[own]) * light[own, None].astype(np.float32)
        return result


def mirrors_of(
    corners: NDArray[np.float32],
    uv: NDArray[np.float32],
    page: IntArray,
    shade: NDArray[np.uint8],
    pages: Sequence[NDArray[np.uint8]],
) -> Mirrors:
    """Of faces by their corners (F, 3, 3)."""
    mesh = Mesh(corners.reshape(-1, 3).astype(np.float64), np.arange(3 * len(corners)).reshape(-1, 3))
    return Mirrors(MeshIndex(mesh), uv, page, shade, pages)


def reflectance(
    straight: NDArray[np.float32], covered: NDArray[np.float32], cosines: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Which share of the light comes from the mirror, by Schlick's approximation of Fresnel's equations ("An
    inexpensive BRDF model for physically-based rendering", 1994): F0 + (1 - F0) (1 - cos)^5.

    Args:
        straight: F0 times how much of a sample glass or water covers, (N,).
        covered: how much of it they do, (N,).
        cosines: of the angles of incidence, (N,).
    """
    grazing = (1 - cosines) ** 5
    share: NDArray[np.float32] = straight * (1 - grazing) + covered * grazing
    return share


def _barycentric(corners: FloatArray, points: FloatArray) -> FloatArray:
    """Weights (N, 3) of the corners (N, 3, 3) at points (N, 3) of the triangles."""
    a, b, c = corners.transpose(1, 0, 2)
    normals = np.cross(b - a, c - a)
    area = np.einsum("ni,ni->n", normals, normals)
    second = np.einsum("ni,ni->n", np.cross(points - a, c - a), normals) / area
    third = np.einsum("ni,ni->n", np.cross(b - a, points - a), normals) / area
    weights: FloatArray = np.clip(np.stack([1 - second - third, second, third], axis=1), 0, 1)
    return weights


def _texels(page: NDArray[np.uint8], uv: FloatArray) -> Samples:
    """Colours (N, 3) of a page at uv (N, 2), linear between texel centres."""
    rows, columns = page.shape[:2]
    x, y = (np.clip(uv[:, k] * n - 0.5, 0, n - 1.001) for k, n in ((0, columns), (1, rows)))
    j, i = x.astype(int), y.astype(int)
    s, t = (x - j)[:, None].astype(np.float32), (y - i)[:, None].astype(np.float32)
    upper, lower = ((1 - s) * page[k, j] + s * page[k, j + 1] for k in (i, i + 1))
    color: Samples = (1 - t) * upper + t * lower
    return color
