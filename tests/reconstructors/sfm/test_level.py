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


def rotation_about(degrees, axis):
    a, b = (k for k in range(3) if k != axis)
    matrix = np.eye(3)
    matrix[a, a] = matrix[b, b] = np.cos(np.radians(degrees))
    matrix[a, b], matrix[b, a] = -np.sin(np.radians(degrees)), np.sin(np.radians(degrees))
    return Similarity(matrix, np.zeros(3))


def roll_camera(camera, degrees):
    """Return the camera rotated about its viewing direction."""
    return Camera(camera.name, camera.intrinsics, rotation_about(degrees, 2) @ camera.cam_from_world)


def tilt_after_levelling(cameras, seed=1):
    """Level cameras in another frame; return the angle in degrees between +z and true up, and the note."""
    frame = random_frame(seed)
    leveling, note = leveling_rotation({camera.name: transform_camera(camera, frame) for camera in cameras})
    if leveling is None:
        return None, note
    assert leveling.scale == 1
    assert not leveling.translation.any()
    up = leveling.rotation @ frame.rotation[:, 2]
    return float(np.degrees(np.arctan2(np.linalg.norm(up[:2]), up[2]))), note


# The images of these rigs are upright or look down along horizontal axes, so only rounding remains. The drone's
# images have a random tilt of 1.5 degrees: the mean of 40 is off by a quarter of that, at most by three times as much.
@pytest.mark.parametrize(
    "name, limit", [("circles", 1e-6), ("oblique", 1e-6), ("orbit", 1e-6), ("grid", 1e-6), ("drone", 0.75)]
)
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_rigs_of_the_synthetic_cities_are_levelled(name, limit, seed):
    tilt, note = tilt_after_levelling(rig(name, 40, SITE, K), seed)
    assert tilt < limit, note
    assert ("viewing direction" in note) == (name == "grid")


@pytest.mark.parametrize("degrees", [90, -90, 180, 37])
def test_a_minority_of_rolled_images_has_no_influence(degrees):
    cameras = [roll_camera(c, degrees) if k % 5 < 2 else c for k, c in enumerate(rig("orbit", 40, SITE, K))]
    tilt, note = tilt_after_levelling(cameras)
    # Half turns keep the rows horizontal; the others drop out.
    assert tilt < 1e-6, note
    assert ("24 of 40" in note) == (degrees != 180)


@pytest.mark.parametrize("degrees", [90, -90])
def test_images_all_rolled_by_90_degrees_are_levelled(degrees):
    tilt, note = tilt_after_levelling([roll_camera(c, degrees) for c in rig("orbit", 40, SITE, K)])
    assert tilt < 1e-6, note
    assert "columns" in note


def test_random_rolls_leave_a_small_tilt():
    rng = np.random.default_rng(6)
    cameras = [roll_camera(c, rng.normal(0, 3)) for c in rig("orbit", 40, SITE, K)]
    tilt, note = tilt_after_levelling(cameras)
    # 3 degrees of 40 images about a circle leave 3 / sqrt(20) = 0.7 about either axis; three times that at most.
    assert tilt < 2.1, note


def test_images_that_look_up_are_levelled():
    eyes = [[20 * np.cos(a), 20 * np.sin(a), 1.7] for a in np.linspace(0, 2, 12)]
    cameras = [Camera(f"{k}.jpg", K, look_at(eye, [0, 0, 15])) for k, eye in enumerate(eyes)]
    tilt, note = tilt_after_levelling(cameras)
    assert tilt < 1e-6, note


def nadir_cameras(positions, rolled_indices=()):
    cameras = [Camera(f"{k}.jpg", K, look_at(p, [p[0], p[1], 0])) for k, p in enumerate(positions)]
    return [roll_camera(c, 180) if k in rolled_indices else c for k, c in enumerate(cameras)]


def test_strips_flown_in_both_directions_are_levelled():
    grid = [(10.0 * x, 15.0 * y, 60.0) for y in range(4) for x in range(8)]
    tilt, note = tilt_after_levelling(nadir_cameras(grid, rolled_indices=[*range(8, 16), *range(24, 32)]))
    assert tilt < 1e-6, note
    assert "viewing direction" in note


@pytest.mark.parametrize(
    "cameras",
    [
        nadir_cameras([(10.0 * x, 0.0, 60.0) for x in range(8)]),
        nadir_cameras([(10.0 * x, 0.0, 60.0) for x in range(2)]),
        nadir_cameras([(10.0 * x, 15.0 * y, 60.0 + 12 * x) for y in range(4) for x in range(8)]),
        [roll_camera(c, 77.0 * k) for k, c in enumerate(rig("orbit", 24, Site(100.0, 0.0, 20.0), K))],
    ],
    ids=["along a line", "too few", "climbing strips", "random rolls"],
)
def test_an_undetermined_up_direction_is_reported(cameras):
    tilt, note = tilt_after_levelling(cameras)
    assert tilt is None
    check_text(note)


def test_level_models_stay_and_upside_down_ones_are_turned():
    cameras = rig("circles", 30, SITE, K)
    leveling, _ = leveling_rotation({camera.name: camera for camera in cameras})
    np.testing.assert_allclose(leveling.rotation, np.eye(3), atol=1e-7)
    upside_down = rotation_about(180, 0)
    leveling, _ = leveling_rotation({camera.name: transform_camera(camera, upside_down) for camera in cameras})
    np.testing.assert_allclose(leveling.rotation @ upside_down.rotation[:, 2], [0, 0, 1], atol=1e-7)


def test_levelling_is_reproducible_bit_for_bit():
    cameras = {camera.name: transform_camera(camera, random_frame(9)) for camera in rig("drone", 60, SITE, K)}
    first, second = leveling_rotation(cameras)[0], leveling_rotation(cameras)[0]
    assert first.rotation.tobytes() == second.rotation.tobytes()
