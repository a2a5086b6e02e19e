"""Points on a mesh as the evaluation of DTU samples it: a grid on each triangle, and the vertices."""

from __future__ import annotations

import numpy as np

from pcbench.errors import InputError
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.mesh import Mesh

_MAX_POINTS = 100_000_000
_BLOCK_CELLS = 4_000_000  # cells of the grids that are computed together: about 300 MB


def grid_points(mesh: Mesh, spacing: float) -> FloatArray:
    """Return the vertices of a mesh, then points (N, 3) on its faces that are about `spacing` apart.

    A face with the edges a and b from its first corner, of lengths l1 and l2, has a grid of n1 = floor(l1 / t) times
    n2 = floor(l2 / t) cells along a and b, where t = spacing sqrt(l1 l2 / |a x b|). Its points are the centres
    ((i + 0.5) / n1) a + ((j + 0.5) / n2) b whose two coefficients have a sum below 1. Faces without area, and those of
    fewer than one cell, have none.

    Raises:
        InputError: there would be more than 100 million points.
    """
    corners = mesh.vertices[mesh.faces]
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    doubled_areas = np.linalg.norm(np.cross(first, second), axis=1)
    has_area = doubled_areas > 0
    origins, first, second, doubled_areas = (rows[has_area] for rows in (corners[:, 0], first, second, doubled_areas))
    lengths = np.stack([np.linalg.norm(first, axis=1), np.linalg.norm(second, axis=1)], axis=1)
    steps = spacing * np.sqrt(lengths[:, 0] * lengths[:, 1] / doubled_areas)
    counts = np.floor(lengths / steps[:, None])
    fine = (counts >= 1).all(axis=1)
    if (total := float(counts[fine].prod(axis=1).sum()) / 2) > _MAX_POINTS:
        raise InputError(
            f"a mesh of area {mesh.area:.3g} would have {total:.2g} points {spacing:g} apart, more than"
            f" {_MAX_POINTS:,}: check its unit, or set a larger spacing"
        )
    origins, first, second, counts = (rows[fine] for rows in (origins, first, second, counts.astype(np.int64)))
    blocks, ends = [mesh.vertices], np.cumsum(counts.prod(axis=1))
    for start in range(0, int(ends[-1]) if len(ends) else 0, _BLOCK_CELLS):
        cells = np.arange(start, min(start + _BLOCK_CELLS, ends[-1]))
        faces = np.searchsorted(ends, cells, side="right")
        rows, columns = np.divmod(cells - (ends[faces] - counts[faces].prod(axis=1)), counts[faces, 1])
        a, b = (rows + 0.5) / counts[faces, 0], (columns + 0.5) / counts[faces, 1]
        inside = a + b < 1
        a, b, faces = a[inside, None], b[inside, None], faces[inside]
        blocks.append(first[faces] * a + second[faces] * b + origins[faces])
    return np.concatenate(blocks)
