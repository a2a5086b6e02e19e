"""The up direction and the side of cameras, in frames with and without a vertical axis."""

import json

import numpy as np
import pytest
from camera_rigs import nadir, random_rotation, ring, rolled, rotated, sector, walk
from wording import check_error

from pcbench.geometry.cameras import Camera, Intrinsics, look_at
from pcbench.geometry.transform import Similarity
from pcbench.report.viewing import SCHEMA, ViewingCameras, up_of
from pcbench.scenes.synthetic.rigs import Site, rig

K = Intrinsics(400, 300, 350, 350, 200, 150)
Z = np.array([0.0, 0.0, 1.0])
RIGS = {"ring": ring(), "sector": sector(-130, -50), "nadir": nadir(), "nadir, one heading": nadir(turned=False)} | {
    "facade": walk(),
    "facade, rolled": [rolled(camera, 90) if k in (2, 5) else camera for k, camera in enumerate(walk())],
}


def angle_deg(a, b):
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)))


@pytest.mark.parametrize("name", RIGS)
@pytest.mark.parametrize("seed", range(4))
def test_up_is_found_in_any_frame(name, seed):
    rotation = random_rotation(seed)
    cameras = ViewingCameras.of(rotated(RIGS[name], rotation))
    assert angle_deg(cameras.up, rotation @ Z) < 1e-4
    assert not cameras.is_upright
    np.testing.assert_allclose(cameras.upright_rotation() @ cameras.up, Z, atol=1e-12)


@pytest.mark.parametrize("name", RIGS)
def test_z_stays_up_exactly(name):
    cameras = ViewingCameras.of(RIGS[name])
    assert cameras.up.tolist() == [0, 0, 1]
    assert cameras.is_upright
    assert cameras.upright_rotation().tolist() == np.eye(3).tolist()


@pytest.mark.parametrize("name", ["circles", "oblique", "orbit", "grid", "drone"])
def test_z_stays_up_for_the_flights_of_synthetic_cities(name):
    cameras = ViewingCameras.of(rig(name, 40, Site(extent=100.0, ground=0.0, top=20.0), K))
    assert cameras.up.tolist() == [0, 0, 1]


@pytest.mark.parametrize(("lean_deg", "is_upright"), [(3.0, True), (25.0, False)])
def test_a_small_lean_of_the_cameras_does_not_tilt_the_views(lean_deg, is_upright):
    angle = np.radians(lean_deg)
    lean = np.array([[1, 0, 0], [0, np.cos(angle), -np.sin(angle)], [0, np.sin(angle), np.cos(angle)]])
    assert ViewingCameras.of(rotated(ring(), lean)).is_upright == is_upright


def test_a_known_coordinate_system_has_z_up_whatever_the_cameras_show():
    assert ViewingCameras.of(rotated(ring(), random_rotation(1)), z_is_up=True).up.tolist() == [0, 0, 1]


@pytest.mark.parametrize("pitch_deg", [0, 20, 45, 65, 75])
def test_parallel_oblique_views_of_level_cameras_keep_z(pitch_deg):
    """Nothing but the level rows of the images shows that z is up."""
    toward = np.array([0, np.cos(np.radians(pitch_deg)), -np.sin(np.radians(pitch_deg))])
    eyes = [np.array([10.0 * (k % 4), 10.0 * (k // 4), 50.0]) for k in range(12)]
    cameras = [Camera(f"{k}.png", K, look_at(eye, eye + toward)) for k, eye in enumerate(eyes)]
    assert ViewingCameras.of(cameras).is_upright


def test_one_camera_has_the_top_of_its_image_up():
    rotation = random_rotation(5)
    (camera,) = rotated(walk(1, pitches_deg=(0.0,)), rotation)
    assert angle_deg(ViewingCameras.of([camera]).up, rotation @ Z) < 1e-6


def test_cameras_in_all_orientations_have_no_up():
    rng = np.random.default_rng(0)
    cameras = [Camera(f"{k}.png", K, Similarity(random_rotation(100 + k), rng.normal(0, 10, 3))) for k in range(60)]
    viewing = ViewingCameras.of(cameras)
    assert viewing.up is None
    assert viewing.is_upright
    assert up_of(viewing).tolist() == up_of(None).tolist() == [0, 0, 1]
    assert viewing.upright_rotation().tolist() == np.eye(3).tolist()


@pytest.mark.parametrize("name", RIGS)
def test_the_upright_frame_does_not_depend_on_the_frame_of_the_cameras(name):
    one, other = (random_rotation(seed) for seed in (8, 12))
    frames = [ViewingCameras.of(rotated(RIGS[name], turn)).upright_rotation() @ turn for turn in (one, other)]
    np.testing.assert_allclose(frames[0], frames[1], atol=1e-6)


def test_the_upright_frame_looks_with_the_cameras_or_along_their_flight():
    turn = random_rotation(9)

    def axes(cameras):
        return ViewingCameras.of(rotated(cameras, turn)).upright_rotation() @ turn

    np.testing.assert_allclose(axes(walk())[1], [0, 1, 0], atol=0.01)
    np.testing.assert_allclose(axes(nadir())[0], [1, 0, 0], atol=1e-6)
    np.testing.assert_allclose(axes(nadir(turned=False))[0], [1, 0, 0], atol=0.1)
    first = -np.array([np.cos(np.radians(20)), np.sin(np.radians(20)), 0])
    np.testing.assert_allclose(axes(ring())[1], first, atol=1e-6)


def test_cameras_are_written_with_all_digits(tmp_path):
    for cameras in (ViewingCameras.of(rotated(ring(), random_rotation(2))), ViewingCameras.of(ring())):
        cameras.write(tmp_path / "cameras.json")
        found = ViewingCameras.read(tmp_path / "cameras.json")
        for name in ("centers", "directions", "up"):
            np.testing.assert_array_equal(getattr(found, name), getattr(cameras, name))
    ViewingCameras(cameras.centers, cameras.directions, None).write(tmp_path / "cameras.json")
    assert ViewingCameras.read(tmp_path / "cameras.json").up is None


@pytest.mark.parametrize(
    "changes",
    [{"centers": []}, {"centers": [[0, 0, None]]}, {"directions": [[0, 0, 2.0]]}, {"directions": "x"}]
    + [
        {"schema": "pcbench.cameras/9"},
        {"up": [0, 0]},
        {"up": [0, 0, 0]},
        {"up": [float("nan"), 0, 1]},
        {"centers": [[0, 0, float("inf")]]},
    ],
)
def test_damaged_cameras_are_refused(changes, tmp_path):
    values = {"schema": SCHEMA, "centers": [[1.0, 2, 3]], "directions": [[0, 0, -1.0]], "up": [0, 0, 1.0]}
    (tmp_path / "cameras.json").write_text(json.dumps(values | changes))
    with check_error():
        ViewingCameras.read(tmp_path / "cameras.json")


def test_cameras_that_do_not_see_the_cloud_are_refused():
    cameras, cloud = ViewingCameras.of(walk()), np.random.default_rng(0).normal(0, 3, (500, 3))
    cameras.check_sight(cloud)
    cameras.check_sight(cloud[:1])
    cameras.check_sight(np.concatenate([cloud + [0, -500, 0], cloud[:300]]))
    with check_error():
        cameras.check_sight(cloud + [0, -500, 0])  # behind all cameras
    with check_error():
        cameras.check_sight(cloud + [0, 5e6, 0])  # coordinates of UTM
