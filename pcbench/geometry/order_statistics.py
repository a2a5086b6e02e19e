"""Percentiles, medians and median absolute deviations of one array, equal to numpy's to the last bit.

`numpy.percentile` and `numpy.median` copy and partition the array. The compiled selection reads it twice, and copies
only the values near the requested ranks: for a million distances it is three to five times faster. Coordinates far
from zero have common leading bits and gain nothing.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.native import _core

NORMAL_MAD = 1.4826  # the standard deviation of a normal distribution over its median absolute deviation
_MAX_PARTITIONED = 10_000  # smaller single arrays are partitioned by numpy: the selection's histogram costs


def percentiles(values: FloatArray, ranks: Sequence[float]) -> FloatArray:
    """Percentiles (R,) of values (N,), N >= 1, with linear interpolation: `numpy.percentile(values, ranks)`.

    All are NaN if a value is NaN.

    Args:
        values: (N,) values.
        ranks: (R,) ranks from 0 to 100.
    """
    if len(values) <= _MAX_PARTITIONED:
        return np.asarray(np.percentile(values, ranks), dtype=np.float64)
    neighbors, share = neighboring_ranks(len(values), ranks)
    below, above = _order_statistics(values, None, neighbors)
    return interpolate(below, above, share)


def percentiles_of_columns(values: FloatArray, ranks: Sequence[float]) -> FloatArray:
    """Percentiles (R, C) of each column of values (N, C), N >= 1: `numpy.percentile(values, ranks, axis=0)`."""
    neighbors, share = neighboring_ranks(len(values), ranks)
    columns = [_order_statistics(column, None, neighbors) for column in values.T]
    below, above = np.stack(columns, axis=2)
    return interpolate(below, above, share[:, None])


def neighboring_ranks(count: int, ranks: Sequence[float]) -> tuple[IntArray, FloatArray]:
    """Return the two order statistics (2, R) between which each percentile lies, and its share (R,) of the way.

    Args:
        count: number of values, at least 1; their order statistics are numbered from 0.
        ranks: (R,) ranks from 0 to 100.
    """
    position = (count - 1) * (np.asarray(ranks, dtype=np.float64) / 100)
    lower = np.floor(position).astype(np.int64)
    return np.array([lower, np.minimum(lower + 1, count - 1)]), position - lower


def interpolate(below: FloatArray, above: FloatArray, share: FloatArray) -> FloatArray:
    """Return the percentiles (R,) between order statistics (R,), with numpy's rounding; see `neighboring_ranks`."""
    with np.errstate(invalid="ignore"):  # between infinite values
        step = above - below
        interpolated: FloatArray = np.where(share >= 0.5, above - step * (1 - share), below + step * share)
    return interpolated


def robust_sigma(residuals: FloatArray) -> float:
    """Return the robust standard deviation about zero of residuals (N,), N >= 1: 1.4826 times the median size."""
    return NORMAL_MAD * median(np.abs(residuals))


def median(values: FloatArray) -> float:
    """Median of values (N,), N >= 1: `numpy.median(values)`. It is NaN if a value is NaN."""
    if len(values) <= _MAX_PARTITIONED:
        return float(np.median(values))
    return _middle(values, None)


def value_of_rank(values: FloatArray, rank: int) -> float:
    """Value of a rank, 0 the smallest, among values (N,) without NaN: `numpy.sort(values)[rank]`."""
    if len(values) <= _MAX_PARTITIONED:
        return float(np.partition(values, rank)[rank])
    return float(_order_statistics(values, None, np.array([rank]))[0])


def median_distance(values: FloatArray, center: float = 0.0) -> float:
    """Median distance of values (N,), N >= 1, from a number: `numpy.median(numpy.abs(values - center))`."""
    if len(values) <= _MAX_PARTITIONED:
        return float(np.median(np.abs(values - center)))
    return _middle(values, center)


def medians_of_rows(values: FloatArray, rows: IntArray) -> FloatArray:
    """Median (M,) of the values (N,) at each row of indices (M, K), K >= 1: `numpy.median(values[rows], axis=1)`.

    No value is NaN.

    Raises:
        IndexError: an index is negative, or not that of a value.
    """
    medians = np.empty(len(rows))
    _core.medians_of_rows(np.ascontiguousarray(values), np.ascontiguousarray(rows), medians)
    return medians


def _middle(values: FloatArray, center: float | None) -> float:
    count = len(values)
    low, high = _order_statistics(values, center, np.array([(count - 1) // 2, count // 2]))
    return 0.5 * (float(low) + float(high))


def _order_statistics(values: FloatArray, center: float | None, ranks: IntArray) -> FloatArray:
    """Return the values of ranks (...,) from 0 among values (N,), or among their distances from `center`."""
    ascending, inverse = np.unique(ranks, return_inverse=True)
    statistics = np.full(len(ascending), np.nan)
    _core.order_statistics(np.ascontiguousarray(values, np.float64), center, ascending, statistics)
    selected: FloatArray = statistics[inverse].reshape(ranks.shape)
    return selected
