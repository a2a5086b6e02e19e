"""Encode points and scalars compactly for the page: `viewer/decode.js` is the inverse.

Positions are quantised to 16 bits per axis of the layer's box and sorted along a Morton curve, so that neighbours
follow each other. Differences between successive points are small; their low and high bytes are stored in separate
planes, which deflate compresses well. A scalar takes one byte per point: its row in a table of levels.
"""

from __future__ import annotations

import base64
import zlib
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pcbench.geometry.arrays import FloatArray, IntArray

MAX_CODE = 65535  # of a position along an axis
UNKNOWN_CODE = 255  # of a scalar that is NaN
_COMPRESSION = 4  # twice as fast as 6, and 1 % larger
_FINE_SHARE = 0.7  # of the levels are spaced evenly up to the legend's limit; the others grow geometrically beyond it

Codes = NDArray[np.uint16]


class CodeGrid(NamedTuple):
    """The positions that 16 bits per axis can represent: `low + code * step`."""

    low: FloatArray  # (3,)
    step: FloatArray  # (3,)

    @classmethod
    def of(cls, points: FloatArray) -> CodeGrid:
        """Return the finest grid that covers points (N, 3), N > 0."""
        low = points.min(axis=0)
        return cls(low, (points.max(axis=0) - low) / MAX_CODE)

    def codes(self, points: FloatArray) -> Codes:
        """Return the nearest grid positions (N, 3) of points."""
        step = np.where(self.step > 0, self.step, 1.0)
        codes: Codes = np.clip(np.rint((points - self.low) / step), 0, MAX_CODE).astype(np.uint16)
        return codes


def morton_order(codes: Codes) -> IntArray:
    """Return the order of positions (N, 3) along a Morton curve, which interleaves the bits of the axes."""
    keys = np.zeros(len(codes), dtype=np.uint64)
    for axis in range(3):
        keys |= _spread_bits(codes[:, axis]) << np.uint64(axis)
    return np.argsort(keys, kind="stable")


def _spread_bits(values: Codes) -> NDArray[np.uint64]:
    """Insert two zero bits between the 16 bits of each value."""
    spread = values.astype(np.uint64)
    for shift, mask in ((16, 0x0000FF0000FF), (8, 0x00F00F00F00F), (4, 0x0C30C30C30C3), (2, 0x249249249249)):
        spread = (spread | (spread << np.uint64(shift))) & np.uint64(mask)
    return spread


def levels(values: FloatArray, limit: float, *, signed: bool) -> FloatArray:
    """Return ascending values that represent a scalar: even steps up to the legend's limit, growing ones beyond it.

    Args:
        values: (N,) the finite values.
        limit: the end of the legend.
        signed: whether the levels are symmetric about zero.
    """
    count = 127 if signed else 254
    highest = max(float(np.abs(values).max(initial=0.0)), limit)
    even = int(_FINE_SHARE * count) if highest > limit else count
    steps = np.linspace(0.0, limit, even + 1)
    if even < count:
        steps = np.concatenate([steps, np.geomspace(limit, highest, count - even + 1)[1:]])
    return np.concatenate([-steps[:0:-1], steps]) if signed else steps


def scalar_codes(values: FloatArray, table: FloatArray) -> NDArray[np.uint8]:
    """Return the row of the nearest level of each value (N,), and `UNKNOWN_CODE` for NaN."""
    middles = 0.5 * (table[1:] + table[:-1])
    is_known = np.isfinite(values)
    codes = np.searchsorted(middles, np.where(is_known, values, 0.0))
    return np.where(is_known, codes, UNKNOWN_CODE).astype(np.uint8)


def pack(codes: Codes, scalars: Sequence[NDArray[np.uint8]]) -> str:
    """Return positions (N, 3) in Morton order and scalars (N,) as base64 of deflated byte planes."""
    planes: list[NDArray[np.uint8]] = []
    for axis in range(3):
        deltas = np.diff(codes[:, axis], prepend=np.uint16(0)).view(np.int16)
        folded = ((deltas << 1) ^ (deltas >> 15)).view(np.uint16)  # 0, -1, 1, -2, ... become 0, 1, 2, 3, ...
        planes += [(folded & 0xFF).astype(np.uint8), (folded >> 8).astype(np.uint8)]
    data = np.concatenate([*planes, *scalars]).tobytes()
    return base64.b64encode(zlib.compress(data, _COMPRESSION)).decode("ascii")


def rounded(values: ArrayLike, digits: int = 9) -> list[float]:
    """Return values with the significant digits that a picture needs, in one list."""
    return [float(f"{value:.{digits}g}") for value in np.ravel(values)]
