"""Cells that partition space: a large scene is reconstructed block by block, each block owns the points of its cell.

Cells are half-open boxes, so that each point of space lies in exactly one of them: no point of the result appears
twice, and none is lost at a border. They are the leaves of a k-d tree (Bentley 1975), split at the median along the
longest side until each fits into memory.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray, IntArray

_TAIL_SHARE = 0.05  # of the points at each end of an axis, left out of its extent because of outliers


@dataclass(frozen=True, eq=False)
class SpaceCell:
    """A box that contains its lower bounds, but not its upper ones.

    Args:
        lower: (3,), -inf where the cell is unbounded.
        upper: (3,), inf where the cell is unbounded.
    """

    lower: FloatArray
    upper: FloatArray

    def contains(self, points: FloatArray) -> NDArray[np.bool_]:
        """Return the mask (N,) of the points (N, 3) in the cell."""
        return np.asarray(((points >= self.lower) & (points < self.upper)).all(axis=1))

    def meets(self, other: SpaceCell) -> bool:
        """Return whether some point lies in both cells, or on their borders."""
        return bool((self.lower <= other.upper).all() and (other.lower <= self.upper).all())

    def grow(self, margin: float) -> SpaceCell:
        """Return the cell with a margin on all sides."""
        return SpaceCell(self.lower - margin, self.upper + margin)

    def split(self, axis: int, border: float) -> tuple[SpaceCell, SpaceCell]:
        """Return the parts below a coordinate, and from it on."""
        upper, lower = self.upper.copy(), self.lower.copy()
        upper[axis] = lower[axis] = border
        return replace(self, upper=upper), replace(self, lower=lower)


SPACE = SpaceCell(np.full(3, -np.inf), np.full(3, np.inf))


def bounding_cell(points: FloatArray) -> SpaceCell:
    """Return the smallest box around N > 0 points (N, 3)."""
    return SpaceCell(points.min(axis=0), points.max(axis=0))


def split_space(points: FloatArray, fits: Callable[[IntArray], bool]) -> list[SpaceCell]:
    """Partition space into cells that fit into memory.

    Args:
        points: (N, 3) samples of the surface.
        fits: returns whether a cell with the given points (M,) is small enough. A cell whose points all coincide is
            not split.

    Returns:
        The cells, neighbors mostly one after the other: each point of space lies in exactly one.
    """
    return _split(SPACE, points, np.arange(len(points)), fits)


def _split(cell: SpaceCell, points: FloatArray, rows: IntArray, fits: Callable[[IntArray], bool]) -> list[SpaceCell]:
    if len(rows) < 2 or fits(rows):
        return [cell]
    part = points[rows]
    extent = np.ptp(np.quantile(part, [_TAIL_SHARE, 1 - _TAIL_SHARE], axis=0), axis=0)
    # If outliers alone differ along an axis, its extent is 0, and their full range decides.
    axis = int(np.argmax(extent if extent.any() else np.ptp(part, axis=0)))
    coordinates = np.sort(part[:, axis])
    higher = coordinates[coordinates > coordinates[0]]
    if not len(higher):
        return [cell]
    border = max(float(coordinates[len(coordinates) // 2]), float(higher[0]))  # neither part is empty
    is_lower = part[:, axis] < border
    lower, upper = cell.split(axis, border)
    return _split(lower, points, rows[is_lower], fits) + _split(upper, points, rows[~is_lower], fits)
