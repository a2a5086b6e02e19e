"""Distances to tangent planes at a random sample of the queries, for comparisons with a tolerance.

The normals of a large reference take more time than the distances between points, which are therefore all measured.
They limit the distances to planes: with the angle a between the normal and the direction of the closest point, the
squared distance to the plane is cos^2 a times that to the point. The sample prefers distant queries, so that each one
contributes little to the estimated mean square, and far parts of a cloud cannot be missed.

Each query is selected on its own, if its random number is below its probability (Poisson sampling with permanent random
numbers; Ohlsson 1995, "Coordination of samples using permanent random numbers"). A larger sample therefore contains the
smaller one. The mean square is a ratio estimate: the known mean square of the distances to points, times the estimated
ratio of both (Särndal, Swensson & Wretman 1992, "Model Assisted Survey Sampling", section 7.3).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pcbench.geometry.arrays import FloatArray, IntArray

_FIRST_SIZE = 20_000  # expected number of queries of the first sample
_MAX_SHARE = 0.3  # of the queries; a larger sample would save no time
_UNIFORM_SHARE = 0.25  # of the sample; it represents queries close to the reference, for the median and the NMAD
_MAX_GROWTH = 16.0  # of the size of the sample in one round: the first estimates of the variance are rough
_Z = 1.96  # normal quantile of a two-sided 95 % interval
_RULE_OF_THREE = 3.0  # of queries that are expected in the sample 3 times, at least one is, with 95 % confidence


@dataclass(frozen=True, eq=False)
class PlaneSample:
    """Signed distances to tangent planes of a random sample of the queries.

    Attributes:
        rows: (S,) rows of the queries, ascending.
        distances: (S,) their signed distances.
        weights: (S,) weights: the weighted sum of the squared distances estimates the mean square of all queries.
        half_width: half of the width of the 95 % confidence interval of that estimate, in squared units.
        count: number of all queries.
    """

    rows: IntArray
    distances: FloatArray
    weights: FloatArray
    half_width: float
    count: int

    @property
    def mean_square(self) -> float:
        """Estimated mean squared distance of all queries."""
        return float(self.weights @ np.square(self.distances))

    def squares(self) -> FloatArray:
        """Return values (M,) whose mean over all queries, or any part of them, estimates that of the squares."""
        values = np.zeros(self.count)
        values[self.rows] = self.count * self.weights * np.square(self.distances)
        return values


def sample_planes(
    to_points: FloatArray, measure: Callable[[IntArray], FloatArray], tolerance: float, seed: int
) -> PlaneSample | None:
    """Measure distances to tangent planes at as few queries as a tolerance permits.

    Args:
        to_points: (M,) distances of all queries to their closest points, not all 0.
        measure: function that returns the signed distances (S,) to planes of the queries in ascending rows (S,).
        tolerance: largest half width of the 95 % confidence interval of the mean square, relative to its estimate.
        seed: random seed.

    Returns:
        The sample; None if it would not be much smaller than all queries.
    """
    count = len(to_points)
    squares = np.square(to_points)
    total = float(squares.sum())
    density = _UNIFORM_SHARE / count + (1 - _UNIFORM_SHARE) / total * squares
    order = np.random.default_rng(seed).random(count) / density  # a query is in all samples of a larger size
    distances = np.full(count, np.nan)
    size = float(_FIRST_SIZE)
    while True:
        rows = np.flatnonzero(order < size)
        if len(rows) > _MAX_SHARE * count:
            return None
        new = rows[np.isnan(distances[rows])]
        distances[new] = measure(new)
        probabilities = np.minimum(size * density[rows], 1.0)
        # No query contributes more to the estimate. Missed queries that would change it by more than `_RULE_OF_THREE`
        # times this contribution would be expected in the sample at least that many times.
        largest = total / ((1 - _UNIFORM_SHARE) * size * count)
        sample, sigma = _estimate(rows, distances[rows], squares[rows], probabilities, total / count, count)
        half_width = math.hypot(_Z * sigma, _RULE_OF_THREE * largest)
        wanted = tolerance * sample.mean_square
        if half_width <= wanted:
            return PlaneSample(rows, sample.distances, sample.weights, half_width, count)
        # The first part of the half width decreases with the square root of the size, the second one with the size.
        a, b = (_Z * sigma) ** 2 * size, _RULE_OF_THREE * largest * size
        needed = (a + math.hypot(a, 2 * b * wanted)) / (2 * wanted**2) if wanted > 0 else math.inf
        size *= min(max(1.1 * needed / size, 1.2), _MAX_GROWTH)


def _estimate(
    rows: IntArray, distances: FloatArray, squares: FloatArray, probabilities: FloatArray, mean: float, count: int
) -> tuple[PlaneSample, float]:
    """Return the sample with its weights, and the standard error of its mean square.

    Args:
        rows: (S,) rows of the queries.
        distances: (S,) signed distances to planes.
        squares: (S,) squared distances to points.
        probabilities: (S,) inclusion probabilities.
        mean: mean of the squared distances of all queries to points, above 0.
        count: number of all queries.
    """
    weights = 1 / (count * probabilities)
    estimated = float(weights @ squares)
    if estimated > 0:
        weights *= mean / estimated
    sample = PlaneSample(rows, distances, weights, math.inf, count)
    residuals = weights * (np.square(distances) - sample.mean_square / mean * squares)
    return sample, math.sqrt(float((1 - probabilities) @ np.square(residuals)))
