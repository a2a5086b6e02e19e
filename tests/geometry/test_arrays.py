"""Selections of rows."""

from itertools import pairwise

import pytest

from pcbench.geometry.arrays import even_rows


@pytest.mark.parametrize("count, most", [(0, 5), (1, 1), (5, 5), (7, 3), (1000, 7), (10, 0)])
def test_even_rows_are_different_and_span_all(count, most):
    rows = even_rows(count, most).tolist()
    assert len(rows) == min(count, most) == len(set(rows)) and rows == sorted(rows)
    if len(rows) > 1:
        assert (rows[0], rows[-1]) == (0, count - 1)
        steps = {later - earlier for earlier, later in pairwise(rows)}
        assert max(steps) - min(steps) <= 1
