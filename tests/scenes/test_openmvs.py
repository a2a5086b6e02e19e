"""OpenMVS scenes: cameras and points of all versions of the interface format, and refused files."""

from dataclasses import replace

import mvs_bytes
import numpy as np
import pytest
from mvs_bytes import COLORS, POINTS, scene_bytes
from scene_folders import NAMES, orbit
from wording import check_error, check_text

from pcbench.errors import InputError
from pcbench.geometry.cameras import Intrinsics, look_at
from pcbench.io.openmvs import read_openmvs
from pcbench.scenes import read_scene

K = Intrinsics(64, 48, 50.0, 51.0, 31.0, 25.0)
CAMERAS = orbit(NAMES, K)


def read(path, data):
    path.write_bytes(data)
    notes = []
    return read_openmvs(path, lambda name: (64, 48), notes.append), notes


@pytest.mark.parametrize("version", range(1, 8))
def test_all_versions_are_read(photographs, version):
    (photographs / "scene.mvs").write_bytes(scene_bytes(CAMERAS, version))
    scene = read_scene(photographs)
    assert list(scene.cameras) == NAMES
    for expected in CAMERAS:
        camera = scene.cameras[expected.name]
        assert camera.intrinsics == K
        # Lengths are about 5; the rotation is the polar factor of the stored matrix.
        np.testing.assert_allclose(camera.cam_from_world.matrix, expected.cam_from_world.matrix, atol=1e-12)
    np.testing.assert_array_equal(scene.points.points, POINTS)
    np.testing.assert_array_equal(scene.points.colors, COLORS)
    np.testing.assert_array_equal(scene.points.attributes["track_length"], [2, 3, 1])


def test_cameras_mounted_on_a_platform(tmp_path):
    mount = look_at([1, 2, 3], [0, 0, 0]).rotation, np.array([0.1, 0.2, 0.3])
    (cameras, _), _ = read(tmp_path / "a.mvs", scene_bytes(CAMERAS, mount=mount))
    for camera, expected in zip(cameras, CAMERAS, strict=True):
        np.testing.assert_allclose(camera.cam_from_world.matrix, expected.cam_from_world.matrix, atol=1e-12)


def test_intrinsics_without_a_size_use_the_image_size(tmp_path):
    (cameras, _), _ = read(tmp_path / "a.mvs", scene_bytes(CAMERAS, normalized=True))
    k = cameras[0].intrinsics
    assert (k.width, k.height) == (64, 48)
    assert (k.fx, k.fy, k.cx, k.cy) == pytest.approx((50, 51, 31, 25), rel=1e-12)


def test_cameras_without_a_size_and_image_are_left_out_with_a_warning(photographs):
    (photographs / "scene.mvs").write_bytes(scene_bytes(CAMERAS, normalized=True))
    for name in NAMES[2:4]:
        (photographs / "images" / name).unlink()
    notes = []
    assert len(read_scene(photographs, on_warning=notes.append).cameras) == 8
    check_text("\n".join(notes))
    (photographs / "scene.mvs").write_bytes(
        scene_bytes([replace(c, name=f"other{k}.png") for k, c in enumerate(CAMERAS)], normalized=True)
    )
    with check_error():
        read_scene(photographs)


def test_images_without_a_pose_normals_and_transforms(tmp_path):
    data = scene_bytes(CAMERAS, normals=np.eye(3), transform=np.diag([2.0, 2, 2, 1]), has_pose=lambda k: k % 2)
    (cameras, points), notes = read(tmp_path / "a.mvs", data)
    assert [camera.name for camera in cameras] == [f"undistorted\\{name}" for name in NAMES[1::2]]
    np.testing.assert_array_equal(points.normals, np.eye(3))
    check_text(notes[0])


def test_choice_among_several_scenes(photographs):
    for name in ("a.mvs", "b.mvs"):
        (photographs / name).write_bytes(scene_bytes(CAMERAS))
    with check_error():
        read_scene(photographs)
    assert len(read_scene(photographs, cameras=photographs / "b.mvs").cameras) == 10
    (photographs / "scene.mvs").write_bytes(scene_bytes(CAMERAS[:3]))
    assert len(read_scene(photographs, on_warning=lambda _: None).cameras) == 3


VALID_SCENE = scene_bytes(CAMERAS)


@pytest.mark.parametrize(
    "data",
    [
        pytest.param(b"", id="empty"),
        pytest.param(b"ply\nformat", id="another format"),
        pytest.param(b"MVS\0" + VALID_SCENE[4:], id="a project"),
        pytest.param(VALID_SCENE[:4] + b"\x63" + VALID_SCENE[5:], id="another version"),
        pytest.param(VALID_SCENE[:12] + b"\xff" * 8 + VALID_SCENE[20:], id="absurd count"),
        pytest.param(VALID_SCENE[:200], id="cut after 200 bytes"),
        pytest.param(VALID_SCENE[:-130], id="cut before the end"),
        pytest.param(scene_bytes(CAMERAS, has_pose=lambda k: False), id="no pose"),
        pytest.param(scene_bytes(CAMERAS, colors=COLORS[:2]), id="too few colours"),
        pytest.param(scene_bytes(CAMERAS, mount=(2 * np.eye(3), np.zeros(3))), id="no rotation"),
        pytest.param(
            scene_bytes([replace(c, name="\x1b[31m") for c in CAMERAS]).replace(b"\x1b", b"\xff"), id="not UTF-8"
        ),
    ],
)
def test_invalid_scenes_are_refused(tmp_path, data):
    with check_error() as caught:
        read(tmp_path / "a.mvs", data)
    assert str(caught.value).startswith(f"{tmp_path / 'a.mvs'}: ")


def test_truncation_at_any_byte_is_reported(tmp_path):
    # All bytes except the box at the end are read.
    data = mvs_bytes.corpus()["new"]
    for size in range(1, len(data) - 120, 7):
        with pytest.raises(InputError):
            read(tmp_path / "a.mvs", data[:size])
