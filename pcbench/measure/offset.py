"""Signed offset of a candidate from the reference's surface: its median, with an interval over correlation cells."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.order_statistics import NORMAL_MAD, median, value_of_rank
from pcbench.measure import intervals
from pcbench.measure.intervals import CellNumbers, CorrelationCells, Interval, LinearizedScore
from pcbench.measure.metrics import Distances
from pcbench.measure.plane_sample import PlaneSample

_MAX_MEDIANS = 3.0  # distance of the points that count, in medians: a part beyond the reference has no offset
_DENSITY_REACH = 0.3  # half width of the window in which the density at the median is counted, in NMADs
_MIN_NOISE_SHARE = 0.1  # of the NMAD: smaller offsets change no score


class SignedOffset(NamedTuple):
    """Median signed distance from the candidate to the reference's tangent planes, positive above the reference.

    Attributes:
        median: the median, in the clouds' unit.
        interval: its 95 % confidence interval. Errors are correlated within regions of the scene.
        nmad: normalised median absolute deviation of the same distances from their median.
    """

    median: float
    interval: Interval
    nmad: float

    @property
    def is_significant(self) -> bool:
        """Return whether the interval excludes zero and the median is not negligible beside the NMAD."""
        return not self.interval.low <= 0 <= self.interval.high and abs(self.median) >= _MIN_NOISE_SHARE * self.nmad


def signed_offset(distances: Distances, cell_of_query: CellNumbers, cells: CorrelationCells) -> SignedOffset | None:
    """Return the median offset of the distances candidate → reference; None without distances to planes.

    The median is linearised by the density of the distances at it (Bahadur 1966), so that its error adds up over cells
    like that of a mean.

    Args:
        distances: distances candidate → reference of the queries (M,).
        cell_of_query: (M,) correlation cell in which each query is measured.
        cells: correlation cells of the intervals.
    """
    to_points, planes = distances
    if planes is None or not len(to_points):
        return None
    if isinstance(planes, PlaneSample):
        rows, signed, weights = planes.rows, planes.distances, planes.weights
    else:
        rows, signed, weights = np.arange(len(planes)), planes, np.ones(len(planes))
    is_near = to_points[rows] <= _MAX_MEDIANS * median(to_points)
    rows, signed, weights = rows[is_near], signed[is_near], weights[is_near]
    if not weights.sum() > 0:
        return None
    weights = weights / weights.sum()
    middle_of = _weighted_median if isinstance(planes, PlaneSample) else _median_of_equal_weights
    middle = middle_of(signed, weights)
    nmad = NORMAL_MAD * middle_of(np.abs(signed - middle), weights)
    window = _DENSITY_REACH * nmad
    within = float(weights[np.abs(signed - middle) <= window].sum())
    if nmad == 0:
        return SignedOffset(middle, Interval(middle, middle), nmad)
    of_cell, number = cell_of_query[rows], cells.number
    shares = np.bincount(of_cell, weights, number).astype(np.float64)
    below = np.bincount(of_cell, weights * (signed <= middle), number).astype(np.float64)
    influence = (float(below.sum()) * shares - below) * 2 * window / within
    spread = intervals.spreads({"offset": LinearizedScore(middle, influence)}, cells, shares)["offset"]
    return SignedOffset(middle, intervals.difference(middle, spread), nmad)


def _weighted_median(values: FloatArray, weights: FloatArray) -> float:
    return float(np.percentile(values, 50, method="inverted_cdf", weights=weights))


def _median_of_equal_weights(values: FloatArray, weights: FloatArray) -> float:
    """Return the weighted median, whose rank does not depend on the values."""
    shares = np.cumsum(weights)
    rank = int(np.searchsorted(shares / shares[-1], 0.5))
    return value_of_rank(values, rank)
