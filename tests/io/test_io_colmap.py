"""COLMAP's points3D files: written by pycolmap, hand-made bytes, folders, and damage."""

import random
import struct

import numpy as np
import pytest
from optional import import_or_skip
from ply_bytes import damage
from wording import check_error

from pcbench.errors import PcbenchError
from pcbench.geometry.cloud import Cloud
from pcbench.io import read_cloud, write_cloud
from pcbench.io.colmap import read_points3d


def point_bytes(number, track):
    return struct.pack(
        "<Q3d3BdQ", number, number * 0.5, -number, 1e6 + number, 10, 20, number % 256, 0.25 * number, track
    ) + (struct.pack("<2i", 7, number) * track)


def model_bytes(count, tracks=(2, 0, 5)):
    return struct.pack("<Q", count) + b"".join(point_bytes(i + 1, tracks[i % len(tracks)]) for i in range(count))


MODEL_TEXT = b"""# 3D point list with one line of data per point:
#   POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)
# Number of points: 3, mean track length: 1.6666
63 1.67241 0.292931 0.609726 115 121 122 1.33927 16 6542 15 7345 6 6714
60 2.01848 0.108877 -0.0260841 102 209 250 1.73449

18446744073709551615 1 2 3 0 255 1 -1 1 2 3 4
"""


def test_binary_points(tmp_path):
    path = tmp_path / "points3D.bin"
    path.write_bytes(model_bytes(7))
    cloud = read_cloud(path)
    ids = np.arange(1, 8)
    np.testing.assert_array_equal(cloud.points, np.column_stack([ids * 0.5, -ids, 1e6 + ids]))
    np.testing.assert_array_equal(cloud.colors, np.column_stack([[10] * 7, [20] * 7, ids]))
    np.testing.assert_array_equal(cloud.attributes["point3D_id"], ids)
    np.testing.assert_array_equal(cloud.attributes["reprojection_error"], 0.25 * ids)
    np.testing.assert_array_equal(cloud.attributes["track_length"], [2, 0, 5, 2, 0, 5, 2])
    assert {name: values.dtype.str[1:] for name, values in cloud.attributes.items()} == {
        "point3D_id": "u8",
        "reprojection_error": "f8",
        "track_length": "i8",
    }


def test_text_points(tmp_path):
    path = tmp_path / "points3D.txt"
    path.write_bytes(MODEL_TEXT)
    cloud = read_cloud(path)
    np.testing.assert_array_equal(cloud.points[1:], [(2.01848, 0.108877, -0.0260841), (1, 2, 3)])
    np.testing.assert_array_equal(cloud.colors[0], (115, 121, 122))
    np.testing.assert_array_equal(cloud.attributes["track_length"], [3, 0, 2])
    np.testing.assert_array_equal(cloud.attributes["point3D_id"], np.array([63, 60, 2**64 - 1], np.uint64))
    np.testing.assert_array_equal(cloud.attributes["reprojection_error"], [1.33927, 1.73449, -1])


def test_files_written_by_pycolmap(tmp_path):
    pycolmap = import_or_skip("pycolmap")
    rng = np.random.default_rng(1)
    reconstruction = pycolmap.Reconstruction()
    points, colors = rng.normal(size=(50, 3)), rng.integers(0, 256, (50, 3), dtype=np.uint8)
    ids = [reconstruction.add_point3D(p, pycolmap.Track(), c) for p, c in zip(points, colors, strict=True)]
    for name in ("bin", "txt"):
        (tmp_path / name).mkdir()
    reconstruction.write_binary(str(tmp_path / "bin"))
    reconstruction.write_text(str(tmp_path / "txt"))
    for name, tolerance in (("bin", 0), ("txt", 1e-12)):
        cloud = read_cloud(tmp_path / name)
        order = np.argsort(cloud.attributes["point3D_id"])
        np.testing.assert_array_equal(cloud.attributes["point3D_id"][order], sorted(ids))
        np.testing.assert_allclose(cloud.points[order], points, rtol=0, atol=tolerance)
        np.testing.assert_array_equal(cloud.colors[order], colors)
        np.testing.assert_array_equal(cloud.attributes["track_length"], 0)


def test_folders_without_a_model(tmp_path):
    with check_error():
        read_points3d(tmp_path)
    with check_error():
        read_cloud(tmp_path)
    with check_error():
        write_cloud(tmp_path / "points3D.bin", Cloud(np.zeros((1, 3))))
    assert not list(tmp_path.iterdir())


HUGE_TRACK = model_bytes(2)[:51] + struct.pack("<Q", 2**63) + model_bytes(2)[59:]
DAMAGED_FILES = {
    "points3D.bin": {
        "not a count": b"abc",
        "no points": model_bytes(0),
        "half": model_bytes(1000, (0,))[: 8 + 500 * 51 + 20],
        "the last byte": model_bytes(9)[:-1],
        "absurd count": struct.pack("<Q", 2**64 - 1) + point_bytes(1, 0),
        "absurd track": HUGE_TRACK,
    },
    "points3D.txt": {
        "nothing": b"# nothing\n",
        "half": MODEL_TEXT[: MODEL_TEXT.index(b"60 2.0")],
        "short line": MODEL_TEXT + b"1 2 3\n",
        "colour 256": MODEL_TEXT.replace(b"115", b"256"),
        "colour nan": MODEL_TEXT.replace(b"115", b"nan"),
        "half a pair": MODEL_TEXT.replace(b"16 6542", b"16"),
        "digits": b"9" * 5000 + b" 1 2 3 4 5 6 7\n",
    },
}


@pytest.mark.parametrize(("name", "case"), [(name, case) for name, cases in DAMAGED_FILES.items() for case in cases])
def test_damaged_files(tmp_path, name, case):
    path = tmp_path / name
    path.write_bytes(DAMAGED_FILES[name][case])
    with check_error() as caught:
        read_cloud(tmp_path)
    assert str(caught.value).startswith(f"{path}: ")
    assert str(caught.value).isprintable()


def test_a_scene_with_cameras_alone_names_its_cloud(tmp_path):
    for name in ("sparse/0/points3D.txt", "truth/cloud.ply"):
        (tmp_path / name).parent.mkdir(parents=True)
        (tmp_path / name).write_bytes(b"# nothing\n")
    with check_error() as caught:
        read_cloud(tmp_path)
    assert f"name a cloud, such as {tmp_path}/truth/cloud.ply" in str(caught.value)


def test_random_damage(tmp_path):
    rng = random.Random(1)
    failures = 0
    for name, data in (("points3D.bin", model_bytes(9)), ("points3D.txt", MODEL_TEXT)):
        for _ in range(300):
            (tmp_path / name).write_bytes(damage(data, rng))
            try:
                read_cloud(tmp_path / name, on_warning=lambda note: None)
            except PcbenchError as error:
                assert str(error).startswith(f"{tmp_path / name}: ") and str(error).isprintable()
                failures += 1
    assert 100 < failures < 600
