"""The folder of `pcbench checkpoints`: its page, its document, and the map's heights."""

import numpy as np
import pytest

from pcbench.studies.checkpoints.results import plan_extent, plan_heights


def test_plan_heights_are_means_in_cells():
    x, y = np.meshgrid(np.arange(0, 40, 0.5), np.arange(0, 20, 0.5))
    sample = np.column_stack([x.ravel(), y.ravel(), 5 + 0.1 * x.ravel()])
    heights = plan_heights(sample)
    assert plan_extent(sample) == (0.0, 0.0, 39.5, 19.5)
    rows, columns = heights.shape
    assert columns == pytest.approx(2 * rows, abs=1) and not np.isnan(heights).any()
    assert heights.mean() == pytest.approx(sample[:, 2].mean(), abs=0.1)  # border cells have fewer points
    assert (np.diff(heights, axis=1) > 0).all()


def test_plan_heights_of_one_point_and_of_a_line():
    assert plan_heights(np.array([[5e5, 5e6, 100.0]])).tolist() == [[100.0]]
    assert plan_heights(np.column_stack([np.arange(9.0), np.full(9, 2.0), np.ones(9)])).shape[0] == 1
