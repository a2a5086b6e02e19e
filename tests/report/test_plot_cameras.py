"""The picture of a scene's cameras."""

from dataclasses import replace

import numpy as np
import pytest
from optional import import_or_skip
from scene_folders import NAMES, K, orbit, ten_images_folder
from wording import check_error, check_text

from pcbench import Cloud
from pcbench.geometry.cameras import Camera, look_at
from pcbench.geometry.geodesy import Gps
from pcbench.geometry.transform import Similarity
from pcbench.io.colmap_model import write_colmap_model
from pcbench.report.viewing import ViewingCameras
from pcbench.scenes import read_scene


@pytest.mark.parametrize("count", [1, 2, 10])
def test_the_camera_plot_is_drawn(tmp_path, count):
    photographs = ten_images_folder(tmp_path)
    matplotlib_image = import_or_skip("matplotlib.image")
    from pcbench.report.plot.cameras import draw_cameras

    write_colmap_model(photographs / "sparse/0", orbit(NAMES), Cloud(np.random.default_rng(0).normal(size=(500, 3))))
    draw_cameras(read_scene(photographs).select(NAMES[:count]), photographs / "cameras.png")
    image = matplotlib_image.imread(photographs / "cameras.png")
    assert image.shape == (768, 1680, 4)
    blue = (np.abs(image[..., :3] - [0, 0x72 / 255, 0xB2 / 255]).max(axis=2) < 0.1).sum()
    assert blue > 100  # both panels have cameras in their colour
    with check_error():
        draw_cameras(read_scene(photographs, cameras="none"), photographs / "none.png")
    assert not (photographs / "none.png").exists()


def test_gps_positions_are_drawn_where_there_are_no_cameras(tmp_path):
    photographs = ten_images_folder(tmp_path)
    matplotlib_image = import_or_skip("matplotlib.image")
    from pcbench.report.plot.cameras import _gps_positions, draw_cameras

    lines = [f"{name} {10 * n} {5 * (n % 2)} 80\n" for n, name in enumerate(NAMES[:7])]
    (photographs / "gps.txt").write_text("".join(lines))
    scene = read_scene(photographs)
    draw_cameras(scene, tmp_path / "gps.png")
    image = matplotlib_image.imread(tmp_path / "gps.png")
    assert (np.abs(image[..., :3] - [0, 0x72 / 255, 0xB2 / 255]).max(axis=2) < 0.1).sum() > 100
    check_text(_gps_positions(scene).title, masked=False)
    gps = {name: Gps(48 + 1e-4 * n, 11.0, 500.0) for n, name in enumerate(NAMES)}
    gps_plot = _gps_positions(replace(scene, positions={}, gps=gps))
    assert gps_plot.axes == ("east", "north", "up")
    np.testing.assert_allclose(gps_plot.positions[9] - gps_plot.positions[0], [0, 100.1, 0], atol=0.1)


def flight(turn_deg, tilt_deg=3.0, size=(6, 5)):
    """Return cameras of a survey in strips, turned by `turn_deg` after each, in an arbitrary gauge, and up in it."""
    rng = np.random.default_rng(5)
    gauge, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    gauge *= np.sign(np.linalg.det(gauge))
    if (gauge @ [0, 0, 1])[2] > 0:  # not upright by chance
        gauge = np.diag([1, -1, -1]) @ gauge
    cameras = []
    for n in range(size[0] * size[1]):
        strip, column = divmod(n, size[0])
        yaw, tilt = np.radians(turn_deg * strip), np.tan(np.radians(rng.normal(0, tilt_deg, 2)))
        eye = np.array([20.0 * column, 25.0 * strip, 100 + rng.normal()])
        pose = look_at(eye, eye + [*tilt, -1], up=[np.sin(yaw), np.cos(yaw), 0])
        rotation = pose.rotation @ gauge.T
        cameras.append(Camera(f"{n}.png", K, Similarity(rotation, -rotation @ (gauge @ eye))))
    return cameras, gauge @ [0, 0, 1]


@pytest.mark.parametrize("turn_deg", [0, 180, 90])
def test_a_survey_in_an_arbitrary_gauge_is_shown_from_above(turn_deg):
    cameras, up = flight(turn_deg)
    viewing = ViewingCameras.of(cameras)
    rotation = viewing.upright_rotation()
    assert not viewing.is_upright
    assert (rotation @ up)[2] > 0.99
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)


def test_a_walk_along_a_wall_stays_upright():
    """All images look in the same direction from positions on a line: their upper sides define up."""
    gauge = look_at([1, 2, 3], [0, 0, 0]).rotation
    cameras = []
    for n in range(12):
        pose = look_at([n, 0.2 * np.sin(n), 1.6 + 0.1 * (n % 3)], [n, 10, 1.6])
        rotation = pose.rotation @ gauge.T
        cameras.append(Camera(f"{n}.png", K, Similarity(rotation, pose.translation)))
    viewing = ViewingCameras.of(cameras)
    assert not viewing.is_upright
    assert (viewing.upright_rotation() @ gauge @ [0, 0, 1])[2] > 0.99


def test_rings_are_separated_and_closed():
    from pcbench.report.plot.cameras import rings_of

    angles = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    circle = np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)
    rings = rings_of(np.concatenate([500 * circle, 1500 * circle + [0, 0, 300], 2500 * circle]))
    assert [len(ring) for ring in rings] == [13, 13, 13]
    for ring in rings:
        np.testing.assert_array_equal(ring[0], ring[-1])
    assert [len(ring) for ring in rings_of(np.arange(15.0).reshape(5, 3))] == [5]
    walk = np.random.default_rng(0).normal(size=(40, 3)).cumsum(axis=0)
    assert [len(ring) for ring in rings_of(walk)] == [40]
    assert not rings_of(np.zeros((1, 3)))
