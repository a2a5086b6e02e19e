"""A radiance field: density and colors at the vertices of a sparse grid (Plenoxels, Fridovich-Keil et al. 2022)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray
from reconstructors.field.native import _field
from reconstructors.splat.interface import RasterOutput
from reconstructors.splat.view import View

CHANNELS = 16  # floats of a vertex: density, four harmonics of three colors, three unused ones
STEP = 0.5  # voxels between two samples of a ray
_BLOCK_CELLS = 4  # cells along the edge of a block that rays skip if it is empty, as in native/field.h
_INITIAL_DENSITY = 0.05  # per voxel
_OPAQUE_DENSITY = 0.5  # per voxel; density of vertices that lie in matter
_ALIGNMENT = 64  # bytes: a vertex is one cache line
_CORNERS = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), axis=-1).reshape(8, 3)
_CHUNK_ROWS = 1 << 17  # vertices interpolated at a time


class RayBatch(NamedTuple):
    """Rays in the local frame.

    Attributes:
        origins: (R, 3) float64.
        directions: (R, 3) float64, unit vectors.
    """

    origins: FloatArray
    directions: FloatArray


class RayRendering(NamedTuple):
    """Values rendered for R rays.

    Attributes:
        color: (R, 3) from 0 to 1, not clamped.
        transmittance: (R,) transmittance of the grid.
        depth: (R,) sum of the blending weights times the distances along the ray, in the frame's unit.
        median_depth: (R,) distance along the ray at which half of the light is absorbed; 0 if less is.
        normal: (R, 3) sum of the blending weights times the unit normals, in the local frame.
    """

    color: NDArray[np.float32]
    transmittance: NDArray[np.float32]
    depth: NDArray[np.float32]
    median_depth: NDArray[np.float32]
    normal: NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class VoxelField:
    """A field of N vertices in a `LocalFrame`; training changes the arrays `values` and `background` in place.

    Density is interpolated trilinearly and clamped at 0; the color is 0.5 plus the interpolated spherical harmonics of
    degree 1. Vertices that are not stored have density and harmonics 0.

    Attributes:
        origin: (3,) position of the vertex (0, 0, 0).
        voxel: edge of a voxel, in the frame's unit.
        links: (X, Y, Z) int32, row of each vertex, -1 if it is not stored.
        vertices: (N,) int32, index of each row's vertex in the flattened grid, ascending.
        values: (N, 16) float32, density per voxel, then red, green and blue of each harmonic, and three unused entries.
        background: (16,) float32, harmonics of the color behind the grid, in the order of `values`.
    """

    origin: FloatArray
    voxel: float
    links: NDArray[np.int32]
    vertices: NDArray[np.int32]
    values: NDArray[np.float32]
    background: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.vertices)

    @classmethod
    def dense(cls, lower: FloatArray, upper: FloatArray, resolution: int) -> VoxelField:
        """Create a gray, slightly opaque field in a box, with `resolution` voxels along its longest side."""
        shape = dense_shape(lower, upper, resolution)
        count = math.prod(shape)
        values = aligned_rows(count)
        values[:, 0] = _INITIAL_DENSITY
        numbers = np.arange(count, dtype=np.int32)
        background = np.zeros(CHANNELS, np.float32)
        return cls(lower, _voxel(lower, upper, resolution), numbers.reshape(shape), numbers, values, background)

    @classmethod
    def sparse(
        cls,
        origin: FloatArray,
        voxel: float,
        shape: tuple[int, ...],
        vertices: NDArray[np.int32],
        values: NDArray[np.float32],
        background: NDArray[np.float32],
    ) -> VoxelField:
        """Create a field of some vertices of a grid with `shape` vertices along its axes."""
        links = np.full(shape, -1, dtype=np.int32)
        links.reshape(-1)[vertices] = np.arange(len(vertices), dtype=np.int32)
        return cls(origin, voxel, links, vertices, values, background)

    def positions(self) -> FloatArray:
        """Return the positions (N, 3) of the vertices in the local frame."""
        indices = np.stack(np.unravel_index(self.vertices, self.links.shape), axis=1)
        positions: FloatArray = self.origin + self.voxel * indices
        return positions

    def occupied_blocks(self) -> NDArray[np.uint8]:
        """Return for each block of 4 x 4 x 4 cells whether one of their vertices has a positive density."""
        blocks = tuple(-(-(n - 1) // _BLOCK_CELLS) for n in self.links.shape)
        occupied = np.zeros(blocks, dtype=np.uint8)
        positive = self.vertices[self.values[:, 0] > 0]
        index = np.stack(np.unravel_index(positive, self.links.shape), axis=1)
        for corner in _CORNERS:  # a vertex belongs to the cells on both of its sides
            cell = np.clip(index - corner, 0, np.array(self.links.shape) - 2) // _BLOCK_CELLS
            occupied[cell[:, 0], cell[:, 1], cell[:, 2]] = 1
        return occupied

    def dilate(self, mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return a mask (N,) of the vertices of a mask (N,) and their 26 neighbors."""
        from scipy.ndimage import binary_dilation

        dense = np.zeros(self.links.shape, dtype=np.bool_)
        dense.reshape(-1)[self.vertices[mask]] = True
        return np.asarray(binary_dilation(dense, np.ones((3, 3, 3), dtype=np.bool_)).reshape(-1)[self.vertices])

    def select(self, mask: NDArray[np.bool_]) -> VoxelField:
        """Return a field of the vertices of a mask (N,)."""
        values = aligned_rows(int(mask.sum()))
        values[:] = self.values[mask]
        shape = self.links.shape
        return VoxelField.sparse(self.origin, self.voxel, shape, self.vertices[mask], values, self.background)

    def refine(self) -> VoxelField:
        """Return the same field on a grid with half the voxel size.

        A new vertex is the mean of the vertices about it, and stored if one of them is. Densities per voxel are halved.
        """
        shape = tuple(2 * n - 1 for n in self.links.shape)
        # Each vertex and its neighbors at half the distance: all candidates for new vertices.
        index = np.stack(np.unravel_index(self.vertices, self.links.shape), axis=1)
        stored = np.zeros(shape, dtype=np.bool_)
        for step in np.ndindex(3, 3, 3):
            places = np.clip(2 * index + np.array(step) - 1, 0, np.array(shape) - 1)
            stored[places[:, 0], places[:, 1], places[:, 2]] = True
        vertices = np.flatnonzero(stored).astype(np.int32)
        values = aligned_rows(len(vertices))
        for start in range(0, len(vertices), _CHUNK_ROWS):
            part = slice(start, start + _CHUNK_ROWS)
            places = np.stack(np.unravel_index(vertices[part], shape), axis=1)
            for corner in _CORNERS:  # at even positions both corners are the same vertex
                rows = self.links[tuple((places // 2 + corner * (places % 2)).T)]
                values[part] += np.where(rows[:, None] < 0, 0, self.values[rows]) / np.float32(8)
        values[:, 0] /= 2
        return VoxelField.sparse(self.origin, self.voxel / 2, shape, vertices, values, self.background)

    def local_rays(self, rays: RayBatch) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return origins and directions in voxels, relative to the grid."""
        return ((rays.origins - self.origin) / self.voxel).astype(np.float32), rays.directions.astype(np.float32)

    def render_rays(self, rays: RayBatch) -> RayRendering:
        """Return the colors, transmittances, depths and normals that rays show."""
        shapes = ((3,), (), (), (), (3,))
        rendering = RayRendering(*(np.empty((len(rays.origins), *shape), np.float32) for shape in shapes))
        _field.render(
            self.values, self.links, self.occupied_blocks(), self.background, STEP, *self.local_rays(rays), *rendering
        )
        return rendering._replace(
            depth=rendering.depth * np.float32(self.voxel), median_depth=rendering.median_depth * np.float32(self.voxel)
        )

    def render_geometry(self, view: View) -> RasterOutput:
        """Render a view with depths and normals, as `reconstructors.splat.depths.SurfaceModel` requires."""
        import torch

        rows, columns = np.divmod(np.arange(view.height * view.width), view.width)
        rays, lengths = view_rays(view, rows, columns)
        rendering = self.render_rays(rays)
        z = (1 / lengths).astype(np.float32)  # depth along the axis of a point at distance 1
        normal = (rendering.normal @ view.rotation.T).astype(np.float32)

        def image(values: NDArray[Any], *channels: int) -> torch.Tensor:
            return torch.from_numpy(np.ascontiguousarray(values).reshape(view.height, view.width, *channels))

        return RasterOutput(
            color=image(rendering.color, 3),
            transmittance=image(rendering.transmittance),
            depth=image(rendering.depth * z),
            normal=image(normal, 3),
            median_depth=image(rendering.median_depth * z),
        )

    def surface_points(self) -> FloatArray:
        """Return the positions (M, 3) of the vertices in matter."""
        density = self.values[:, 0]
        return self.positions()[density >= min(_OPAQUE_DENSITY, float(density.max(initial=0)))]


def dense_shape(lower: FloatArray, upper: FloatArray, resolution: int) -> tuple[int, ...]:
    """Return the numbers of vertices along the axes of a box, with `resolution` voxels along its longest side."""
    cells = np.ceil((upper - lower) / _voxel(lower, upper, resolution) - 1e-6).astype(np.int64)
    return tuple(max(int(n), 2) + 1 for n in cells)


def _voxel(lower: FloatArray, upper: FloatArray, resolution: int) -> float:
    return float((upper - lower).max()) / resolution


def view_rays(view: View, rows: NDArray[np.int64], columns: NDArray[np.int64]) -> tuple[RayBatch, FloatArray]:
    """Return the rays through the centres of pixels (R,), and the lengths (R,) of their segments of depth 1."""
    across = np.stack(
        [(columns + 0.5 - view.cx) / view.fx, (rows + 0.5 - view.cy) / view.fy, np.ones(len(rows))], axis=1
    )
    lengths = np.linalg.norm(across, axis=1)
    directions = (across / lengths[:, None]) @ view.rotation
    return RayBatch(np.broadcast_to(view.position, directions.shape), directions), lengths


def aligned_rows(count: int) -> NDArray[np.float32]:
    """Return zeros (N, 16) whose rows are cache lines."""
    buffer = np.zeros(4 * CHANNELS * count + _ALIGNMENT, dtype=np.uint8)
    start = -buffer.ctypes.data % _ALIGNMENT
    return buffer[start : start + 4 * CHANNELS * count].view(np.float32).reshape(count, CHANNELS)
