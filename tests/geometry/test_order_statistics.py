"""Percentiles and medians are those of numpy, bit for bit."""

import numpy as np
import pytest
from number_cases import finite_numbers, infinite_numbers

from pcbench.geometry import order_statistics
from pcbench.native import _core

RANKS = (0.0, 1.0, 5.0, 25.0, 50.0, 75.0, 95.0, 99.0, 99.99, 100.0)


INPUTS = dict(finite_numbers()) | dict(infinite_numbers())


@pytest.fixture(autouse=True)
def compiled(monkeypatch):
    monkeypatch.setattr(order_statistics, "_MAX_PARTITIONED", 0)


@pytest.mark.filterwarnings("ignore:invalid value encountered:RuntimeWarning")
@pytest.mark.parametrize("name", INPUTS)
def test_values_of_numpy(name):
    values = INPUTS[name]
    before = values.copy()
    np.testing.assert_array_equal(order_statistics.percentiles(values, RANKS), np.percentile(values, RANKS))
    np.testing.assert_array_equal(order_statistics.median(values), np.median(values))
    np.testing.assert_array_equal(order_statistics.median_distance(values), np.median(np.abs(values)))
    center = 0.5 if np.isinf(values).any() else float(np.median(values))
    np.testing.assert_array_equal(order_statistics.median_distance(values, center), np.median(np.abs(values - center)))
    np.testing.assert_array_equal(values, before)


def test_ranks_in_any_order_and_repeated():
    values = INPUTS["normal 100"]
    ranks = [90.0, 10.0, 90.0, 50.0]
    np.testing.assert_array_equal(order_statistics.percentiles(values, ranks), np.percentile(values, ranks))


def test_all_ranks():
    values = INPUTS["ties 30001"]
    found = np.empty(len(values))
    assert _core.order_statistics(values, None, np.arange(len(values)), found)
    np.testing.assert_array_equal(found, np.sort(values))


@pytest.mark.parametrize("nan", [np.nan, -np.nan])
def test_nan_makes_all_results_nan(nan):
    values = INPUTS["normal 100"].copy()
    values[7] = nan
    assert np.isnan(order_statistics.percentiles(values, RANKS)).all()
    assert np.isnan(order_statistics.median(values))
    assert np.isnan(order_statistics.median_distance(values, 1.0))


def test_strided_arrays():
    rows = np.random.default_rng(6).normal(size=(1000, 3))
    assert order_statistics.median(rows[:, 1]) == np.median(rows[:, 1])


@pytest.mark.parametrize("count", [1, 2, 500, 40_000])
def test_percentiles_of_columns(count):
    rows = np.random.default_rng(6).normal(size=(2 * count, 3))[::2]
    np.testing.assert_array_equal(
        order_statistics.percentiles_of_columns(rows, RANKS), np.percentile(rows, RANKS, axis=0)
    )


def test_few_values_are_left_to_numpy(monkeypatch):
    monkeypatch.setattr(order_statistics, "_MAX_PARTITIONED", 100)
    monkeypatch.setattr(order_statistics, "_core", None)
    values = INPUTS["normal 100"]
    np.testing.assert_array_equal(order_statistics.percentiles(values, RANKS), np.percentile(values, RANKS))
    assert order_statistics.median(values) == np.median(values)
    assert order_statistics.median_distance(values, 0.5) == np.median(np.abs(values - 0.5))


def test_wrong_arguments_are_refused():
    values, found = np.arange(5.0), np.empty(2)
    for ranks in ([3, 1], [0, 5], [-1, 2], [0]):
        with pytest.raises(ValueError, match="order_statistics"):
            _core.order_statistics(values, None, np.array(ranks), found)


@pytest.mark.parametrize("most", [0, 1000])
def test_value_of_a_rank(monkeypatch, most):
    monkeypatch.setattr(order_statistics, "_MAX_PARTITIONED", most)
    values = np.random.default_rng(0).normal(size=500).round(1)
    found = [order_statistics.value_of_rank(values, rank) for rank in range(500)]
    assert found == np.sort(values).tolist()


@pytest.mark.parametrize("k", [1, 2, 9, 24, 400])
def test_medians_of_rows_are_those_of_numpy(k):
    rng = np.random.default_rng(k)
    values, rows = rng.normal(size=500).round(1), rng.integers(0, 500, (60, k))
    np.testing.assert_array_equal(order_statistics.medians_of_rows(values, rows), np.median(values[rows], axis=1))
    for index in (-1, 500):
        with pytest.raises(IndexError, match="indices of values"):
            order_statistics.medians_of_rows(values, np.full((1, k), index))
    with pytest.raises(ValueError, match="at least one index"):
        order_statistics.medians_of_rows(values, np.empty((1, 0), np.int64))
