"""Errors with intervals, and the correction by the floor: closed forms."""

import pytest

from pcbench.studies.tradeoff.errors import _error
from pcbench.studies.tradeoff.metrics import CORRECTABLE, correct_for_thinning, corrected_values
from pcbench.studies.tradeoff.results import ErrorEstimate


def test_correction_of_pure_spacing_and_of_pure_error():
    # Error-free points: the distance is the floor, and that of the complete cloud is sqrt(share) of it.
    assert correct_for_thinning(2.0, 2.0, 0.25) == pytest.approx(1.0)
    assert correct_for_thinning(2.0, 2.0, 0.25, power=2.0) == pytest.approx(0.5)
    # An error of 3 with a floor of 4: squares add to 5 at a share of 1/4, and to sqrt(13) with a floor of 2.
    assert correct_for_thinning(5.0, 4.0, 0.25) == pytest.approx(13**0.5)
    # Nothing is corrected without thinning or without a floor.
    assert correct_for_thinning(5.0, 4.0, 1.0) == 5.0
    assert correct_for_thinning(5.0, 0.0, 0.1) == 5.0
    assert correct_for_thinning(5.0, None, 0.1) is None
    assert correct_for_thinning(1.0, 4.0, 0.01) == 0.0


def test_each_direction_is_corrected_by_the_share_of_the_searched_cloud():
    values, floors = dict.fromkeys(CORRECTABLE, 2.0), dict.fromkeys(CORRECTABLE, 2.0)
    found = corrected_values(values, floors, {"c→r": 0.25, "r→c": 1.0})
    assert found["mean c→r"] == pytest.approx(1.0) and found["mean r→c"] == 2.0
    assert found["D2 RMS c→r"] == pytest.approx(2 * 0.25**0.75)
    assert found["Chamfer"] == pytest.approx(3.0)
    assert corrected_values({}, {}, {"c→r": 0.5, "r→c": 1.0})["Chamfer"] is None


def test_prediction_interval_of_one_run():
    # Errors 0, 0.1 and 0.2: mean 0.1, standard deviation 0.1, Student's t for 2 degrees of freedom 4.302653.
    half = 4.302653 * 0.1 * (4 / 3) ** 0.5
    assert _error([1.0, 1.1, 1.2], 1.0) == pytest.approx((0.1, 0.1 - half, 0.1 + half), rel=1e-6)
    assert _error([2.0, 2.0, 2.0], 1.0) == ErrorEstimate(1.0, 1.0, 1.0)
    assert _error([1.0, None, 1.0], 1.0) is None
    assert ErrorEstimate(0.0, -0.3, 0.2).bound == 0.3
