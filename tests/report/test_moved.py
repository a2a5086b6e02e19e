"""Sentences on where a candidate lies as a whole: the first of the answer."""

import numpy as np
import pytest
import shapes
from wording import check_text

from pcbench import Cloud, Settings, compare
from pcbench.report.answer import answer
from pcbench.report.notes import remarks

CRS = "EPSG:32632"


def settled(lowered, crs=CRS, raised=0.0, **settings):
    """Compare terrain with itself after a settlement, and after one part of it was raised."""
    rng = np.random.default_rng(4)
    reference, later = shapes.terrain(8000, seed=1)[0], shapes.terrain(8000, seed=2)[0]
    later[np.linalg.norm(later[:, :2] - later[:, :2].mean(axis=0), axis=1) < 0.15 * np.ptp(later[:, 0]), 2] += raised
    clouds = (points + rng.normal(0, 0.02, points.shape) for points in (reference, later - [0, 0, lowered]))
    return compare(*(Cloud(points, crs=crs, unit="m") for points in clouds), Settings(**settings))


@pytest.mark.parametrize("crs", [CRS, None])
def test_registration_states_the_settlement_that_it_removed(crs):
    comparison = settled(0.3, crs)
    first = check_text(answer(comparison)[0])
    assert "0.3 m below the reference" in first.replace("0.299", "0.3").replace("0.301", "0.3")
    assert not list(remarks(comparison))  # it is stated once


@pytest.mark.parametrize("lowered", [0.05, pytest.param(0.3, marks=pytest.mark.long)])
def test_given_coordinates_have_a_signed_offset(lowered):
    comparison = settled(lowered, register="none")
    first, how_far, *_ = answer(comparison)
    assert "below the reference" in check_text(first)
    assert "error-free points with" not in check_text(how_far)
    found = comparison["candidate_1"].offset
    assert found.interval.low < found.median < found.interval.high < 0
    assert found.median == pytest.approx(-lowered, rel=0.25)  # slopes shorten the distance along the normals


def test_larger_changes_come_before_a_signed_offset():
    comparison = settled(0.05, raised=3.0, register="none")
    assert comparison["candidate_1"].changes.found
    first, *_, last = answer(comparison)
    assert "below the reference" not in first and "below the reference" in last


def test_a_doubtful_given_pose_has_one_too():
    comparison = settled(0.3, crs=None, register="none")
    assert comparison["candidate_1"].registration.doubtful
    assert "below the reference" in check_text(answer(comparison)[0])


@pytest.mark.parametrize("method", ["none", "icp"])
def test_a_candidate_in_place_has_no_such_sentence(method):
    comparison = settled(0.0, register=method)
    assert "below" not in answer(comparison)[0]
    assert "above" not in answer(comparison)[0]
    assert "error-free points with" in answer(comparison)[0]
