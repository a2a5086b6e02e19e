"""Tails of weighted sums of chi squares."""

from __future__ import annotations

import math

import numpy as np

from pcbench.geometry.arrays import FloatArray


def chi_squares_tail(value: float, weights: FloatArray) -> float:
    """P(sum of weights chi^2_1 > value): a scaled chi square of the same two moments (Satterthwaite 1946), by Wilson &
    Hilferty's cube root (1931).
    """
    if value <= 0:
        return 1.0
    mean, freedom = _scaled_chi_square(weights)
    if mean <= 1e-12 * value:
        return 0.0
    z = ((value / mean) ** (1 / 3) - (1 - 2 / (9 * freedom))) / math.sqrt(2 / (9 * freedom))
    return 0.5 * math.erfc(z / math.sqrt(2))


def chi_squares_point(z: float, weights: FloatArray) -> float:
    """The value that `chi_squares_tail` gives the tail of a normal deviate z."""
    mean, freedom = _scaled_chi_square(weights)
    return mean * (1 - 2 / (9 * freedom) + z * math.sqrt(2 / (9 * freedom))) ** 3


def _scaled_chi_square(weights: FloatArray) -> tuple[float, float]:
    """Mean and degrees of freedom."""
    largest = float(np.max(weights, initial=0.0))
    if largest <= 0:
        return 0.0, 1.0
    relative = weights / largest  # squares of tiny weights would be zero
    return float(weights.sum()), float(relative.sum() ** 2 / np.square(relative).sum())
