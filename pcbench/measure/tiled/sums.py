"""Exact sums of values by group that can be merged: the result depends neither on tiles nor on any order.

A sum of doubles in floating point depends on the order of the additions. Here each value is added as an integer
multiple of 2^-128 to a fixed-point number of 256 bits (Kulisch 2013, "Computer Arithmetic and Validity", chapter 8:
a long accumulator). Integer additions are exact.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.errors import InputError
from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.native import _core

_LIMBS = 8  # of 32 bits each
_FRACTION_BITS = 128
_MAX_SPARSITY = 8  # keys are grouped by a table if their range is at most this many times their number


class Groups(NamedTuple):
    """Values grouped by integer keys."""

    keys: IntArray  # (K,) the occurring keys, ascending
    of_value: IntArray  # (N,) the group of each value

    @classmethod
    def of(cls, keys: IntArray) -> Groups:
        """Group values by their keys (N,)."""
        if not len(keys):
            return cls(np.empty(0, np.int64), np.empty(0, np.int64))
        lowest = int(keys.min())
        extent = int(keys.max()) - lowest + 1
        if extent > _MAX_SPARSITY * len(keys):
            unique_keys, of_value = np.unique(keys, return_inverse=True)
            return cls(unique_keys, of_value.astype(np.int64, copy=False))
        offsets = keys - lowest
        occurs = np.zeros(extent, bool)
        occurs[offsets] = True
        return cls(np.flatnonzero(occurs) + lowest, (np.cumsum(occurs) - 1)[offsets])


@dataclass(frozen=True, eq=False)
class GroupSums:
    """Sums of one or several quantities over groups of values.

    Bits of a value below 2^-128 (3e-39) are dropped, so that a sum of n values is exact but for n times 2^-128.

    Attributes:
        keys: (K,) keys of the groups that have values, ascending.
        counts: (K,) number of values in each group.
        limbs: (K, 8) sums of each quantity by name: limb k counts 2^(32 k - 128); the limbs are the digits of the sum
            in two's complement.
    """

    keys: IntArray
    counts: IntArray
    limbs: Mapping[str, NDArray[np.uint32]]

    @classmethod
    def of(cls, groups: IntArray | Groups | None, quantities: Mapping[str, FloatArray]) -> GroupSums:
        """Sum values of each quantity (N,) by group.

        Args:
            groups: (N,) keys of the values, or their groups; None: all values have the key 0.
            quantities: (N,) values by name.

        Raises:
            InputError: a value is not finite, or not below 2^96 (8e28) in magnitude.
        """
        if groups is None:
            count = len(next(iter(quantities.values())))
            groups = Groups(np.zeros(min(count, 1), np.int64), np.zeros(count, np.int64))
        elif not isinstance(groups, Groups):
            groups = Groups.of(groups)
        of_value, number = groups.of_value, len(groups.keys)
        limbs = {name: _sum_exactly(name, values, of_value, number) for name, values in quantities.items()}
        return cls(groups.keys, np.bincount(of_value, minlength=number), limbs)

    @classmethod
    def merge(cls, parts: Sequence[GroupSums]) -> GroupSums:
        """Return the sums over all values of one or several parts, which have the same quantities."""
        groups = Groups.of(np.concatenate([part.keys for part in parts]))
        places = np.split(groups.of_value, np.cumsum([len(part.keys) for part in parts])[:-1])
        counts = np.zeros(len(groups.keys), np.int64)
        for part, rows in zip(parts, places, strict=True):
            counts[rows] += part.counts
        limbs = {}
        for name in parts[0].limbs:
            limbs[name] = np.empty((len(groups.keys), _LIMBS), np.uint32)
            carried = np.zeros(len(groups.keys), np.int64)
            for k in range(_LIMBS):  # one at a time: as 64-bit integers all would take twice as much memory
                for part, rows in zip(parts, places, strict=True):
                    carried[rows] += _signed(part.limbs[name], k)
                limbs[name][:, k] = carried & 0xFFFFFFFF
                top, carried = carried, carried >> 32
            _check_top(top)
        return cls(groups.keys, counts, limbs)

    @classmethod
    def empty(cls, count: int, names: Sequence[str]) -> GroupSums:
        """Return the sums of no values over groups 0 to `count` - 1, to which `add` adds those of parts."""
        limbs = {name: np.zeros((count, _LIMBS), np.uint32) for name in names}
        return cls(np.arange(count), np.zeros(count, np.int64), limbs)

    def add(self, part: GroupSums) -> None:
        """Add the sums of a part in place, to sums over groups 0 to K - 1: only the groups of the part are computed."""
        keys = part.keys
        before = GroupSums(keys, self.counts[keys], {name: limbs[keys] for name, limbs in self.limbs.items()})
        total = GroupSums.merge([before, part])
        self.counts[keys] = total.counts
        for name, limbs in self.limbs.items():
            limbs[keys] = total.limbs[name]

    @property
    def count(self) -> int:
        """Number of all values."""
        return int(self.counts.sum())

    def sums(self, name: str) -> FloatArray:
        """Return the sum (K,) of each group, rounded once: the nearest double."""
        totals = np.empty(len(self.keys))
        _core.round_exactly(self.limbs[name], totals)
        return totals

    def means(self, name: str) -> FloatArray:
        """Return the mean (K,) of each group: its rounded sum divided by its count."""
        means: FloatArray = self.sums(name) / self.counts
        return means

    def exact_total(self, name: str) -> Fraction:
        """Return the sum over all groups as an exact fraction."""
        digits = [int(_signed(self.limbs[name], k).sum()) for k in range(_LIMBS)]
        return Fraction(sum(digit << 32 * k for k, digit in enumerate(digits)), 1 << _FRACTION_BITS)

    def total(self, name: str) -> float:
        """Return the sum over all groups, rounded once: the nearest double."""
        return float(self.exact_total(name))

    def mean(self, name: str) -> float:
        """Return the mean of all values, rounded once: the nearest double; NaN if there are none."""
        return float(self.exact_total(name) / self.count) if self.count else float("nan")


def unsummable(name: str, values: FloatArray) -> InputError:
    """Return the error that some of the values (N,) of a quantity are not finite, or too large."""
    worst = values[np.argmax(np.where(np.isnan(values), np.inf, np.abs(values)))]
    return InputError(
        f"expected finite values below 8e28 to sum ({name}), got {worst:g}: remove points that stand for missing"
        " data, or lie far away by mistake (pcbench convert FILE OUT --drop-nodata)"
    )


def _sum_exactly(name: str, values: FloatArray, groups: IntArray, number: int) -> NDArray[np.uint32]:
    limbs = np.zeros((number, _LIMBS), np.uint32)
    if not _core.add_exactly(np.ascontiguousarray(values, np.float64), groups, limbs):
        raise unsummable(name, values)
    return limbs


def _check_top(limbs: IntArray) -> None:
    """Check the last limbs (K,) of sums, with all that was carried to them."""
    if len(limbs) and max(limbs.max(), -limbs.min()) >= 1 << 31:
        raise InputError("expected sums below 1e38 in magnitude, got larger ones")


def _signed(limbs: NDArray[np.uint32], k: int) -> IntArray:
    """Return limb k (K,) of sums as integers that can be added: only the last one has a sign."""
    return (limbs[:, k].astype(np.int32) if k == _LIMBS - 1 else limbs[:, k]).astype(np.int64)
