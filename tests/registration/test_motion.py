"""The motion that registration removed, with its errors."""

import numpy as np
import pytest
import shapes
from registrations import motion

from pcbench import Cloud, Similarity
from pcbench.registration import GivenPose, register
from pcbench.registration.motion import MotionFrame, PoseCovariance, RemovedMotion

UTM = np.array([512_000.0, 5_400_000.0, 300.0])


def terrains(noise=0.02):
    rng = np.random.default_rng(5)
    first, second = shapes.terrain(12_000, seed=1)[0], shapes.terrain(8000, seed=2)[0]
    return first + rng.normal(0, noise, first.shape), second + rng.normal(0, noise, second.shape)


@pytest.mark.parametrize("origin", [0.0, UTM])
def test_a_settlement_is_stated_with_its_interval(origin):
    reference, candidate = terrains()
    result = register(reference + origin, candidate + origin - [0, 0, 0.3])
    found = result.motion
    # Errors are correlated: the bootstrap may be too small by up to two thirds.
    assert abs(found.shift[2] - 0.3) < 6 * found.shift_sigma[2]
    assert found.shift_sigma[2] < 0.01
    assert found.size == pytest.approx(0.3, abs=0.03)
    assert found.half_width < 0.05
    assert found.is_shift
    assert result.keeps_frame
    assert result.rms_as_given == pytest.approx(0.3, rel=0.2)  # slopes shorten it, noise adds to it
    assert found.center == pytest.approx(reference.mean(axis=0) + origin, abs=2)


def test_a_candidate_in_place_was_not_moved():
    found = register(*terrains()).motion
    assert found.size == 0
    assert (np.abs(found.shift) < 6 * found.shift_sigma + 0.002).all()


def test_a_turned_candidate_does_not_keep_the_frame():
    reference, candidate = terrains()
    pose = motion(3.0, (1.0, -0.5, 0.3))
    result = register(reference, pose.inverse().apply(candidate))
    assert not result.keeps_frame
    assert result.rms_as_given is None
    assert result.motion.angle_deg == pytest.approx(3.0, abs=0.1)
    crs = "EPSG:32632"
    stated = register(Cloud(reference, crs=crs), Cloud(pose.inverse().apply(candidate), crs=crs))
    assert stated.keeps_frame


def test_errors_along_unobservable_motions_are_infinite():
    rng = np.random.default_rng(6)
    reference, candidate = (
        np.column_stack([rng.uniform(0, 20, (n, 2)), rng.normal(0, 0.02, n)]) for n in (20_000, 8000)
    )
    found = register(reference, candidate - [0, 0, 0.1]).motion
    assert np.isinf(found.shift_sigma).tolist() == [True, True, False]
    # The mean of 8,000 heights, as far as the errors of planes of 20,000 points are smaller.
    assert found.size == pytest.approx(0.1, abs=0.003)
    assert found.half_width < 0.003


def test_the_error_of_a_shift_does_not_depend_on_its_size():
    frame = MotionFrame.of(np.array([[-2.0, 5, 0], [2, 5, 0]]), np.array([1.0, 1.0]))
    assert (frame.center.tolist(), frame.radius) == ([0, 5, 0], 2)
    covariance = PoseCovariance(frame, np.diag([0.0, 0, 0, 4, 9, 9]) * 1e-4, np.zeros((6, 0)))
    for size in (0.5, 5.0):
        found = RemovedMotion.of(Similarity(np.eye(3), np.array([size, 0.0, 0.0])), covariance, noise=0.0)
        assert (found.size, found.size_sigma) == (pytest.approx(size), pytest.approx(0.02))


def test_a_given_pose_removes_no_motion():
    reference, candidate = terrains()
    pose = GivenPose(Similarity(np.eye(3), np.array([0.0, 0.0, 0.3])))
    assert register(reference, candidate - [0, 0, 0.3], pose).motion is None
