"""Exact order statistics of values in many files, with bounded memory.

Doubles are ordered like integers made of their bits. A histogram of the leading bits finds the bins that contain the
wanted ranks. Further passes over the files count the next bits of the values in these bins only, for all ranks at once,
until all bits are known: a selection by radix (Knuth 1998, "The Art of Computer Programming" 3, sections 5.2.5 and
5.3.3). Histograms are exact counts, so files may be counted in any order and by any process.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import chain, islice
from pathlib import Path
from typing import NamedTuple, Protocol, TypeVar

import numpy as np

from pcbench.errors import InputError
from pcbench.geometry import order_statistics
from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.measure.tiled.sums import Groups

FIRST_BITS = 22  # sign, exponent and 10 bits of the mantissa: a bin is 0.1 % wide
_STEP_BITS = 14  # at most 2^14 bins per wanted bin
_MAX_RESOLVED = 1 << 18  # so few values are distinguished by all their bits at once
_VALUES_PER_BLOCK = 1 << 20
_HISTOGRAMS_PER_BATCH = 64
_TABLE_MASK = 2**16 - 1
_MAGNITUDE = np.int64(2**63 - 1)  # all bits but the sign

_Found = TypeVar("_Found")


class FileMap(Protocol):
    """A function that calls another one for each of many files: `map`, or one that distributes tasks."""

    def __call__(self, function: Callable[[Path], _Found], files: Sequence[Path], /) -> Iterable[_Found]:
        """Call a picklable function with each file, and return the results in any order."""


@dataclass(frozen=True, eq=False)
class BitHistogram:
    """Numbers of values by their leading bits, of values that are ordered like the bits.

    Attributes:
        bits: number of leading bits.
        bins: (B,) the occurring leading bits as integers, ascending.
        counts: (B,) number of values in each bin.
    """

    bits: int
    bins: IntArray
    counts: IntArray

    @classmethod
    def of(cls, values: FloatArray) -> BitHistogram:
        """Count values (N,).

        Raises:
            InputError: a value is not finite.
        """
        return cls._of_integers(_as_integers(values), FIRST_BITS)

    @classmethod
    def _of_integers(cls, integers: IntArray, bits: int) -> BitHistogram:
        bins, of_value = Groups.of(integers >> (64 - bits))
        return cls(bits, bins, np.bincount(of_value, minlength=len(bins)))

    @classmethod
    def merge(cls, parts: Iterable[BitHistogram]) -> BitHistogram:
        """Return the histogram of all values of one or several parts, which have the same bits."""
        remaining = iter(parts)
        merged = next(remaining)
        while batch := list(islice(remaining, _HISTOGRAMS_PER_BATCH)):
            batch.append(merged)
            bins, of_bin = Groups.of(np.concatenate([part.bins for part in batch]))
            counts = np.zeros(len(bins), np.int64)
            np.add.at(counts, of_bin, np.concatenate([part.counts for part in batch]))
            merged = cls(merged.bits, bins, counts)
        return merged

    @property
    def count(self) -> int:
        """Number of all values."""
        return int(self.counts.sum())

    def approximate_percentile(self, rank: float) -> float:
        """Return the order statistic nearest to a percentile, with a relative error below 0.1 %; NaN without values.

        The error is that of a bin. Magnitudes below 2e-308 are not resolved.

        Args:
            rank: rank of the percentile, from 0 to 100.
        """
        if not self.count:
            return float("nan")
        wanted = np.array([round((self.count - 1) * rank / 100)])
        bins = np.searchsorted(np.cumsum(self.counts), wanted, side="right")
        return float(_as_doubles(self.bins[bins] << (64 - self.bits))[0])


class Wanted(NamedTuple):
    """The values that a pass over the files counts, and how finely.

    Attributes:
        center: number whose distances from the values are counted; None: the values themselves.
        within: (W,) leading bits of the values that are counted, ascending; None: all values are counted.
        within_bits: number of these bits.
        bits: number of leading bits that are distinguished.
    """

    center: float | None
    within: IntArray | None
    within_bits: int
    bits: int


def count_values(file: Path, wanted: Wanted) -> BitHistogram:
    """Count the wanted values of one file (.npy) with an array (N,) of float64, which is read block by block.

    Raises:
        InputError: the file has another array, or a value that is not finite.
    """
    return BitHistogram.merge(
        chain(
            [BitHistogram(wanted.bits, np.empty(0, np.int64), np.empty(0, np.int64))],
            (_count_block(block, wanted) for block in _blocks(file)),
        )
    )


def select(
    files: Sequence[Path],
    histogram: BitHistogram,
    ranks: IntArray,
    *,
    center: float | None = None,
    map_files: FileMap = map,
) -> FloatArray:
    """Return the order statistics (R,) of all values of files.

    Args:
        files: files of values (.npy, float64).
        histogram: histogram of all these values, or of their distances from `center`.
        ranks: (R,) ranks from 0, the smallest value, to the number of values less 1, in any order.
        center: number whose distances from the values are ordered; None: the values themselves.
        map_files: calls a function with each file.

    Raises:
        InputError: a file is not readable, or does not have the values of the histogram.
    """
    while True:
        ends = np.cumsum(histogram.counts)
        parts = np.searchsorted(ends, ranks, side="right")
        if histogram.bits == 64:
            return _as_doubles(histogram.bins[parts])
        # Only the wanted bins are counted again, so ranks are counted from the values of these bins.
        wanted, which = np.unique(parts, return_inverse=True)
        counts = histogram.counts[wanted]
        before = np.cumsum(counts) - counts
        ranks = ranks - (ends - histogram.counts)[parts] + before[which]
        resolves_all = counts.sum() <= _MAX_RESOLVED
        bits = 64 if resolves_all else min(histogram.bits + _STEP_BITS, 64)
        request = Wanted(center, histogram.bins[wanted], histogram.bits, bits)
        histogram = BitHistogram.merge(map_files(partial(count_values, wanted=request), files))
        if histogram.count != counts.sum():
            raise InputError(
                f"expected {counts.sum()} values in the files of a comparison, got {histogram.count}:"
                " they changed while it was computed; repeat it"
            )


def percentiles(
    files: Sequence[Path], histogram: BitHistogram, ranks: Sequence[float], *, map_files: FileMap = map
) -> FloatArray:
    """Return percentiles (R,) of all values of files: `pcbench.geometry.order_statistics.percentiles`, bit for bit.

    Args:
        files: files of values (.npy, float64), at least one value.
        histogram: histogram of all these values.
        ranks: (R,) ranks from 0 to 100.
        map_files: calls a function with each file.

    Raises:
        InputError: see `select`.
    """
    neighbors, share = order_statistics.neighboring_ranks(histogram.count, ranks)
    below, above = select(files, histogram, neighbors.ravel(), map_files=map_files).reshape(2, -1)
    return order_statistics.interpolate(below, above, share)


def median(
    files: Sequence[Path], histogram: BitHistogram, *, center: float | None = None, map_files: FileMap = map
) -> float:
    """Return the median of all values of files, or of their distances from `center`; see `select`."""
    middle = np.array([(histogram.count - 1) // 2, histogram.count // 2])
    low, high = select(files, histogram, middle, center=center, map_files=map_files)
    return 0.5 * (float(low) + float(high))


def median_distance(files: Sequence[Path], center: float, *, map_files: FileMap = map) -> float:
    """Return the median distance of all values of files (at least one value) from a number, bit for bit as in memory.

    Raises:
        InputError: a file is not readable.
    """
    everything = Wanted(center, None, 0, FIRST_BITS)
    histogram = BitHistogram.merge(map_files(partial(count_values, wanted=everything), files))
    return median(files, histogram, center=center, map_files=map_files)


def _blocks(file: Path) -> Iterator[FloatArray]:
    values = np.load(file, mmap_mode="r")
    if values.ndim != 1 or values.dtype != np.float64:
        raise InputError(f"{file}: expected an array (N,) of float64, got {values.shape} of {values.dtype}")
    for start in range(0, len(values), _VALUES_PER_BLOCK):
        yield np.array(values[start : start + _VALUES_PER_BLOCK])


def _count_block(values: FloatArray, wanted: Wanted) -> BitHistogram:
    integers = _as_integers(values if wanted.center is None else np.abs(values - wanted.center))
    if wanted.within is not None:
        # Most values differ from all wanted bins in their last bits already: a table finds them faster than a search.
        is_possible = np.zeros(_TABLE_MASK + 1, bool)
        is_possible[wanted.within & _TABLE_MASK] = True
        integers = integers[is_possible[integers >> (64 - wanted.within_bits) & _TABLE_MASK]]
        leading = integers >> (64 - wanted.within_bits)
        places = np.searchsorted(wanted.within, leading)
        places[places == len(wanted.within)] = 0
        integers = integers[wanted.within[places] == leading]
    return BitHistogram._of_integers(integers, wanted.bits)


def _as_integers(values: FloatArray) -> IntArray:
    """Return integers in the order of finite values: their bits, reversed for negative values."""
    if not np.isfinite(values).all():
        raise InputError(f"expected finite values, got {values[~np.isfinite(values)][0]}")
    bits = (values + 0.0).view(np.int64)  # -0.0 becomes 0.0: they are equal
    return bits ^ (bits >> 63 & _MAGNITUDE)


def _as_doubles(integers: IntArray) -> FloatArray:
    bits: IntArray = integers ^ (integers >> 63 & _MAGNITUDE)
    return bits.view(np.float64)
