"""Selections of rows."""

from itertools import pairwise

import numpy as np
import pytest

from pcbench.geometry.arrays import bounds, even_rows


@pytest.mark.parametrize("count, most", [(0, 5), (1, 1), (5, 5), (7, 3), (1000, 7), (10, 0)])
def test_even_rows_are_different_and_span_all(count, most):
    rows = even_rows(count, most).tolist()
    assert len(rows) == min(count, most) == len(set(rows)) and rows == sorted(rows)
    if len(rows) > 1:
        assert (rows[0], rows[-1]) == (0, count - 1)
        steps = {later - earlier for earlier, later in pairwise(rows)}
        assert max(steps) - min(steps) <= 1


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 8, 9, 1000])
def test_bounds_equal_the_minimum_and_maximum_of_numpy(count):
    points = np.random.default_rng(count).normal(size=(count, 3))
    some_nan, some_infinite = points.copy(), points.copy()
    some_nan[count // 2, 1], some_infinite[-1] = np.nan, (np.inf, -np.inf, 0)
    rounded, single = points.round().astype(int), points.astype(np.float32)
    for values in (points, some_nan, some_infinite, points[::-1], single, rounded):
        for corner, expected in zip(bounds(values), (values.min(axis=0), values.max(axis=0)), strict=True):
            np.testing.assert_array_equal(corner, expected)
