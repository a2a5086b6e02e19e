"""E57: scan poses, all kinds of coordinates, and damaged files."""

import sys
from contextlib import contextmanager
from pathlib import Path

import e57_bytes
import numpy as np
import pytest
from data_folder import data_folder
from e57_bytes import RAE, XYZ, write
from optional import break_library, import_or_skip
from wording import check_error

from pcbench import read_cloud
from pcbench.errors import InputError, MissingExtra, PcbenchError
from pcbench.geometry.cameras import nearest_rotation

RNG = np.random.default_rng(7)
POINTS = RNG.uniform(-5, 5, (200, 3))
SQRT_HALF = np.sqrt(0.5)


@pytest.fixture
def pye57():
    return import_or_skip("pye57")


def cartesian(points, **columns):
    return dict(zip(XYZ, points.T, strict=True)) | columns


def spherical(points):
    distance = np.linalg.norm(points, axis=1)
    columns = distance, np.arctan2(points[:, 1], points[:, 0]), np.arcsin(points[:, 2] / distance)
    return dict(zip(RAE, columns, strict=True))


def read(path):
    notes = []
    return read_cloud(path, on_warning=notes.append), notes


def test_scan_poses_are_applied(pye57, tmp_path):
    # A quarter turn about z, and another about x.
    poses = [((SQRT_HALF, 0, 0, SQRT_HALF), (100, 200, 300)), ((SQRT_HALF, SQRT_HALF, 0, 0), (-1, 0, 1))]
    rotations = [
        nearest_rotation([[0, -1, 0], [1, 0, 0], [0, 0, 1]]),
        nearest_rotation([[1, 0, 0], [0, 0, -1], [0, 1, 0]]),
    ]
    scans = [cartesian(POINTS, pose=poses[0]), spherical(POINTS) | {"pose": poses[1]}, cartesian(POINTS)]
    cloud, notes = read(write(tmp_path / "a.e57", scans))
    expected = [POINTS @ rotation.T + pose[1] for rotation, pose in zip(rotations, poses, strict=True)]
    # Doubles throughout; angles and sines differ by rounding.
    np.testing.assert_allclose(cloud.points, np.concatenate([*expected, POINTS]), atol=1e-12)
    np.testing.assert_array_equal(cloud.attributes["scan"], np.repeat([0, 1, 2], 200))
    assert cloud.unit == "m"
    assert notes == []


def test_colours_intensity_normals_and_invalid_points(pye57, tmp_path):
    is_invalid = np.arange(200) % 4 == 3
    colors = RNG.integers(0, 65536, (200, 3))
    normals = POINTS / np.linalg.norm(POINTS, axis=1)[:, None]
    scan = cartesian(
        POINTS, cartesianInvalidState=np.where(is_invalid, np.arange(200) % 3, 0), intensity=POINTS[:, 0] ** 2
    )
    scan |= dict(zip(("colorRed", "colorGreen", "colorBlue"), colors.T, strict=True))
    scan |= dict(zip(("nor:normalX", "nor:normalY", "nor:normalZ"), normals.T, strict=True))
    is_valid = np.asarray(scan["cartesianInvalidState"]) == 0
    scan |= {"limits": (0, 65535), "pose": ((SQRT_HALF, 0, 0, SQRT_HALF), (0, 0, 0))}
    cloud, notes = read(write(tmp_path / "a.e57", [scan], crs="EPSG:25832"))
    np.testing.assert_array_equal(cloud.colors, np.rint(colors[is_valid] * (255 / 65535)))
    np.testing.assert_array_equal(cloud.attributes["intensity"], (POINTS[:, 0] ** 2)[is_valid])
    rotated_normals = normals[is_valid] @ np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]]).T
    np.testing.assert_allclose(cloud.normals, rotated_normals, atol=1e-12)
    assert "scan" not in cloud.attributes
    assert cloud.crs == "EPSG:25832"
    assert notes == [
        f"{tmp_path / 'a.e57'}: dropped {200 - is_valid.sum()} of 200 points that the file marks as invalid"
    ]


@pytest.mark.parametrize(
    ("stored", "expected"),
    [
        ((0.2, 0.5, 1.0), [51, 128, 255]),
        ((20.0, 100.0, 255.0), [20, 100, 255]),
        ((20, 100, 255), [20, 100, 255]),
        ((0, 30000, 65535), [0, 117, 255]),
        ((0, 1, 0), [0, 1, 0]),
    ],
)
def test_colours_without_limits_are_scaled_by_their_values(pye57, tmp_path, stored, expected):
    channels = dict.fromkeys(("colorRed", "colorGreen", "colorBlue"), np.array(stored))
    eight_bit = dict.fromkeys(channels, np.array([7, 8, 9])) | {"limits": (0, 255)}
    scans = [cartesian(POINTS[:3]) | channels, cartesian(POINTS[:3]) | eight_bit]
    cloud, notes = read(write(tmp_path / "a.e57", scans))
    assert (cloud.colors[:, 1].tolist(), notes) == ([*expected, 7, 8, 9], [])


