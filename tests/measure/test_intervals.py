"""Intervals: estimates for fields of known variance, and coverage of the expectation."""

import math

import numpy as np
import pytest
from coverage_cases import Case, coverage, draw
from scipy.stats import t

from pcbench.measure.intervals import (
    CorrelationCells,
    Interval,
    LinearizedScore,
    ScoreUncertainty,
    difference,
    interval,
    partition,
    spreads,
    student_t_quantile,
)
from pcbench.native import _core

SIDE = 24
CELLS = CorrelationCells(np.arange(SIDE * SIDE), (SIDE, SIDE, 1), 0.5)
EQUAL_WEIGHTS = np.full(SIDE * SIDE, 1 / SIDE**2)


@pytest.mark.parametrize("reach", [0, 1, 8])
def test_box_sums_are_those_of_the_cells_around(reach):
    values = np.random.default_rng(4).integers(-9, 9, (2, 5, 1, 7)).astype(float)
    sums = np.empty(values.shape)
    _core.box_sums(values, reach, sums)
    for cell in np.ndindex(values.shape[1:]):
        box = tuple(slice(max(place - reach, 0), place + reach + 1) for place in cell)
        np.testing.assert_array_equal(sums[:, *cell], values[:, *box].sum(axis=(1, 2, 3)))


def moving_average(rng, width):
    """Return a field (SIDE^2,) of sums over `width` by `width` independent cells, and the variance of its mean."""
    larger = rng.normal(size=(SIDE + width - 1, SIDE + width - 1))
    windows = np.lib.stride_tricks.sliding_window_view(larger, (width, width))
    weights = np.convolve(np.ones(SIDE), np.ones(width))  # sums along an axis that contain each cell
    return windows.sum(axis=(2, 3)).ravel(), np.square(weights).sum() ** 2 / SIDE**4


def spread_of(field):
    influence = (field - field.mean()) / field.size
    return spreads({"x": LinearizedScore(1.0, influence)}, CELLS, EQUAL_WEIGHTS)["x"]


@pytest.mark.parametrize(
    ("width", "reach", "independent_regions"),
    [(1, (0, 1), (300, 576)), (3, (1, 3), (40, 110)), (5, (1.5, 5), (12, 50))],
)
def test_the_variance_of_a_correlated_field_is_estimated(width, reach, independent_regions):
    rng = np.random.default_rng(width)
    fields, variances = zip(*(moving_average(rng, width) for _ in range(60)), strict=True)
    estimates = [spread_of(field) for field in fields]
    # Products that correlate by chance increase the estimate, which is conservative.
    assert 0.9 * variances[0] < np.mean([s.sigma**2 for s in estimates]) < 1.4 * variances[0]
    assert reach[0] <= np.median([s.reach for s in estimates]) <= reach[1]
    assert independent_regions[0] <= np.median([s.independent_regions for s in estimates]) <= independent_regions[1]
    is_above_lower = [
        mean - student_t_quantile(s.degrees_of_freedom) * s.sigma <= 0
        for mean, s in zip(map(np.mean, fields), estimates, strict=True)
    ]
    is_below_upper = [
        mean + student_t_quantile(s.degrees_of_freedom) * s.sigma >= 0
        for mean, s in zip(map(np.mean, fields), estimates, strict=True)
    ]
    assert np.mean(np.logical_and(is_above_lower, is_below_upper)) >= 0.88


def test_few_large_values_leave_few_degrees_of_freedom():
    rng = np.random.default_rng(0)
    field = rng.normal(size=SIDE * SIDE)
    field_with_peaks = field.copy()
    field_with_peaks[rng.choice(SIDE * SIDE, 4, replace=False)] += 60
    assert spread_of(field).degrees_of_freedom > 60
    assert spread_of(field_with_peaks).degrees_of_freedom < 6


@pytest.mark.parametrize("exponent", [-700, 650])  # fourth powers of the second overflow
def test_the_unit_has_no_effect(exponent):
    field, _ = moving_average(np.random.default_rng(1), 3)
    spread, scaled = spread_of(field), spread_of(np.ldexp(field, exponent))
    assert scaled == spread._replace(sigma=math.ldexp(spread.sigma, exponent))


def test_quantiles_equal_those_of_scipy():
    for degrees_of_freedom in (2, 3, 5, 10, 30, 1e6):
        assert student_t_quantile(degrees_of_freedom) == pytest.approx(t.ppf(0.975, degrees_of_freedom), rel=0.008)


def test_intervals_of_bounded_scores_stay_within_bounds():
    spread = ScoreUncertainty(0.4, 3.0, 20.0, 1.0)
    low, high = interval(LinearizedScore(0.5, EQUAL_WEIGHTS), spread)
    assert 0 < low < 0.5 < high
    low, high = interval(LinearizedScore(0.95, EQUAL_WEIGHTS, 1.0), spread)
    assert 0 < low < 0.95 < high < 1
    assert interval(LinearizedScore(1.0, EQUAL_WEIGHTS, 1.0), spread) == Interval(1.0, 1.0)
    assert difference(-0.5, ScoreUncertainty(0.0, np.inf, np.inf, 0.0)) == Interval(-0.5, -0.5)
    low, high = difference(-0.5, spread)
    assert low < -1 < 0 < high


def test_isolated_points_form_no_cells():
    points = np.random.default_rng(1).random((5_000, 3)) * [1, 1, 0.01]
    points[0] = 1e6
    cells = partition(points)
    assert 300 < cells.number < 900
    assert cells.of_point.max() < cells.number
    assert partition(np.ones((3, 3))).number == 1


@pytest.mark.parametrize(
    "case",
    [Case("torus", "none", 1_000, 1_000), pytest.param(Case("boxes", "L/10", 1_000, 1_000), marks=pytest.mark.long)],
)
def test_intervals_contain_the_expectation(case):
    """A short version of benchmarks/intervals.py: 95 % of 60 is 57, and fewer than 51 has a probability below 0.01."""
    result = coverage(case, 60)
    assert (result.shares >= 0.85).all()
    assert (result.widths < 1.9).all()


def test_noise_correlated_over_a_third_of_the_scene_gives_a_warning():
    def runs_with_warning(noise):
        return ["few-pieces" in [notice.code for notice in draw(Case("plane", noise), run)[1]] for run in range(8)]

    assert sum(runs_with_warning("L/2")) >= 6
    assert not any(runs_with_warning("white"))


@pytest.mark.parametrize("points", [300, 1000])
def test_a_precision_of_one_has_an_interval(points):
    """Some points lie beyond the threshold, with an expectation of 0.3 and 0.9: often none is drawn."""
    assert coverage(Case("plane", "none", points, points), 20).shares[-1] >= 0.85  # 0.40 and 0.68 with no width


def test_a_share_of_all_or_none_reaches_to_what_would_be_seen():
    exact = ScoreUncertainty(0.0, math.inf, math.inf, 0.0)
    low, high = interval(LinearizedScore(1.0, np.zeros(1), 1.0, 1000), exact)
    assert (low, high) == (pytest.approx(0.025 ** (2 / 1000)), 1.0)
    assert interval(LinearizedScore(0.0, np.zeros(1), 1.0, 1000), exact) == (0.0, pytest.approx(1 - low))
    assert interval(LinearizedScore(2.0, np.zeros(1)), exact) == (2.0, 2.0)
