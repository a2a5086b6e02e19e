"""Given poses: used unchanged, and refused if they are not similarities."""

import numpy as np
import pytest
import shapes
from registrations import motion
from wording import check_error

from pcbench import Similarity, compare
from pcbench.errors import RegistrationError
from pcbench.geometry.transform import format_matrix, read_matrix
from pcbench.registration import (
    GivenPose,
    register,
)


def test_given_poses_are_used_unchanged(scene, tmp_path):
    reference, candidate = scene
    true_pose = motion(0.5)
    (tmp_path / "T.txt").write_text(format_matrix(true_pose))
    assert np.array_equal(read_matrix(tmp_path / "T.txt").matrix, true_pose.matrix)
    result = register(reference, true_pose.inverse().apply(candidate), f"matrix:{tmp_path / 'T.txt'}")
    np.testing.assert_array_equal(result.T_reference_candidate.matrix, true_pose.matrix)
    assert result.converged is None
    assert result.rmse < 0.04
    assert result.method == f"matrix:{tmp_path / 'T.txt'}"
    for pose in (true_pose, true_pose.matrix, true_pose.matrix.tolist(), GivenPose(true_pose)):
        by_object = register(reference, true_pose.inverse().apply(candidate), pose)
        np.testing.assert_array_equal(by_object.T_reference_candidate.matrix, true_pose.matrix)
        assert (by_object.rmse, by_object.weakest_sigma) == (result.rmse, result.weakest_sigma)
        assert by_object.method == "matrix"
    unregistered = register(reference, candidate, "none")
    assert unregistered.T_reference_candidate.scale == 1.0
    assert unregistered.method == "none"


def test_a_given_scale_is_kept_and_not_solved(scene):
    reference, candidate = scene
    result = register(reference, candidate / 40, Similarity(np.eye(3), np.zeros(3), 40.0))
    assert result.T_reference_candidate.scale == 40.0
    assert not result.solved_scale


INVALID_SIMILARITIES = {
    "reflection": np.diag([1.0, 1.0, -1.0, 1.0]),
    "shear": np.array([[1, 0.1, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]]),
    "stretch": np.diag([1.0, 1.0, 1.1, 1.0]),
    "singular": np.diag([1.0, 1.0, 0.0, 1.0]),
    "3x3": np.eye(3),
    "projective": np.eye(4) + np.eye(4)[:, ::-1] * 0.1,
    "nan": np.eye(4) * np.nan,
    "words": [["a"] * 4] * 4,
    "ragged": [[1.0], [1.0, 2.0]],
}


@pytest.mark.parametrize("name", INVALID_SIMILARITIES)
def test_invalid_similarities_are_refused(name):
    array = INVALID_SIMILARITIES[name]
    cloud = shapes.plane_grid(4)
    with check_error():
        register(cloud, cloud, array)
    with check_error():
        register(cloud, cloud, "icp", initial=array)


def test_clouds_that_are_apart_are_named_with_the_centres_of_their_boxes():
    points = np.random.default_rng(0).uniform((0, 0, -0.2), (10, 10, 0.2), (500, 3))
    points[:2] = (0, 0, -0.2), (10, 10, 0.2)
    with pytest.raises(RegistrationError, match=r"reference centre \(5, 5, 0\), candidate centre \(1005, 5, 0\)"):
        compare(points, points + (1000, 0, 0), register="none")
