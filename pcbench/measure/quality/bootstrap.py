"""95 % intervals by a bootstrap over blocks of space, because neighbouring values are correlated.

Blocks are drawn with replacement, each with all its values (Efron & Tibshirani 1993, section 8.6; Lahiri 2003 for
blocks in space). The interval has the 2.5 and 97.5 percentiles of the statistic over the draws.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray

_DRAWS = 300
_MAX_QUANTILES = 512
_MIN_BLOCKS = 6  # fewer blocks do not show the variation between them
_PERCENTILES = (2.5, 97.5)


class BlockEstimate(NamedTuple):
    """A value with its 95 % interval; the ends are NaN if there are too few independent parts for one."""

    value: float
    low: float = math.nan
    high: float = math.nan

    @property
    def has_interval(self) -> bool:
        """Return whether the interval is known."""
        return math.isfinite(self.low) and math.isfinite(self.high)


def median_estimate(values: FloatArray, blocks: NDArray[np.integer[Any]], seed: int) -> BlockEstimate | None:
    """Return the median of values (N,) in blocks (N,); None without values.

    The ends of its interval are among at most 512 quantiles of the values.
    """
    if not len(values):
        return None
    order = np.argsort(values)
    bins = min(len(values), _MAX_QUANTILES)
    bin_of = np.arange(len(values)) * bins // len(values)
    quantiles = values[order[((np.arange(bins) + 0.5) * len(values) / bins).astype(np.int64)]]
    occupied, places = np.unique(blocks, return_inverse=True)
    counts = np.bincount(places[order] * bins + bin_of, minlength=len(occupied) * bins).reshape(-1, bins)

    def medians(weights: FloatArray) -> FloatArray:
        sums = np.cumsum(weights @ counts, axis=1)
        return np.asarray(quantiles[(sums < 0.5 * sums[:, -1:]).sum(axis=1)])

    return statistic_estimate(float(np.median(values)), len(occupied), medians, seed)


def mean_estimate(values: FloatArray, blocks: NDArray[np.integer[Any]], seed: int) -> BlockEstimate | None:
    """Return the mean of values (N,) in blocks (N,); None without values."""
    if not len(values):
        return None
    occupied, places = np.unique(blocks, return_inverse=True)
    sums, counts = np.bincount(places, values), np.bincount(places)
    return statistic_estimate(
        float(values.mean()), len(occupied), lambda weights: (weights @ sums) / (weights @ counts), seed
    )


def root_mean_square_estimate(values: FloatArray, blocks: NDArray[np.integer[Any]], seed: int) -> BlockEstimate | None:
    """Return the root mean square of values (N,) in blocks (N,); None without values."""
    square = mean_estimate(values**2, blocks, seed)
    return None if square is None else BlockEstimate(*(math.sqrt(end) for end in square))


def statistic_estimate(
    value: float, count: int, statistics: Callable[[FloatArray], FloatArray], seed: int
) -> BlockEstimate:
    """Return a value with the interval of a statistic of weighted parts.

    Args:
        value: the value.
        count: number of independent parts.
        statistics: returns the statistic for each draw (D,) of weights (D, count) of the parts.
        seed: seed of the draws.
    """
    if count < _MIN_BLOCKS:
        return BlockEstimate(value)
    rng = np.random.default_rng(seed)
    draws = statistics(rng.multinomial(count, np.full(count, 1 / count), _DRAWS).astype(np.float64))
    low, high = np.percentile(draws, _PERCENTILES)
    return BlockEstimate(value, min(float(low), value), max(float(high), value))
