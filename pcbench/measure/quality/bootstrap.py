"""95 % intervals by a bootstrap over blocks of space, because neighbouring values are correlated.

Blocks are drawn with replacement, each with all its values (Efron & Tibshirani 1993, section 8.6; Lahiri 2003 for
blocks in space). The interval has the 2.5 and 97.5 percentiles of the statistic over the draws.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from pcbench.geometry.arrays import FloatArray, IntArray

_DRAWS = 400
_MIN_BLOCKS = 6  # fewer blocks do not show the variation between them
_PERCENTILES = (2.5, 97.5)


class Estimate(NamedTuple):
    """A value with its 95 % interval; the ends are NaN if there are too few independent parts for one."""

    value: float
    low: float = math.nan
    high: float = math.nan

    @property
    def has_interval(self) -> bool:
        """Return whether the interval is known."""
        return math.isfinite(self.low) and math.isfinite(self.high)


def median_estimate(values: FloatArray, blocks: IntArray, seed: int, share: float = 0.5) -> Estimate | None:
    """Return the median, or another quantile, of values (N,) in blocks (N,); None without values."""
    if not len(values):
        return None
    order = np.argsort(values, kind="stable")
    ordered, places = values[order], blocks[order]

    def quantile(weights: FloatArray) -> float:
        sums = np.cumsum(weights[places])
        return float(ordered[min(int(np.searchsorted(sums, share * sums[-1])), len(ordered) - 1)])

    return _estimate(float(np.quantile(values, share)), blocks, quantile, seed)


def mean_estimate(values: FloatArray, blocks: IntArray, seed: int) -> Estimate | None:
    """Return the mean of values (N,) in blocks (N,); None without values."""
    if not len(values):
        return None
    size = int(blocks.max()) + 1
    sums, counts = np.bincount(blocks, values, size), np.bincount(blocks, minlength=size)
    return _estimate(float(values.mean()), blocks, lambda weights: float(weights @ sums / (weights @ counts)), seed)


def root_mean_square_estimate(values: FloatArray, blocks: IntArray, seed: int) -> Estimate | None:
    """Return the root mean square of values (N,) in blocks (N,); None without values."""
    square = mean_estimate(values**2, blocks, seed)
    return None if square is None else Estimate(*(math.sqrt(end) for end in square))


def statistic_estimate(value: float, blocks: IntArray, statistic: Callable[[FloatArray], float], seed: int) -> Estimate:
    """Return a value with the interval of a statistic of weighted values.

    Args:
        value: the value.
        blocks: (N,) block of each of its values.
        statistic: returns the statistic for the weights (B,) of the blocks.
        seed: seed of the draws.
    """
    return _estimate(value, blocks, statistic, seed)


def _estimate(value: float, blocks: IntArray, statistic: Callable[[FloatArray], float], seed: int) -> Estimate:
    occupied = np.unique(blocks)
    if len(occupied) < _MIN_BLOCKS:
        return Estimate(value)
    rng = np.random.default_rng(seed)
    weights = np.zeros((_DRAWS, int(occupied[-1]) + 1))
    weights[:, occupied] = rng.multinomial(len(occupied), np.full(len(occupied), 1 / len(occupied)), _DRAWS)
    draws = [statistic(row) for row in weights]
    low, high = np.percentile(draws, _PERCENTILES)
    return Estimate(value, min(float(low), value), max(float(high), value))
