"""Tails of weighted sums of chi squares, Q = sum_i w_i z_i^2 with standard normal z_i, by which the tests are judged.

P(Q > x) is the integral of exp(K(t) - t x) / t over 2 pi i, where K(t) = -1/2 sum log(1 - 2 w_i t) is the cumulant
generating function, along any path from below to above that crosses the real axis between 0 and 1 / (2 max w). On a
path through the integrand's saddle point (Rice 1980, SIAM J. Sci. Stat. Comput. 1, 438), bent like the steepest descent
there, nothing oscillates: thirty nodes of the trapezoidal rule do, and the error is a share of the tail, however small
that is. Imhof's integral (1961) is along the imaginary axis, where a tail of 1e-8 is what is left of terms near one; a
scaled chi square of the same two moments (Satterthwaite 1946) is wrong by orders of magnitude at 1e-5.
"""

from __future__ import annotations

import math

import numpy as np

from pcbench.geometry.arrays import FloatArray, IntArray

_STEP, _REACH = 0.2, 6.0  # of the nodes u; the path is at sinh(u) times its width, which covers weights of all sizes
_MAX_NEWTON_STEPS = 100  # a bracket is halved at worst
_NEAR_SADDLE = 1e-3  # the path need not pass exactly through it
_NEAR_POINT = 1e-9  # a share of the tail
_MIN_VALUE = 1e-33  # of the largest weight: what lies below has a probability of less than 1e-16
_MAX_EXPONENT = 750.0  # exp of less than its negative is zero


def chi_squares_tail(value: float, weights: FloatArray) -> float:
    """P(sum of weights (N,) times chi^2_1 > value), with a relative error below 1e-4.

    Weights of zero and less, which rounding leaves of an eigenvalue of zero, count as none.
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
    # Below the mean the pole at 0 is too near: on its other side the same integral is less by one.
    return min(1.0, max(0.0, 1.0 - _integral(x, relative, -(0.5 * len(relative) + 1) / x, 0.0)))


def chi_squares_point(tail: float, weights: FloatArray) -> float:
    """The value that `chi_squares_tail` gives the probability `tail` (0 to 1, neither included)."""

    def excess(value: float) -> float:
        return math.log(max(chi_squares_tail(value, weights), 1e-300) / tail)

    value = float(np.maximum(weights, 0).sum())
    if value <= 0:
        return 0.0
    known = excess(value)
    factor = 2.0 if known > 0 else 0.5
    other = value * factor
    while (beyond := excess(other)) * known > 0:
        value, known, other = other, beyond, other * factor
    # False position, in Illinois fashion: the logarithm of a tail is nearly straight.
    while abs(known) > _NEAR_POINT and value != other:
        middle = (value * beyond - other * known) / (beyond - known)
        between = excess(middle)
        if between * known < 0:
            other, beyond = value, known
        else:
            beyond *= 0.5
        value, known = middle, between
    return value


def chi_square_tails(values: FloatArray, freedom: IntArray) -> FloatArray:
    """P(chi^2 with 1, 2 or 3 degrees of freedom > value), for each of (N,)."""
    root = np.sqrt(0.5 * values)
    odd = np.array([math.erfc(r) for r in root])
    third = odd + 2 / math.sqrt(math.pi) * root * np.exp(-0.5 * values)
    return np.choose(freedom - 1, [odd, np.exp(-0.5 * values), third])


def _integral(x: float, w: FloatArray, low: float, high: float) -> float:
    """|1 / 2 pi i times the integral of exp(K(t) - t x) / t| along a path that crosses the real axis between two of the
    integrand's singular places; the largest of the weights is one.
    """
    # The saddle point is the least value of log |exp(K(t) - t x) / t|, which is convex between its singular places.
    t = 0.5 * (low + high)
    for _ in range(_MAX_NEWTON_STEPS):
        share = w / (1 - 2 * w * t)
        slope = float(share.sum()) - x - 1 / t
        curvature = 2 * float(share @ share) + 1 / t**2
        low, high = (low, t) if slope > 0 else (t, high)
        last, t = t, t - slope / curvature
        if not low < t < high:
            t = 0.5 * (low + high)
        if abs(t - last) <= _NEAR_SADDLE * min(abs(t), 0.5 - t):
            break
    share = w / (1 - 2 * w * t)
    curvature = 2 * float(share @ share) + 1 / t**2
    third = 8 * float((share**3).sum()) - 2 / t**3
    bow = max(0.0, third / (6 * curvature))  # of the steepest descent; to the right, where exp(-t x) falls
    u = np.arange(0.0, _REACH, _STEP)
    up, speed = np.sinh(u) / math.sqrt(curvature), np.cosh(u) / math.sqrt(curvature)
    path = t + 1j * up + bow * up**2
    direction = (1j + 2 * bow * up) * speed
    # Against the saddle point's value, so that nothing underflows before the end.
    growth = -0.5 * np.log1p(-2 * np.outer(path - t, share)).sum(axis=1) - (path - t) * x
    nodes = (np.exp(growth) / path * direction).imag
    height = -0.5 * float(np.log1p(-2 * t * w).sum()) - t * x
    return abs(float(nodes.sum() - 0.5 * nodes[0])) * _STEP / math.pi * math.exp(height)
