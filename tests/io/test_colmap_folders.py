"""Folders with one COLMAP model or several, of which the largest is read, by clouds and scenes alike."""

import struct

import numpy as np
import pytest
from scene_folders import NAMES, orbit, ten_images_folder
from wording import check_text

from pcbench import Cloud
from pcbench.io import read_cloud
from pcbench.io.colmap import read_points3d
from pcbench.io.colmap_model import write_colmap_model
from pcbench.io.pieces import open_cloud
from pcbench.scenes import read_scene


def model(folder, images, points):
    cloud = Cloud(np.random.default_rng(points).uniform(size=(points, 3)))
    write_colmap_model(folder, orbit(NAMES[:images]), cloud)


def read_each(path):
    """Return the numbers of points and of cameras that are read, and the warnings of either."""
    of_cloud, of_scene = [], []
    count = len(read_cloud(path, on_warning=of_cloud.append))
    on_disk = open_cloud(path)
    assert on_disk.count == count
    assert list(on_disk.warnings) == of_cloud
    of_model = []
    assert len(read_points3d(path, of_model.append)) == count
    assert of_model == of_cloud
    scene = read_scene(path, on_warning=of_scene.append)
    return count, len(scene.cameras), of_cloud, [note for note in of_scene if "COLMAP" in note]


@pytest.mark.parametrize("place", [".", "0", "3", "sparse", "sparse/0", "sparse/7", "colmap/sparse/0", "models/2"])
def test_one_model(tmp_path, place):
    model(ten_images_folder(tmp_path) / place, 10, 30)
    assert read_each(tmp_path) == (30, 10, [], [])


SEVERAL = {
    "numbered": {"sparse/0": (2, 20), "sparse/1": (9, 900)},
    "order of numbers": {"sparse/2": (9, 900), "sparse/10": (2, 20)},
    "beside": {"sparse": (2, 20), "sparse/0": (9, 900)},
    "direct": {"0": (2, 20), "1": (9, 900), "2": (3, 30)},
    "places": {".": (2, 20), "sparse/0": (9, 900)},
    "fewer images, more points": {"sparse/0": (2, 2000), "sparse/1": (9, 900)},
    "as many images, fewer points": {"sparse/0": (9, 20), "sparse/1": (9, 900)},
    "many": {**{f"sparse/{k}": (2, 20) for k in range(9)}, "sparse/9": (9, 900)},
}


@pytest.mark.parametrize("case", SEVERAL)
def test_the_largest_of_several_models_is_read_and_all_are_named(tmp_path, case):
    ten_images_folder(tmp_path)
    for place, (images, points) in SEVERAL[case].items():
        model(tmp_path / place, images, points)
    points, cameras, (of_cloud,), (of_scene,) = read_each(tmp_path)
    assert (points, cameras) == (900, 9)
    assert all("(9 images, 900 points)" in note for note in (of_cloud, of_scene))
    check_text(of_cloud)
    check_text(of_scene)


def test_a_named_model_is_read_without_a_word(tmp_path):
    ten_images_folder(tmp_path)
    model(tmp_path / "sparse/0", 10, 20)
    model(tmp_path / "sparse/1", 9, 900)
    notes = []
    for name in ("sparse/0", "sparse/0/points3D.txt"):
        assert len(read_cloud(tmp_path / name, on_warning=notes.append)) == 20
    for name in ("sparse/0", "sparse/0/images.txt"):
        assert len(read_scene(tmp_path, cameras=tmp_path / name, on_warning=notes.append).cameras) == 10
    assert not notes
    for cameras in ("auto", tmp_path / "sparse"):
        assert len(read_scene(tmp_path, cameras=cameras, on_warning=notes.append).points) == 20
    assert len(notes) == 2
    # The file that the warning names selects the other model.
    other = notes[0].rpartition("--cameras ")[2]
    assert len(read_scene(tmp_path, cameras=other, on_warning=notes.append).points) == 900


def test_counts_of_binary_models_and_of_text_without_a_header(tmp_path):
    for number, count in ((0, 3), (1, 5), (2, 4)):
        folder = tmp_path / str(number)
        folder.mkdir()
        points = b"".join(struct.pack("<Q3d3BdQ", k, k, 0, 0, 1, 2, 3, 0.5, 0) for k in range(count))
        (folder / "points3D.bin").write_bytes(struct.pack("<Q", count) + points)
    (tmp_path / "3").mkdir()
    (tmp_path / "3/points3D.bin").write_bytes(struct.pack("<Q", 2**60))  # damaged
    notes = []
    assert len(read_cloud(tmp_path, on_warning=notes.append)) == 5
    check_text(notes[0])
