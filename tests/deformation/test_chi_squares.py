"""Tails of weighted sums of chi squares: closed forms, simulations, and their inverse."""

import math

import numpy as np
import pytest
from scipy.stats import chi2

from pcbench.deformation.chi_squares import chi_square_tails, chi_squares_quantile, chi_squares_tail

TAILS = np.array([0.5, 0.1, 1e-2, 1e-3, 1e-5, 1e-8, 1e-10])
UNEQUAL_WEIGHTS = np.array([3.0, 1.0, 1.0, 0.5, 0.5, 0.5])
MODE_WEIGHTS = np.logspace(0, -3, 48)
ONE_LARGE_WEIGHT = np.concatenate([[1.0], np.full(300, 1e-2)])


@pytest.mark.parametrize("count", [1, 2, 3, 10, 48, 300])
def test_equal_weights_are_a_chi_square(count):
    for tail in (0.999, 0.9, *TAILS):
        computed = chi_squares_tail(2.5 * chi2.isf(tail, count), np.full(count, 2.5))
        # Near the mean the pole of the integrand is near its saddle point: the error is 3e-5 there, 1e-9 in the tails.
        assert computed == pytest.approx(tail, rel=1e-4 if tail > 0.1 else 1e-8)


@pytest.mark.parametrize("weights", [(1.0, 0.9), (1.0, 0.1), (1.0, 1e-4), (3.0, 1.0, 0.2), (8.0, 2.0, 1.0, 0.01)])
def test_pairs_of_weights_are_a_sum_of_exponential_variables(weights):
    """Two terms of equal weight w add up to an exponential variable of mean 2 w, so the sum is hypoexponential."""

    def exact_tail(value):
        coefficients = [math.prod(w / (w - other) for other in weights if other != w) for w in weights]
        return sum(
            coefficient * math.exp(-value / (2 * w)) for coefficient, w in zip(coefficients, weights, strict=True)
        )

    mean = 2 * sum(weights)
    for value in mean * np.array([0.5, 1.0, 2.0, 5.0, 10.0, 20.0]):
        # The tolerance is for the step of the nodes; at (1, 0.9) the closed form itself loses one digit.
        assert chi_squares_tail(value, np.repeat(weights, 2)) == pytest.approx(exact_tail(value), rel=1e-4)


def test_small_weights_only_shift_the_distribution():
    """Terms with small sum and small variance only add their mean."""
    small_weights = np.full(200, 1e-7)
    for tail in TAILS:
        value = float(chi2.isf(tail, 1))
        # The standard deviation of the small terms is 2e-6: it changes the tail by 1e-11.
        assert chi_squares_tail(value + 200e-7, np.append(small_weights, 1.0)) == pytest.approx(tail, rel=1e-6)


# Results of `python benchmarks/chi_squares.py`: value, share of the draws beyond it, standard error. The first is
# from 400 million plain draws, the others from four million draws of the tilted distribution.
@pytest.mark.parametrize(
    ("weights", "value", "share", "error"),
    [
        (UNEQUAL_WEIGHTS, 62.6473, 9.7325e-06, 1.6e-07),
        (UNEQUAL_WEIGHTS, 62.6473, 9.9747e-06, 2.3e-08),
        (MODE_WEIGHTS, 29.203, 9.9948e-06, 1.9e-08),
        (ONE_LARGE_WEIGHT, 22.5273, 1.0005e-05, 2.3e-08),
    ],
)
def test_long_simulations_at_one_in_a_hundred_thousand(weights, value, share, error):
    assert abs(chi_squares_tail(value, weights) - share) < 3 * error
    assert error < 0.02 * share


@pytest.mark.parametrize(
    "weights", [UNEQUAL_WEIGHTS, MODE_WEIGHTS, pytest.param(ONE_LARGE_WEIGHT, marks=pytest.mark.long)]
)
def test_short_simulations_in_the_tail(weights):
    """Importance sampling: normals with a variance that moves the mean to the value whose tail is 1e-5."""
    value = chi_squares_quantile(1e-5, weights)
    grid = 0.5 / weights.max() * np.linspace(0, 1, 10_001)[1:-1]
    t = grid[np.argmin(np.abs([(weights / (1 - 2 * t * weights)).sum() - value for t in grid]))]
    rng = np.random.default_rng(3)
    tilted_weights = weights / (1 - 2 * t * weights)
    sums = sum(weight * np.square(rng.standard_normal(400_000)) for weight in tilted_weights)
    contributions = np.where(sums > value, np.exp(-0.5 * np.log(1 - 2 * t * weights).sum() - t * sums), 0.0)
    error = contributions.std() / math.sqrt(len(contributions))
    assert error < 0.01e-5
    assert abs(contributions.mean() - 1e-5) < 3 * error


@pytest.mark.parametrize("weights", [np.ones(1), np.ones(48), UNEQUAL_WEIGHTS, MODE_WEIGHTS, ONE_LARGE_WEIGHT])
@pytest.mark.parametrize("tail", [0.999, 0.5, 1e-2, 1e-5, 1e-10])
def test_the_quantile_inverts_the_tail(weights, tail):
    assert chi_squares_tail(chi_squares_quantile(tail, weights), weights) == pytest.approx(tail, rel=1e-8)


def test_the_tail_decreases_and_is_scale_invariant():
    values = np.linspace(0.01, 4, 100) * MODE_WEIGHTS.sum()
    tails = [chi_squares_tail(value, MODE_WEIGHTS) for value in values]
    assert (np.diff(tails) < 0).all()
    for scale in (1e-290, 1e-6, 1e250):
        scaled_tails = [chi_squares_tail(scale * value, scale * MODE_WEIGHTS) for value in values]
        np.testing.assert_allclose(scaled_tails, tails, rtol=1e-9)  # rounding of the weights alone


def test_the_tail_at_extreme_values():
    assert chi_squares_tail(0.0, np.zeros(3)) == 1.0
    assert chi_squares_tail(1.0, np.zeros(3)) == 0.0
    assert chi_squares_quantile(0.01, np.zeros(3)) == 0.0
    assert chi_squares_tail(1e-320, UNEQUAL_WEIGHTS) == 1.0
    assert chi_squares_tail(1e300, np.array([1e-300, 1e-310])) == 0.0
    assert chi_squares_tail(1e4, np.ones(3)) == 0.0  # exp(-5000)
    # An eigenvalue of zero that rounding made negative.
    assert chi_squares_tail(5.0, np.append(UNEQUAL_WEIGHTS, -1e-17)) == chi_squares_tail(5.0, UNEQUAL_WEIGHTS)


@pytest.mark.parametrize("freedom", [1, 2, 3])
def test_closed_forms_of_single_chi_squares(freedom):
    values = np.append(chi2.isf(TAILS, freedom), 0.0)
    computed = chi_square_tails(values, np.full(len(values), freedom))
    np.testing.assert_allclose(computed, [*TAILS, 1.0], rtol=1e-12)  # rounding
