"""How far a score would move with another draw of noise and of points: 95 % intervals.

Neighbouring distances are alike, so points are no independent sample. A score is written as a sum over cells of space
(its linearisation), and the variance of that sum is that of the cells and of their products with the cells around them,
as far as these show that they are alike (Conley 1999: a spatial heteroskedasticity- and autocorrelation-consistent
variance; the distance is chosen as by Politis & White 2004: the first at which nothing is seen any more). The same sum
over the contributions to the variance tells how well that is known, hence the degrees of freedom of Student's t. The
registration is taken as it is, and maxima get no interval.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.voxels import robust_bounds

_CELLS_ALONG = 28  # the diagonal of the scene
_REACHES = (0, 1, 2, 3, 5, 8)  # cells to either side, within which cells may be alike
_SEEN = 1.3  # standard deviations by which products of cells must be positive to count as alike
_LEAST_LEFT = 0.2  # of the variance, after the mean was subtracted
_LEAST_DEGREES = 2.0  # of freedom


class Interval(NamedTuple):
    """A 95 % interval."""

    low: float
    high: float


class CorrelationCells(NamedTuple):
    """A partition of the scene into cubes; those at the edges hold the stragglers beyond."""

    of_point: IntArray  # (N,) the cell of each point of the reference
    shape: tuple[int, ...]  # along the three axes
    side: float

    @property
    def number(self) -> int:
        return math.prod(self.shape)


class Sampled(NamedTuple):
    """A score, and what each cell adds to its deviation from the expected value: to first order, and 0 in sum."""

    value: float
    influence: FloatArray  # (B,)
    largest: float = math.inf  # that the score can be; the least is 0


class ScoreUncertainty(NamedTuple):
    """How well a score is known.

    Attributes:
        sigma: its standard deviation.
        degrees: of freedom of that.
        pieces: the number of independent pieces of the scene.
        reach: the distance over which its distances are alike, in the clouds' unit; 0 where neighbouring cells are not.
    """

    sigma: float
    degrees: float
    pieces: float
    reach: float


def partition(points: FloatArray) -> CorrelationCells:
    """Cut the robust bounds of points (N, 3) into cubes."""
    lower, upper = robust_bounds(points)
    side = float(np.linalg.norm(upper - lower)) / _CELLS_ALONG
    if not side > 0:  # all points at one place
        return CorrelationCells(np.zeros(len(points), np.int64), (1, 1, 1), 0.0)
    shape = np.maximum(np.ceil((upper - lower) / side), 1).astype(np.int64)
    number = np.zeros(len(points), np.int64)
    for axis in range(3):
        along = np.clip((points[:, axis] - lower[axis]) / side, 0, shape[axis] - 1).astype(np.int64)
        number = number * shape[axis] + along
    return CorrelationCells(number, tuple(int(size) for size in shape), side)


def spreads(sampled: Mapping[str, Sampled], cells: CorrelationCells, shares: FloatArray) -> dict[str, ScoreUncertainty]:
    """Of scores by name. shares (B,): of the scene's points in each cell; the sum is 1."""
    if not sampled:
        return {}
    u = np.stack([score.influence for score in sampled.values()]).reshape(-1, *cells.shape)
    w = shares.reshape(1, *cells.shape)
    p = np.square(u)
    around = [_around(u, reach) for reach in _REACHES]
    # Of each reach: the sum of products, its variance if the cells were independent, and the share of pairs within.
    within = np.stack([_total(u * found) for found in around])
    chance = np.stack([2 * _total(p * _around(p, reach)) for reach in _REACHES])
    pairs = np.stack([_total(w * _around(w, reach)) for reach in _REACHES])
    seen = np.diff(within, axis=0) > _SEEN * np.sqrt(np.maximum(np.diff(chance, axis=0), 0))
    steps = np.cumprod(seen, axis=0, dtype=np.int64).sum(axis=0)
    found = {}
    for row, name in enumerate(sampled):
        step = int(steps[row])
        total, alone = float(within[step, row]), float(within[0, row])
        if not total > 0:
            found[name] = ScoreUncertainty(0.0, math.inf, math.inf, 0.0)
            continue
        # The mean was subtracted, and with it the products of the pairs within reach lost their share.
        variance = total / max(1 - float(pairs[step, 0]), _LEAST_LEFT)
        parts = u[row] * around[step][row] - total * w[0]
        doubt = max(float(np.sum(parts * _around(parts[None], _REACHES[step])[0])), float(np.sum(np.square(parts))))
        # 2 V^2 / Var V, and half of it: the tails that few pieces do not show make it too large.
        degrees = max(total**2 / doubt, _LEAST_DEGREES) if doubt > 0 else math.inf
        pieces = alone / (total * float(pairs[0, 0]))
        found[name] = ScoreUncertainty(math.sqrt(variance), degrees, pieces, _REACHES[step] * cells.side)
    return found


def interval(score: Sampled, spread: ScoreUncertainty) -> Interval:
    """On a scale on which scores are about normal: the logarithm, and that of the odds of a share."""
    value, largest = score.value, score.largest
    if spread.sigma == 0 or not 0 < value < largest:
        return Interval(value, value)
    reach = quantile(spread.degrees) * spread.sigma * (1 / value + 1 / (largest - value))
    low, high = (value * math.exp(min(sign * reach, 700.0)) for sign in (-1, 1))
    if largest < math.inf:
        low, high = (largest * end / (largest - value + end) for end in (low, high))
    return Interval(low, high)


def difference(value: float, spread: ScoreUncertainty) -> Interval:
    """Of two scores, which may be negative."""
    reach = quantile(spread.degrees) * spread.sigma if spread.sigma > 0 else 0.0
    return Interval(value - reach, value + reach)


def quantile(degrees: float) -> float:
    """Student's t at the upper end of a 95 % interval, for 2 degrees of freedom (to 0.8 %) and more.

    Abramowitz & Stegun 1964, 26.7.5: scipy, which knows it too, takes longer to import than many a comparison.
    """
    z, n = 1.959963984540054, degrees
    return (
        z
        + (z**3 + z) / (4 * n)
        + (5 * z**5 + 16 * z**3 + 3 * z) / (96 * n**2)
        + (3 * z**7 + 19 * z**5 + 17 * z**3 - 15 * z) / (384 * n**3)
        + (79 * z**9 + 776 * z**7 + 1482 * z**5 - 1920 * z**3 - 945 * z) / (92160 * n**4)
    )


def _total(values: FloatArray) -> FloatArray:
    totals: FloatArray = values.sum(axis=(1, 2, 3))
    return totals


def _around(values: FloatArray, reach: int) -> FloatArray:
    """(Q, X, Y, Z) sums over each cell and those up to `reach` cells away along every axis."""
    for axis in (1, 2, 3):
        size = values.shape[axis]
        if reach == 0 or size == 1:
            continue
        sums = np.concatenate([np.zeros_like(values.take([0], axis)), np.cumsum(values, axis)], axis)
        place = np.arange(size)
        above, below = np.minimum(place + reach + 1, size), np.maximum(place - reach, 0)
        values = sums.take(above, axis) - sums.take(below, axis)
    return values
