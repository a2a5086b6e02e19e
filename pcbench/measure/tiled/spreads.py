"""Summary statistics of values in many files, equal to those of one array in memory."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pcbench.geometry import order_statistics
from pcbench.geometry.arrays import FloatArray
from pcbench.measure.deviation import Spread
from pcbench.measure.metrics import PERCENTILE_RANKS
from pcbench.measure.tiled.ranks import BitHistogram, FileMap, median_distance, select
from pcbench.measure.tiled.sums import GroupSums

_SPLITTER = 2.0**27 + 1  # splits a double into two halves of its mantissa


@dataclass(frozen=True, eq=False)
class Distribution:
    """Counts and sums of values, which can be merged.

    Attributes:
        histogram: numbers of values by their leading bits.
        moments: sums of `value`, and of its square as `square` plus `square_error`: both together are exact.
    """

    histogram: BitHistogram
    moments: GroupSums

    @classmethod
    def of(cls, values: FloatArray) -> Distribution:
        """Summarise values (N,).

        Raises:
            InputError: a value is not finite, or not below 2e14 in magnitude.
        """
        square, error = _exact_squares(values)
        moments = GroupSums.of(None, {"value": values, "square": square, "square_error": error})
        return cls(BitHistogram.of(values), moments)

    @classmethod
    def merge(cls, parts: Iterable[Distribution]) -> Distribution:
        """Return the distribution of all values of one or several parts."""
        distributions = list(parts)
        return cls(
            BitHistogram.merge(p.histogram for p in distributions), GroupSums.merge([p.moments for p in distributions])
        )

    @property
    def count(self) -> int:
        """Number of values."""
        return self.moments.count

    @property
    def mean(self) -> float:
        """Mean of the values; NaN if there are none."""
        return self.moments.mean("value")

    @property
    def mean_square(self) -> float:
        """Mean of the squares; NaN if there are none."""
        return self.moments.mean("square")

    @property
    def std(self) -> float:
        """Standard deviation about the mean, with ddof 0; NaN if there are no values.

        It is computed from exact sums: the difference of the mean square and the squared mean loses no digits.
        """
        if not self.count:
            return math.nan
        squares = self.moments.exact_total("square") + self.moments.exact_total("square_error")
        variance = squares / self.count - (self.moments.exact_total("value") / self.count) ** 2
        return math.sqrt(max(float(variance), 0.0))  # dropped bits of tiny values could make it negative


def spread_of(files: Sequence[Path], distribution: Distribution, *, map_files: FileMap = map) -> Spread:
    """Return the summary statistics of all values of files, as `Spread.of` of one array.

    Percentiles, median and NMAD are equal in all bits. The moments, from exact sums, are at least as accurate.

    Args:
        files: files of values (.npy, float64).
        distribution: distribution of all these values.
        map_files: calls a function with each file.

    Raises:
        InputError: a file is not readable, or does not have these values.
    """
    count = distribution.count
    if not count:
        return Spread()
    neighbors, share = order_statistics.neighboring_ranks(count, PERCENTILE_RANKS)
    # The two order statistics of the median are among those of the 50th percentile.
    wanted = np.concatenate([*neighbors, [(count - 1) // 2, count // 2]])
    *order_values, low, high = select(files, distribution.histogram, wanted, map_files=map_files)
    below, above = np.array(order_values).reshape(2, -1)
    values = order_statistics.interpolate(below, above, share)
    ranks = {f"p{rank:g}": float(value) for rank, value in zip(PERCENTILE_RANKS, values, strict=True)}
    nmad = order_statistics.NORMAL_MAD * median_distance(files, 0.5 * (float(low) + float(high)), map_files=map_files)
    return Spread(ranks, math.sqrt(distribution.mean_square), distribution.mean, ranks["p50"], distribution.std, nmad)


def _exact_squares(values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the rounded squares (N,) of values, and their rounding errors (Dekker 1971).

    "A floating-point technique for extending the available precision", Numerische Mathematik 18.
    """
    square = np.square(values)
    scaled = _SPLITTER * values
    high = scaled - (scaled - values)
    low = values - high
    return square, ((high * high - square) + 2 * high * low) + low * low
