"""Grids of heights (DEM), as cells or as a surface.

A grid is a sampled surface, so wherever a mesh is accepted it is one: the centres of adjacent cells become triangles.
Cells without data are holes. Wherever points are needed, they are the centres of the cells, as in PDAL.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pcbench.errors import InputError
from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.mesh import Mesh
from pcbench.io.files import Fields, Warn
from pcbench.io.nodata import CoordinateCounts, Nodata, nodata_warning

MAX_CELLS = 250_000_000
"""Largest number of cells of a grid: its triangles take 12 GB."""


class ElevationGrid(NamedTuple):
    """A grid of heights.

    Attributes:
        x: (W,) x of the centres of the columns, from west to east.
        y: (H,) y of the centres of the rows, from north to south.
        heights: (H, W) heights; NaN: no data.
        crs: coordinate reference system, or None.
        unit: unit of the coordinates, or None.
    """

    x: FloatArray
    y: FloatArray
    heights: FloatArray
    crs: str | None = None
    unit: str | None = None

    def points(self, warn: Warn) -> Fields:
        """Return the centres of the cells with data, row by row from the north.

        Raises:
            InputError: no cell has data.
        """
        return Fields(points=self._vertices(warn), crs=self.crs, unit=self.unit)

    def mesh(self, warn: Warn) -> Mesh:
        """Return the surface: two triangles between four cells with data, one between three, both facing up.

        Raises:
            InputError: no three adjacent cells have data.
        """
        vertices = self._vertices(warn)
        if line := nodata_warning(Nodata.of(CoordinateCounts.of(vertices))):
            warn(line)
        has_data = np.isfinite(self.heights)
        index = np.full(self.heights.shape, -1, dtype=np.int64)
        index[has_data] = np.arange(len(vertices))
        corners = (index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:])
        northwest, northeast, southwest, southeast = (corner.ravel() for corner in corners)
        faces = [_complete(southwest, southeast, northeast), _complete(southwest, northeast, northwest)]
        # Where one end of that diagonal has no data, the other three cells are a triangle.
        faces.append(_complete(*(side[southwest < 0] for side in (southeast, northeast, northwest))))
        faces.append(_complete(*(side[northeast < 0] for side in (southwest, southeast, northwest))))
        triangles = np.concatenate(faces)
        if not len(triangles):
            raise InputError(
                "expected a grid with at least three adjacent cells with heights, got none: export it again"
            )
        return Mesh(vertices, triangles, crs=self.crs, unit=self.unit)

    def _vertices(self, warn: Warn) -> FloatArray:
        keep = np.isfinite(self.heights)
        count, kept = keep.size, int(np.count_nonzero(keep))
        if not kept:
            raise InputError(f"expected a grid with heights, got no data in all {count} cells: export it again")
        if count > kept:
            warn(f"left out {count - kept} of {count} cells without data")
        rows, columns = np.nonzero(keep)
        return np.stack([self.x[columns], self.y[rows], self.heights[keep]], axis=1)


def _complete(a: IntArray, b: IntArray, c: IntArray) -> IntArray:
    """Return the triangles (F, 3) of three lists of corners (N,) without those that have a missing corner, -1."""
    triangles: IntArray = np.stack([a, b, c], axis=1)
    return triangles[(triangles >= 0).all(axis=1)]
