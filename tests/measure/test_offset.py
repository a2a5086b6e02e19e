"""The signed offset of a candidate: its median and interval."""

import numpy as np
import pytest

from pcbench.measure.intervals import partition
from pcbench.measure.metrics import Distances
from pcbench.measure.offset import signed_offset


def offset_of(values, points):
    cells = partition(points)
    return signed_offset(Distances(np.full(len(values), 1.0), values), cells.of_point, cells)


def square(count, seed=0):
    return np.random.default_rng(seed).uniform(0, 10, (count, 3)) * [1, 1, 0.01]


def test_the_interval_of_independent_errors_is_that_of_a_median():
    points, sigma = square(20_000), 0.05
    found = offset_of(np.random.default_rng(1).normal(-0.02, sigma, len(points)), points)
    half = 1.96 * np.sqrt(np.pi / 2) * sigma / np.sqrt(len(points))
    # The estimate of the variance from some 400 cells scatters by a tenth, the correlation length by more.
    assert (found.interval.high - found.interval.low) / 2 == pytest.approx(half, rel=0.5)
    assert found.median == pytest.approx(-0.02, abs=3 * half)
    assert found.nmad == pytest.approx(sigma, rel=0.05)
    assert found.is_significant


def test_correlated_errors_widen_the_interval():
    """Errors that are equal in patches of a hundredth of the scene."""
    points = square(20_000)
    patch = (points[:, 0] // 1).astype(int) * 10 + (points[:, 1] // 1).astype(int)
    rng = np.random.default_rng(2)
    found = offset_of(rng.normal(0, 0.05, 100)[patch] + rng.normal(0, 0.01, len(points)), points)
    half = (found.interval.high - found.interval.low) / 2
    assert half > 0.5 * 1.96 * np.sqrt(np.pi / 2) * 0.05 / np.sqrt(100)
    assert not found.is_significant


def test_a_negligible_offset_is_not_significant():
    points = square(200_000)
    found = offset_of(np.random.default_rng(3).normal(0.003, 0.05, len(points)), points)
    assert found.interval.low > 0
    assert not found.is_significant


def test_exact_offsets_have_no_interval_and_outliers_do_not_count():
    points = square(1000)
    values = np.full(len(points), 0.25)
    values[:300] = 40.0
    found = offset_of(values, points)
    assert (found.median, found.interval, found.is_significant) == (0.25, (0.25, 0.25), True)
    cells = partition(points)
    assert signed_offset(Distances(np.ones(1000), None), cells.of_point, cells) is None
