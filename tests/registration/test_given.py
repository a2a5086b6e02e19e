"""Given poses: used unchanged, and refused if they are not similarities."""

import numpy as np
import pytest
import shapes
from registrations import motion
from wording import check_error

from pcbench import Similarity
from pcbench.geometry.transform import format_matrix, read_matrix
from pcbench.registration import (
    GivenPose,
    register,
)


def test_matrix_and_none(scene, tmp_path):
    reference, candidate = scene
    true = motion(0.5)
    (tmp_path / "T.txt").write_text(format_matrix(true))
    assert np.array_equal(read_matrix(tmp_path / "T.txt").matrix, true.matrix)
    result = register(reference, true.inverse().apply(candidate), f"matrix:{tmp_path / 'T.txt'}")
    np.testing.assert_array_equal(result.T_reference_candidate.matrix, true.matrix)
    assert result.converged is None
    assert result.rmse < 0.04
    assert result.method == f"matrix:{tmp_path / 'T.txt'}"
    for given in (true, true.matrix, true.matrix.tolist(), GivenPose(true)):
        same = register(reference, true.inverse().apply(candidate), given)
        np.testing.assert_array_equal(same.T_reference_candidate.matrix, true.matrix)
        assert (same.rmse, same.weakest_sigma, same.method) == (result.rmse, result.weakest_sigma, "matrix")
    none = register(reference, candidate, "none")
    assert none.T_reference_candidate.scale == 1.0
    assert none.method == "none"


def test_a_given_scale_was_not_solved(scene):
    reference, candidate = scene
    result = register(reference, candidate / 40, Similarity(np.eye(3), np.zeros(3), 40.0))
    assert result.T_reference_candidate.scale == 40.0
    assert not result.solved_scale


NO_SIMILARITIES = {
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


@pytest.mark.parametrize("name", NO_SIMILARITIES)
def test_invalid_similarities_are_refused(name):
    array = NO_SIMILARITIES[name]
    cloud = shapes.plane_grid(4)
    with check_error():
        register(cloud, cloud, array)
    with check_error():
        register(cloud, cloud, "icp", initial=array)
