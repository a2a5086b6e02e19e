"""95 % confidence intervals of scores: their variation under new draws of the noise and of the points.

Neighbouring distances are correlated, so points are not an independent sample. A score is linearised as a sum over
cells of space. The variance of that sum adds the products of each cell with itself and with the cells around it, up to
the distance at which they are correlated (Conley 1999: a spatial heteroskedasticity- and autocorrelation-consistent
variance). That distance is chosen as by Politis & White 2004: the first one beyond which no significant correlation is
found. The same sum over the contributions to the variance estimates its own error, and hence the degrees of freedom of
Student's t. The registration is taken as exact, and maxima get no interval.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.voxels import robust_bounds
from pcbench.native import _core

_CELLS_ALONG_DIAGONAL = 28  # cells along the diagonal of the scene
_CORRELATION_RADII = (0, 1, 2, 3, 5, 8)  # candidate correlation lengths, in cells to either side
_CORRELATION_Z = 1.3  # standard errors by which the products of cells must exceed zero to count as correlated
_MIN_VARIANCE_SHARE = 0.2  # minimum share of the variance left after subtracting the mean
_UNSEEN_PROBABILITY = 0.025  # of exceptions that no query shows
_POINTS_PER_GAP = 2.0  # queries that fall into one gap of the other cloud
_MIN_DEGREES_OF_FREEDOM = 2.0  # lower bound of the estimate


CellNumbers = NDArray[np.int16]
"""Numbers of correlation cells: along a diagonal of 28 cells there are about 17 along each axis."""


class Interval(NamedTuple):
    """A 95 % confidence interval."""

    low: float
    high: float


class CorrelationCells(NamedTuple):
    """A partition of the scene into cubes; the outermost ones include the points beyond the robust bounds."""

    of_point: CellNumbers  # (N,) the cell of each point of the reference
    shape: tuple[int, ...]  # along the three axes
    side: float

    @property
    def number(self) -> int:
        """Number of cells."""
        return math.prod(self.shape)


class LinearizedScore(NamedTuple):
    """A score and the first-order contribution of each cell to its deviation from the expectation; they sum to 0."""

    value: float
    influence: FloatArray  # (B,)
    largest: float = math.inf  # upper bound of the score; the lower bound is 0
    queries: float = math.inf  # number of queries of a share


class ScoreUncertainty(NamedTuple):
    """The uncertainty of a score.

    Attributes:
        sigma: standard error of the score.
        degrees_of_freedom: degrees of freedom of the standard error.
        independent_regions: effective number of independent regions of the scene.
        reach: distance over which the distances are correlated, in the clouds' unit; 0 if neighbouring cells are
            uncorrelated.
    """

    sigma: float
    degrees_of_freedom: float
    independent_regions: float
    reach: float


class CorrelationGrid(NamedTuple):
    """The grid of the correlation cells: its lowest corner (3,), its shape, and the edge of a cell."""

    lower: FloatArray
    shape: tuple[int, ...]
    side: float

    @classmethod
    def covering(cls, lower: FloatArray, upper: FloatArray) -> CorrelationGrid:
        """Return the grid over a box with these corners (3,)."""
        side = float(np.linalg.norm(upper - lower)) / _CELLS_ALONG_DIAGONAL
        if not side > 0:  # all points coincide
            return cls(lower, (1, 1, 1), 0.0)
        shape = np.maximum(np.ceil((upper - lower) / side), 1).astype(np.int64)
        return cls(lower, tuple(int(size) for size in shape), side)

    @property
    def number(self) -> int:
        """Number of cells."""
        return math.prod(self.shape)

    def cells_of(self, points: FloatArray) -> CellNumbers:
        """Return the number of the cell of each point (N, 3); points outside belong to the outermost cells."""
        number = np.zeros(len(points), np.int16)
        if self.side > 0:
            for axis in range(3):
                along = np.clip((points[:, axis] - self.lower[axis]) / self.side, 0, self.shape[axis] - 1)
                number *= self.shape[axis]
                number += along.astype(np.int16)
        return number


def partition(points: FloatArray) -> CorrelationCells:
    """Cut the robust bounds of points (N, 3) into cubes."""
    grid = CorrelationGrid.covering(*robust_bounds(points))
    return CorrelationCells(grid.cells_of(points), grid.shape, grid.side)


def spreads(
    sampled: Mapping[str, LinearizedScore], cells: CorrelationCells, shares: FloatArray
) -> dict[str, ScoreUncertainty]:
    """Estimate the uncertainty of scores by name.

    Args:
        sampled: linearised scores by name.
        cells: the correlation cells.
        shares: (B,) share of the scene's points in each cell; the sum is 1.
    """
    if not sampled:
        return {}
    u = np.stack([score.influence for score in sampled.values()]).reshape(-1, *cells.shape)
    # Products of four influences are summed below: a power of two keeps those of far points finite, and all digits.
    exponents = np.frexp(np.abs(u).max(axis=(1, 2, 3)))[1]
    u = np.ldexp(u, -exponents[:, None, None, None])
    w = shares.reshape(1, *cells.shape)
    p = np.square(u)
    around = [_box_sums(u, reach) for reach in _CORRELATION_RADII]
    # Per radius: the sum of products, its variance if the cells were independent, and the share of pairs within it.
    within = np.stack([_grid_totals(u * sums) for sums in around])
    chance = np.stack([2 * _grid_totals(p * _box_sums(p, reach)) for reach in _CORRELATION_RADII])
    pairs = np.stack([_grid_totals(w * _box_sums(w, reach)) for reach in _CORRELATION_RADII])
    seen = np.diff(within, axis=0) > _CORRELATION_Z * np.sqrt(np.maximum(np.diff(chance, axis=0), 0))
    steps = np.cumprod(seen, axis=0, dtype=np.int64).sum(axis=0)
    uncertainties = {}
    for row, name in enumerate(sampled):
        step = int(steps[row])
        total, alone = float(within[step, row]), float(within[0, row])
        if not total > 0:  # equal values in all cells, or a single cell
            uncertainties[name] = ScoreUncertainty(0.0, math.inf, 1 / float(pairs[0, 0]), 0.0)
            continue
        # Subtracting the mean removed a share of the products of pairs within the radius.
        variance = total / max(1 - float(pairs[step, 0]), _MIN_VARIANCE_SHARE)
        parts = u[row] * around[step][row] - total * w[0]
        doubt = max(
            float(np.sum(parts * _box_sums(parts[None], _CORRELATION_RADII[step])[0])), float(np.sum(np.square(parts)))
        )
        # 2 V^2 / Var V, halved: with few regions the observed tails are too short, which overestimates it.
        degrees_of_freedom = max(total**2 / doubt, _MIN_DEGREES_OF_FREEDOM) if doubt > 0 else math.inf
        independent_regions = alone / (total * float(pairs[0, 0]))
        uncertainties[name] = ScoreUncertainty(
            math.ldexp(math.sqrt(variance), int(exponents[row])),
            degrees_of_freedom,
            independent_regions,
            _CORRELATION_RADII[step] * cells.side,
        )
    return uncertainties


def interval(score: LinearizedScore, spread: ScoreUncertainty) -> Interval:
    """Return the confidence interval of a score, computed on a log scale, or on a log-odds scale for a share.

    A share of 0 or of all queries shows no variation. Its interval reaches to the share whose exceptions would all have
    been missed with a probability of 2.5 % (Clopper & Pearson 1934), if exceptions come in gaps of several points.
    """
    value, largest = score.value, score.largest
    if largest < math.inf and value in (0, largest):
        rest = largest * (1 - _UNSEEN_PROBABILITY ** (_POINTS_PER_GAP / score.queries))
        return Interval(0.0, rest) if value == 0 else Interval(largest - rest, largest)
    if spread.sigma == 0 or not 0 < value < largest:
        return Interval(value, value)
    reach = student_t_quantile(spread.degrees_of_freedom) * spread.sigma * (1 / value + 1 / (largest - value))
    low, high = (value * math.exp(min(sign * reach, 700.0)) for sign in (-1, 1))
    if largest < math.inf:
        low, high = (largest * end / (largest - value + end) for end in (low, high))
    return Interval(low, high)


def difference(value: float, spread: ScoreUncertainty) -> Interval:
    """Return the confidence interval of a difference of two scores, which may be negative."""
    reach = student_t_quantile(spread.degrees_of_freedom) * spread.sigma if spread.sigma > 0 else 0.0
    return Interval(value - reach, value + reach)


def student_t_quantile(degrees_of_freedom: float) -> float:
    """Return the 97.5 % quantile of Student's t, for at least 2 degrees of freedom (relative error at most 0.8 %).

    Abramowitz & Stegun 1964, 26.7.5. Importing scipy for it would take longer than many comparisons.
    """
    z, n = 1.959963984540054, degrees_of_freedom
    return (
        z
        + (z**3 + z) / (4 * n)
        + (5 * z**5 + 16 * z**3 + 3 * z) / (96 * n**2)
        + (3 * z**7 + 19 * z**5 + 17 * z**3 - 15 * z) / (384 * n**3)
        + (79 * z**9 + 776 * z**7 + 1482 * z**5 - 1920 * z**3 - 945 * z) / (92160 * n**4)
    )


def _grid_totals(values: FloatArray) -> FloatArray:
    totals: FloatArray = values.sum(axis=(1, 2, 3))
    return totals


def _box_sums(values: FloatArray, reach: int) -> FloatArray:
    """Return (Q, X, Y, Z) sums over the cells up to `reach` cells away along each axis."""
    sums = np.empty(values.shape)
    _core.box_sums(np.ascontiguousarray(values), reach, sums)
    return sums
