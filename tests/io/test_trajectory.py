"""Trajectories: `.log` files of Tanks and Temples, COLMAP models, and files that are refused."""

import numpy as np
import pytest
from camera_rigs import ring
from trajectories import log_text
from wording import check_error

from pcbench.io.colmap_model import write_colmap_model
from pcbench.io.trajectory import read_trajectory

POSE = "1 0 0 5\n0 1 0 6\n0 0 1 7\n0 0 0 1\n"


def test_centres_are_read_and_images_without_a_pose_left_out(tmp_path):
    centers = np.arange(15.0).reshape(5, 3)
    (tmp_path / "a.log").write_text(log_text(centers, missing=[1], first=10))
    read = read_trajectory(tmp_path / "a.log", pytest.fail)
    np.testing.assert_array_equal(read.centers, centers[[0, 2, 3, 4]])
    np.testing.assert_array_equal(read.numbers, [10, 12, 13, 14])
    np.testing.assert_array_equal(read.places, [0, 2, 3, 4])
    assert read.length == 5


def test_images_of_a_colmap_model_are_numbered_by_their_names(tmp_path):
    cameras = ring(count=3)
    names = ("set2_000004.jpg", "set2_000001.jpg", "set2_000010.jpg")
    write_colmap_model(
        tmp_path, [type(c)(n, c.intrinsics, c.cam_from_world) for c, n in zip(cameras, names, strict=True)]
    )
    read = read_trajectory(tmp_path, pytest.fail)
    np.testing.assert_array_equal(read.numbers, [0, 3, 9])
    # Quaternions in the file are rounded.
    np.testing.assert_allclose(read.centers, [cameras[k].position for k in (1, 0, 2)], atol=1e-9)
    write_colmap_model(
        tmp_path, [type(c)(n, c.intrinsics, c.cam_from_world) for c, n in zip(cameras, "abc", strict=True)]
    )
    with check_error():
        read_trajectory(tmp_path, pytest.fail)


@pytest.mark.parametrize(
    "text",
    [
        "", "0 0 0\n" + POSE[:-9], "0\n" + POSE, "a 0 0\n" + POSE, "0 0 0\n" + POSE.replace("5", "x"),
        "0 0 0\n" + POSE.replace("5", "nan"), "0 0 0\n" + POSE.replace(" 5", ""),
        "0 0 0\n" + POSE.replace("0 1\n", "1 1\n"),
        "0 -1 0\n" + POSE, "-1 0 0\n" + POSE, "9" * 4000 + " 0 0\n" + POSE,
    ],
)  # fmt: skip
def test_malformed_logs_are_refused(tmp_path, text):
    (tmp_path / "a.log").write_text(text)
    with check_error():
        read_trajectory(tmp_path / "a.log", pytest.fail)


def test_missing_files_and_other_folders_are_refused(tmp_path):
    for path in (tmp_path, tmp_path / "missing.log"):
        with check_error():
            read_trajectory(path, pytest.fail)
