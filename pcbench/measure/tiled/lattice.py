"""Positions along a Morton curve: an order in which neighbours in space are mostly neighbours in the list.

G. M. Morton, "A computer oriented geodetic data base and a new technique in file sequencing", IBM, 1966.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.transform import Similarity

_BITS = 21  # per axis: three of them fit into 63 bits
CODE_BITS = 3 * _BITS
Codes = NDArray[np.uint64]
# Masks and shifts that spread the bits of a number to every third bit.
_SPREAD = (
    (32, 0x001F00000000FFFF),
    (16, 0x001F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)


@dataclass(frozen=True)
class Lattice:
    """A cube of 2^21 cells per axis, numbered along a Morton curve.

    No result depends on it, only the order in which points are stored. Points outside share the outermost cells.

    Attributes:
        low: lowest corner of the cube, in the reference's coordinates.
        side: edge of a cell.
        pose: motion to these coordinates from those of the points; approximate for a candidate.
    """

    low: tuple[float, float, float]
    side: float
    pose: Similarity | None = None

    @classmethod
    def around(cls, low: FloatArray, high: FloatArray) -> Lattice:
        """Return the lattice around a box with the corners `low` (3,) and `high` (3,)."""
        side = float((high - low).max()) / (1 << _BITS)
        return cls((float(low[0]), float(low[1]), float(low[2])), side if side > 0 else 1.0)

    def codes(self, points: FloatArray) -> Codes:
        """Return the number of the cell of each point (N, 3)."""
        if self.pose is not None:
            points = self.pose.apply(points)
        total = np.zeros(len(points), np.uint64)
        for axis, low in enumerate(self.low):
            place = np.clip((points[:, axis] - low) / self.side, 0, (1 << _BITS) - 1).astype(np.uint64)
            total |= _spread_bits(place) << np.uint64(axis)
        return total

    def box(self, code_range: tuple[int, int]) -> tuple[FloatArray, FloatArray]:
        """Return the corners (3,) of the box of a range of codes that halving the curve gives, without the pose."""
        first, last = code_range[0], code_range[1] - 1
        low, high = (np.array([_gather_bits(code >> axis) for axis in range(3)]) for code in (first, last))
        corner = np.array(self.low)
        return corner + self.side * low, corner + self.side * (high + 1)


def _gather_bits(code: int) -> int:
    """Return the number that every third bit of a code forms."""
    return sum((code >> 3 * bit & 1) << bit for bit in range(_BITS))


def _spread_bits(values: Codes) -> Codes:
    for shift, mask in _SPREAD:
        values = (values | values << np.uint64(shift)) & np.uint64(mask)
    return values
