"""Tail probabilities of weighted sums of chi squares, Q = sum_i w_i z_i^2 with standard normal z_i.

P(Q > x) is the integral of exp(K(t) - t x) / t over 2 pi i, where K(t) = -1/2 sum log(1 - 2 w_i t) is the cumulant
generating function, along any path from below to above that crosses the real axis between 0 and 1 / (2 max w). A path
through the saddle point of the integrand (Rice 1980, SIAM J. Sci. Stat. Comput. 1, 438) that follows the steepest
descent has no oscillations. Thirty nodes of the trapezoidal rule suffice, and the error is relative to the tail,
however small. Imhof's integral (1961) follows the imaginary axis, where a tail of 1e-8 is the difference of terms near
one. A scaled chi square with the same two moments (Satterthwaite 1946) is wrong by orders of magnitude at 1e-5.
"""

from __future__ import annotations

import math

import numpy as np

from pcbench.geometry.arrays import FloatArray, IntArray

# Spacing of the nodes u, and their range; sinh(u) covers weights of all sizes.
_NODE_SPACING, _NODE_RANGE = 0.2, 6.0
_MAX_NEWTON_STEPS = 100  # each step at least halves the bracket
_SADDLE_TOLERANCE = 1e-3  # relative tolerance: the path need not pass exactly through the saddle point
_TAIL_TOLERANCE = 1e-9  # relative tolerance of the tail probability
_MIN_VALUE = 1e-33  # in units of the largest weight: a smaller value has a probability of less than 1e-16
_MAX_EXPONENT = 750.0  # exp(-x) underflows to zero beyond


def chi_squares_tail(value: float, weights: FloatArray) -> float:
    """Return P(sum of weights (N,) times chi^2_1 > value), with a relative error below 1e-4.

    Non-positive weights, which rounding leaves of zero eigenvalues, are ignored.
    """
    weights = weights[weights > 0]
    if value <= 0:
        return 1.0
    if not len(weights):
        return 0.0
    largest = float(weights.max())
    relative, x = weights / largest, value / largest
    if x <= _MIN_VALUE:
        return 1.0
    if 0.25 * x - 0.35 * len(relative) > _MAX_EXPONENT:  # Chernoff's bound at t = 1/4
        return 0.0
    if x >= float(relative.sum()):
        return min(1.0, _integral(x, relative, 0.0, 0.5))
    # Below the mean the pole at 0 is too close: on its other side the same integral is smaller by one.
    return min(1.0, max(0.0, 1.0 - _integral(x, relative, -(0.5 * len(relative) + 1) / x, 0.0)))


def chi_squares_quantile(tail: float, weights: FloatArray) -> float:
    """Return the value at which `chi_squares_tail` equals the probability `tail`, strictly between 0 and 1."""

    def excess(value: float) -> float:
        return math.log(max(chi_squares_tail(value, weights), 1e-300) / tail)

    value = float(np.maximum(weights, 0).sum())
    if value <= 0:
        return 0.0
    excess_here = excess(value)
    factor = 2.0 if excess_here > 0 else 0.5
    other = value * factor
    while (beyond := excess(other)) * excess_here > 0:
        value, excess_here, other = other, beyond, other * factor
    # Illinois variant of false position: the logarithm of a tail is nearly linear.
    while abs(excess_here) > _TAIL_TOLERANCE and value != other:
        middle = (value * beyond - other * excess_here) / (beyond - excess_here)
        between = excess(middle)
        if between * excess_here < 0:
            other, beyond = value, excess_here
        else:
            beyond *= 0.5
        value, excess_here = middle, between
    return value


def chi_square_tails(values: FloatArray, freedom: IntArray) -> FloatArray:
    """Return (N,) P(chi^2 > value) for 1, 2 or 3 degrees of freedom each."""
    root = np.sqrt(0.5 * values)
    odd = np.array([math.erfc(r) for r in root])
    third = odd + 2 / math.sqrt(math.pi) * root * np.exp(-0.5 * values)
    return np.choose(freedom - 1, [odd, np.exp(-0.5 * values), third])


def _integral(x: float, w: FloatArray, low: float, high: float) -> float:
    """Return |1 / 2 pi i times the integral of exp(K(t) - t x) / t| along a path between two singularities.

    Args:
        x: the value, relative to the largest weight.
        w: (N,) weights, the largest of which is 1.
        low: the singularity to the left of the path on the real axis.
        high: the singularity to the right.
    """
    # The saddle point minimises log |exp(K(t) - t x) / t|, which is convex between the singularities.
    t = 0.5 * (low + high)
    for _ in range(_MAX_NEWTON_STEPS):
        share = w / (1 - 2 * w * t)
        slope = float(share.sum()) - x - 1 / t
        curvature = 2 * float(share @ share) + 1 / t**2
        low, high = (low, t) if slope > 0 else (t, high)
        last, t = t, t - slope / curvature
        if not low < t < high:
            t = 0.5 * (low + high)
        if abs(t - last) <= _SADDLE_TOLERANCE * min(abs(t), 0.5 - t):
            break
    share = w / (1 - 2 * w * t)
    curvature = 2 * float(share @ share) + 1 / t**2
    third = 8 * float((share**3).sum()) - 2 / t**3
    bow = max(0.0, third / (6 * curvature))  # of the steepest descent, to the right, where exp(-t x) decreases
    u = np.arange(0.0, _NODE_RANGE, _NODE_SPACING)
    up, speed = np.sinh(u) / math.sqrt(curvature), np.cosh(u) / math.sqrt(curvature)
    path = t + 1j * up + bow * up**2
    direction = (1j + 2 * bow * up) * speed
    # Relative to the value at the saddle point, so that nothing underflows early.
    growth = -0.5 * np.log1p(-2 * np.outer(path - t, share)).sum(axis=1) - (path - t) * x
    nodes = (np.exp(growth) / path * direction).imag
    height = -0.5 * float(np.log1p(-2 * t * w).sum()) - t * x
    return abs(float(nodes.sum() - 0.5 * nodes[0])) * _NODE_SPACING / math.pi * math.exp(height)
