"""Restarts separate a right pose of a blurred candidate from wrong poses that fit nearly as well."""

from types import SimpleNamespace

import numpy as np
import pytest
from deformation_cases import correlated_noise
from registrations import codes
from wording import check_error, check_text

from pcbench import Similarity
from pcbench.errors import RegistrationError
from pcbench.extras import import_problem
from pcbench.geometry.arrays import random_rows
from pcbench.geometry.cloud import Cloud
from pcbench.registration import Target, local_origin, quality, register, restarts
from pcbench.registration.restarts import MIN_RETURNED_SHARE, returned_share
from pcbench.registration.result import BLURRED, DOUBTFUL_POSE
from pcbench.scenes.synthetic import city
from pcbench.studies.stress.cells import RunPlan, build_pair


def sample_city(count, seed):
    points = city(5).sample(4 * count, np.random.default_rng(seed))[0]
    return points[np.abs(points[:, :2]).max(axis=1) < 60]


def blurred_city(seed):
    """Return a reference, and a candidate like that of dense stereo: bulges of 0.8 m, and outliers beside surfaces."""
    rng = np.random.default_rng(seed)
    reference, candidate = sample_city(300_000, seed), sample_city(150_000, seed + 100)
    candidate = candidate + 0.8 * correlated_noise(candidate, 1.0, rng) + rng.normal(0, 0.1, candidate.shape)
    is_outlier = rng.random(len(candidate)) < 0.3
    candidate[is_outlier] += rng.normal(0, 1.0, (is_outlier.sum(), 3))
    return reference, candidate


@pytest.fixture(scope="module")
def blurred():
    return blurred_city(2)


@pytest.mark.long
def test_a_right_pose_of_a_blurred_candidate_is_not_doubtful(blurred):
    registration = register(*blurred, "none")
    assert registration.contrast < 0.93
    assert registration.returned_share == 1
    assert not registration.doubtful


@pytest.mark.parametrize(
    "shift", [(1.6, 1.2, 0), *(pytest.param(shift, marks=pytest.mark.long) for shift in ((0, 0, 2.0), (4.0, -3.0, 0)))]
)
def test_a_displaced_pose_of_a_blurred_candidate_is_doubtful(blurred, shift):
    reference, candidate = blurred
    registration = register(reference, candidate + shift, "none")
    assert registration.doubtful
    (text,) = (notice.text for notice in registration.warnings if notice.code == DOUBTFUL_POSE)
    check_text(text)


def test_a_very_blurred_candidate_is_named_as_such(blurred, monkeypatch):
    monkeypatch.setattr(quality, "BLURRED_CONTRAST", 0.93)
    registration = register(*blurred)
    assert BLURRED in codes(registration)
    assert registration.contrast < 0.93
    assert registration.returned_share == 1
    assert not registration.doubtful
    (text,) = (notice.text for notice in registration.warnings if notice.code == BLURRED)
    check_text(text)


@pytest.mark.long
@pytest.mark.skipif(bool(problem := import_problem("kiss_matcher")), reason=str(problem))
def test_global_registration_accepts_a_blurred_candidate(blurred):
    reference, candidate = blurred
    rotation = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    registration = register(reference, candidate @ rotation.T + [30, -20, 5], "global")
    error = registration.T_reference_candidate.apply(candidate @ rotation.T + [30, -20, 5]) - candidate
    assert np.sqrt(np.square(error).sum(axis=1).mean()) < 0.15  # 0.11 at residuals of 0.58
    assert not registration.doubtful


def test_restarts_return_to_the_right_pose_only(blurred):
    reference, candidate = (Cloud(points) for points in blurred)
    target = Target.of(reference)
    points = random_rows(candidate.points - local_origin(reference), 10_000)
    for shift, returns in ((np.zeros(3), True), (np.array([1.5, 1.0, 0]), False)):
        pose = Similarity(np.eye(3), shift)
        share = returned_share(target, points, pose, tolerance=0.6, with_scale=False)
        assert (share >= MIN_RETURNED_SHARE) == returns


@pytest.mark.parametrize(("tolerance", "displacement"), [(0.05, 0.6), (1.0, 3.0)])
def test_restarts_move_and_turn_by_equal_parts_of_a_limited_displacement(monkeypatch, tolerance, displacement):
    """A displacement is 12 tolerances, but at most a tenth of the extent."""
    starts = []
    monkeypatch.setattr(restarts, "refine", lambda *arguments: starts.append(arguments[-1]) or Similarity.identity())
    points = np.random.default_rng(3).normal(size=(50, 3))
    pose = Similarity(np.eye(3), np.array([5.0, -2.0, 1.0]))
    assert returned_share(SimpleNamespace(extent=30.0), points, pose, tolerance=tolerance, with_scale=False) == 1
    center = pose.apply(points).mean(axis=0)
    radius = np.sqrt(np.square(points - points.mean(axis=0)).sum(axis=1).mean())
    assert len(starts) == 4  # two thirds of six runs
    for start in starts:
        shift, angle = (
            np.linalg.norm(start.apply(center[None])[0] - center),
            np.arccos((np.trace(start.rotation) - 1) / 2),
        )
        assert (shift, radius * angle) == pytest.approx((displacement / np.sqrt(2),) * 2)


@pytest.mark.long
def test_restarts_give_the_same_share_again(blurred):
    first, second = (register(*blurred) for _ in range(2))
    assert first.returned_share == second.returned_share
    assert [notice.text for notice in first.warnings] == [notice.text for notice in second.warnings]


def test_random_rows_are_distinct_and_reproducible():
    points = np.arange(30.0).reshape(-1, 3)
    for count in (4, 10, 20):
        rows = random_rows(points, count)
        assert len(np.unique(rows, axis=0)) == len(rows) == min(count, 10)
        np.testing.assert_array_equal(rows, random_rows(points, count))


@pytest.mark.skipif(bool(problem := import_problem("kiss_matcher")), reason=str(problem))
@pytest.mark.long
@pytest.mark.parametrize("seed", [1, 3])
def test_a_part_of_a_city_does_not_slide_onto_another(seed):
    """Streets and terrain repeat: at the wrong place the part lies on the reference, but its houses do not fit."""
    pair = build_pair(RunPlan("registration", "city", "overlap", 40.0, None, "global", seed, 8000))
    with check_error(RegistrationError):
        register(pair.reference, pair.candidate, "global")
