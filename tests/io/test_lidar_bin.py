"""Scans of KITTI and nuScenes: rows of float32 without a header, which the name, the size and the values identify."""

import numpy as np
import pytest
from data_folder import data_folder
from refusals import refusal

from pcbench.io import read_cloud

ROWS = np.array([[1, 2, 3, 0.25], [-4, 5.5, 6, 0], [70, -8, -1.5, 1]], dtype="<f4")


def test_kitti_has_intensities_and_metres(tmp_path):
    ROWS.tofile(tmp_path / "000000.bin")
    cloud = read_cloud(tmp_path / "000000.bin")
    np.testing.assert_array_equal(cloud.points, ROWS[:, :3])
    np.testing.assert_array_equal(cloud.attributes["intensity"], ROWS[:, 3])
    assert cloud.unit == "m"


def test_nuscenes_has_rings(tmp_path):
    rows = np.column_stack([ROWS, [0, 1, 31]]).astype("<f4")
    rows.tofile(tmp_path / "n015__LIDAR_TOP__1.pcd.bin")
    cloud = read_cloud(tmp_path / "n015__LIDAR_TOP__1.pcd.bin")
    np.testing.assert_array_equal(cloud.points, ROWS[:, :3])
    np.testing.assert_array_equal(cloud.attributes["ring"], [0, 1, 31])
    np.testing.assert_array_equal(cloud.attributes["intensity"], ROWS[:, 3])


def test_real_scan_equals_numpy():
    path = data_folder("halves") / "kitti3.bin"
    rows = np.fromfile(path, "<f4").reshape(-1, 4)
    cloud = read_cloud(path)
    np.testing.assert_array_equal(cloud.points, rows[:, :3])
    np.testing.assert_array_equal(cloud.attributes["intensity"], rows[:, 3])


OTHERS = {
    "half a row": ROWS.tobytes()[:-8],
    "five columns": np.column_stack([ROWS, [0, 1, 2]]).astype("<f4").tobytes(),
    "negative intensity": np.full((5, 4), -1, "<f4").tobytes(),
    "intensity NaN": np.array([[1, 2, 3, np.nan]], "<f4").tobytes(),
    "far": np.array([[1, 2, 3e6, 0]], "<f4").tobytes(),
    "float64": np.random.default_rng(1).normal(size=(8, 4)).tobytes(),
    "CloudCompare": b"CCB2" + bytes(28),
    "glTF": b"glTF" + bytes(28),
}


@pytest.mark.parametrize("name", OTHERS)
def test_other_binary_files(tmp_path, name):
    refusal(tmp_path / "a.bin", OTHERS[name])


def test_parts_of_a_colmap_model(tmp_path):
    refusal(tmp_path / "cameras.bin", ROWS.tobytes())


def test_points_without_coordinates_are_dropped(tmp_path):
    np.array([[1, 2, 3, 0], [np.nan, 0, 0, 0]], "<f4").tofile(tmp_path / "a.bin")
    with pytest.warns(UserWarning, match="dropped 1 of 2 points"):
        assert len(read_cloud(tmp_path / "a.bin")) == 1
