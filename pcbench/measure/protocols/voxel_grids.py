"""Shares of points averaged over voxels, so that dense parts of a cloud do not dominate (Schoeps et al. 2017).

Two grids reduce the effect of their position: the second is shifted by half a voxel along each axis.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.voxels import Cells, cells

_SHIFTS = (0.0, 0.5)  # of the grids, in voxels

Mask = NDArray[np.bool_]


class VoxelGrids:
    """The voxels of points in both grids; a coordinate x is in voxel floor(x / side + shift).

    Args:
        points: (N, 3) coordinates in the precision of the evaluation, float32 or float64.
        side: length of a voxel's edges.
    """

    def __init__(self, points: NDArray[np.floating[Any]], side: float) -> None:
        # The official program multiplies by a rounded inverse, which decides on points at the faces of voxels.
        kind = points.dtype.type
        per_length = kind(1 / float(kind(side)))
        self._grids: list[Cells] = []
        for shift in _SHIFTS:
            numbers = np.floor(points * per_length + kind(shift)).astype(np.float64)
            self._grids.append(cells(numbers, 1.0, np.zeros(3)))

    @property
    def count(self) -> int:
        """Number of occupied voxels of both grids."""
        return sum(len(grid.first) for grid in self._grids)

    def mean_share(self, good: Mask, counted: Mask) -> float:
        """Return the mean, over all voxels with counted points, of the share of these that are good.

        Args:
            good: (N,) mask.
            counted: (N,) mask of the points that count.

        Returns:
            The mean of both grids; 0 if no point counts.
        """
        total, voxels = 0.0, 0
        for grid in self._grids:
            size = len(grid.first)
            numbers = np.bincount(grid.of_point, counted, size)
            occupied = numbers > 0
            shares = np.bincount(grid.of_point, good & counted, size)[occupied] / numbers[occupied]
            total += float(shares.sum())
            voxels += len(shares)
        return total / voxels if voxels else 0.0
