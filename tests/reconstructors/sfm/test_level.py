"""Levelling of rigs with known up direction in rotated, scaled and shifted frames."""

import numpy as np
import pytest
from wording import check_text

from pcbench.geometry.cameras import Camera, Intrinsics, look_at
from pcbench.geometry.transform import Similarity
from pcbench.scenes.synthetic.rigs import Site, rig
from reconstructors.sfm.alignment import transform_camera
from reconstructors.sfm.level import leveling_rotation

K = Intrinsics(400, 300, 350, 350, 200, 150)
SITE = Site(extent=100.0, ground=0.0, top=20.0)


def random_frame(seed):
    q, r = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    q *= np.sign(np.diag(r))
    return Similarity(q if np.linalg.det(q) > 0 else -q, np.array([3.0, -2, 5]), 0.37)


def about_axis(degrees, axis):
    a, b = (k for k in range(3) if k != axis)
    turn = np.eye(3)
    turn[a, a] = turn[b, b] = np.cos(np.radians(degrees))
    turn[a, b], turn[b, a] = -np.sin(np.radians(degrees)), np.sin(np.radians(degrees))
    return Similarity(turn, np.zeros(3))


def rolled(camera, degrees):
    """Return the camera rotated about its viewing direction."""
    return Camera(camera.name, camera.intrinsics, about_axis(degrees, 2) @ camera.cam_from_world)


def tilt_after_levelling(cameras, seed=1):
    """Level cameras in another frame; return the angle in degrees between +z and true up, and the note."""
    frame = random_frame(seed)
    turn, note = leveling_rotation({camera.name: transform_camera(camera, frame) for camera in cameras})
    if turn is None:
        return None, note
    assert turn.scale == 1
    assert not turn.translation.any()
    up = turn.rotation @ frame.rotation[:, 2]
    return float(np.degrees(np.arctan2(np.linalg.norm(up[:2]), up[2]))), note


# The images of these rigs are upright, or look down between axes that are: rounding is all that is left. The drone's
# are unsteady by 1.5 degrees, of which 40 leave a quarter in their mean, and three times that at most.
@pytest.mark.parametrize(
    "name, limit", [("circles", 1e-6), ("oblique", 1e-6), ("orbit", 1e-6), ("grid", 1e-6), ("drone", 0.75)]
)
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_rigs_of_the_synthetic_cities(name, limit, seed):
    tilt, note = tilt_after_levelling(rig(name, 40, SITE, K), seed)
    assert tilt < limit, note
    assert ("viewing direction" in note) == (name == "grid")


@pytest.mark.parametrize("degrees", [90, -90, 180, 37])
def test_a_minority_of_turned_images_changes_nothing(degrees):
    cameras = [rolled(c, degrees) if k % 5 < 2 else c for k, c in enumerate(rig("orbit", 40, SITE, K))]
    tilt, note = tilt_after_levelling(cameras)
    # Half turns keep the rows horizontal; the others drop out.
    assert tilt < 1e-6, note
    assert ("24 of 40" in note) == (degrees != 180)


@pytest.mark.parametrize("degrees", [90, -90])
def test_images_that_are_all_turned_by_a_quarter(degrees):
    tilt, note = tilt_after_levelling([rolled(c, degrees) for c in rig("orbit", 40, SITE, K)])
    assert tilt < 1e-6, note
    assert "columns" in note


def test_hand_held_images_are_rolled_a_little():
    rng = np.random.default_rng(6)
    cameras = [rolled(c, rng.normal(0, 3)) for c in rig("orbit", 40, SITE, K)]
    tilt, note = tilt_after_levelling(cameras)
    # 3 degrees of 40 images about a circle leave 3 / sqrt(20) = 0.7 about either axis; three times that at most.
    assert tilt < 2.1, note


def test_photographs_that_look_up_from_the_street():
    eyes = [[20 * np.cos(a), 20 * np.sin(a), 1.7] for a in np.linspace(0, 2, 12)]
    cameras = [Camera(f"{k}.jpg", K, look_at(eye, [0, 0, 15])) for k, eye in enumerate(eyes)]
    tilt, note = tilt_after_levelling(cameras)
    assert tilt < 1e-6, note


def nadir(positions, turned=()):
    cameras = [Camera(f"{k}.jpg", K, look_at(p, [p[0], p[1], 0])) for k, p in enumerate(positions)]
    return [rolled(c, 180) if k in turned else c for k, c in enumerate(cameras)]


def test_strips_flown_there_and_back():
    grid = [(10.0 * x, 15.0 * y, 60.0) for y in range(4) for x in range(8)]
    tilt, note = tilt_after_levelling(nadir(grid, turned=[*range(8, 16), *range(24, 32)]))
    assert tilt < 1e-6, note
    assert "viewing direction" in note


@pytest.mark.parametrize(
    "cameras",
    [
        nadir([(10.0 * x, 0.0, 60.0) for x in range(8)]),
        nadir([(10.0 * x, 0.0, 60.0) for x in range(2)]),
        nadir([(10.0 * x, 15.0 * y, 60.0 + 12 * x) for y in range(4) for x in range(8)]),
        [rolled(c, 77.0 * k) for k, c in enumerate(rig("orbit", 24, Site(100.0, 0.0, 20.0), K))],
    ],
    ids=["along a line", "too few", "climbing: nothing tells that it looks down", "looking every way"],
)
def test_an_undetermined_up_direction_is_reported(cameras):
    tilt, note = tilt_after_levelling(cameras)
    assert tilt is None
    check_text(note)


def test_a_level_model_stays_as_it_is():
    cameras = rig("circles", 30, SITE, K)
    turn, _ = leveling_rotation({camera.name: camera for camera in cameras})
    np.testing.assert_allclose(turn.rotation, np.eye(3), atol=1e-7)
    upside_down = about_axis(180, 0)
    turn, _ = leveling_rotation({camera.name: transform_camera(camera, upside_down) for camera in cameras})
    np.testing.assert_allclose(turn.rotation @ upside_down.rotation[:, 2], [0, 0, 1], atol=1e-7)


def test_the_same_cameras_are_levelled_to_the_bit():
    cameras = {camera.name: transform_camera(camera, random_frame(9)) for camera in rig("drone", 60, SITE, K)}
    first, again = leveling_rotation(cameras)[0], leveling_rotation(cameras)[0]
    assert first.rotation.tobytes() == again.rotation.tobytes()