def test_fields_missing_in_some_scans_are_left_out(pye57, tmp_path):
    scans = [cartesian(POINTS, intensity=POINTS[:, 0]), cartesian(POINTS), {"intensity": POINTS[:, 0]}, {}]
    cloud, notes = read(write(tmp_path / "a.e57", scans))
    assert len(cloud) == 400
    assert set(cloud.attributes) == {"scan"}
    assert any("2 of 4 scans have no valid point" in note for note in notes)
    assert any("only some of 2 scans have: intensity" in note for note in notes)


def test_points_in_several_blocks(pye57, tmp_path):
    points = RNG.uniform(-5, 5, (600_000, 3))
    cloud, _ = read(write(tmp_path / "a.e57", [cartesian(points)]))
    np.testing.assert_array_equal(cloud.points, points)


@pytest.mark.parametrize(
    ("name", "points", "attributes"),
    [
        ("A_moved_B.e57", 6, {"intensity", "scan"}),
        ("ColouredCubeFloat.e57", 7680, set()),
        ("bunnyInt32.e57", 30571, set()),
    ],
)
def test_files_of_other_programs(pye57, name, points, attributes):
    cloud, notes = read(data_folder("e57") / name)
    assert len(cloud) == points
    assert set(cloud.attributes) == attributes
    assert (cloud.colors is not None) == (name != "bunnyInt32.e57")
    assert notes == []


def test_damaged_and_empty_files_of_other_programs(pye57):
    for name, message in (("bad-crc.e57", "checksum"), ("ZeroPointsInvalid.e57", "at least one valid point")):
        path = data_folder("e57") / name
        with pytest.raises(InputError, match=message) as caught:
            read(path)
        assert str(caught.value).startswith(f"{path}: ")
        assert "\n" not in str(caught.value)


def test_invalid_files_are_refused(pye57, tmp_path):
    valid_data = write(tmp_path / "a.e57", [cartesian(POINTS)]).read_bytes()
    flipped_bit_data = valid_data[:3000] + bytes([valid_data[3000] ^ 1]) + valid_data[3001:]
    (tmp_path / "zero.e57").write_bytes(write(tmp_path / "b.e57", []).read_bytes())
    for data, message in (
        (b"ply\nformat ascii", "starts with ASTM-E57"),
        (valid_data[:2000], "damaged E57 data"),
        (flipped_bit_data, "checksum"),
        ((tmp_path / "zero.e57").read_bytes(), "scans: 0"),
        (
            write(tmp_path / "b.e57", [cartesian(POINTS, pose=((2, 0, 0, 0), (0, 0, 0)))]).read_bytes(),
            "unit quaternion",
        ),
        (
            write(tmp_path / "b.e57", [cartesian(POINTS, cartesianInvalidState=np.full(200, 2))]).read_bytes(),
            "scans: 1",
        ),
    ):
        (tmp_path / "x.e57").write_bytes(data)
        with pytest.raises(InputError, match=message):
            read(tmp_path / "x.e57")
        assert (tmp_path / "x.e57").read_bytes() == data


def test_checksums_match_the_library(pye57, tmp_path):
    data = write(tmp_path / "a.e57", [cartesian(POINTS)]).read_bytes()
    assert e57_bytes.add_checksums(data) == data


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full, a disk that is full")
def test_full_disk_is_not_reported_as_damage(pye57, tmp_path, monkeypatch):
    @contextmanager
    def full_folder():
        (tmp_path / "full").mkdir()
        (tmp_path / "full" / "0.points").symlink_to("/dev/full")
        yield tmp_path / "full"

    path = tmp_path / "a.e57"
    write(path, [cartesian(POINTS)])
    monkeypatch.setattr("pcbench.io.e57.scratch_folder", full_folder)
    with pytest.raises(PcbenchError, match="no space left for temporary files"):
        read(path)


def test_without_pye57(monkeypatch, tmp_path):
    (tmp_path / "a.e57").write_bytes(b"ASTM-E57")
    monkeypatch.setitem(sys.modules, "pye57", None)
    with check_error(MissingExtra):
        read(tmp_path / "a.e57")


def test_pye57_that_cannot_be_imported(monkeypatch, tmp_path, pye57):
    path = write(tmp_path / "a.e57", [cartesian(POINTS)])
    (tmp_path / "broken/pye57").mkdir(parents=True)
    (tmp_path / "broken/pye57/__init__.py").write_text(
        "raise OSError('libxerces-c.so: cannot open shared object file')"
    )
    monkeypatch.syspath_prepend(str(tmp_path / "broken"))
    with check_error(MissingExtra):
        read(path)


def test_import_error_of_pye57_is_reported(monkeypatch, tmp_path):
    (tmp_path / "a.e57").write_bytes(b"ASTM-E57")
    error = "ImportError('libxerces-c-3.2.so: cannot open shared object file: No such file or directory')"
    break_library(monkeypatch, tmp_path / "packages", "pye57", error)
    with pytest.raises(MissingExtra, match=r"libxerces-c-3\.2\.so: cannot open .* apt-get install libxerces-c-3\.2"):
        read(tmp_path / "a.e57")
