"""Cameras of 3D Gaussian splatting and of Metashape."""

import json
import re
import warnings

import metashape_files
import numpy as np
import pytest
from scene_folders import NAMES, K, orbit
from wording import check_error, check_text

from pcbench.geometry.cameras import Intrinsics
from pcbench.geometry.geodesy import Gps, ecef_from_enu, gps_from_ecef
from pcbench.geometry.transform import Similarity
from pcbench.io.gaussian_cameras import read_gaussian_cameras
from pcbench.io.metashape import read_metashape
from pcbench.scenes import read_scene

CENTERED = Intrinsics(64, 48, 50, 51, 32, 24)
TURN = np.array([[0.36, 0.48, -0.8], [-0.8, 0.6, 0], [0.48, 0.64, 0.6]])


def gaussian_cameras(cameras):
    """Return what `camera_to_JSON` of Kerbl et al. writes: camera-to-world, names without extensions."""
    return [
        {
            "id": number,
            "img_name": camera.name.removesuffix(".png"),
            "width": camera.intrinsics.width,
            "height": camera.intrinsics.height,
            "position": camera.position.tolist(),
            "rotation": camera.cam_from_world.rotation.T.tolist(),
            "fy": camera.intrinsics.fy,
            "fx": camera.intrinsics.fx,
        }
        for number, camera in enumerate(cameras)
    ]


def check_scene(scene, expected, atol=1e-12):
    assert set(scene.cameras) == {camera.name for camera in expected}
    for camera in expected:
        read = scene.cameras[camera.name]
        np.testing.assert_allclose(read.cam_from_world.matrix, camera.cam_from_world.matrix, atol=atol)
        np.testing.assert_allclose(read.intrinsics.matrix, camera.intrinsics.matrix, rtol=1e-12)
        assert read.intrinsics.distortion == pytest.approx(camera.intrinsics.distortion)


def test_cameras_of_gaussian_splatting(photographs):
    cameras = orbit(NAMES, CENTERED)
    (photographs / "cameras.json").write_text(json.dumps(gaussian_cameras(cameras)))
    check_scene(read_scene(photographs), cameras)  # found in the folder


GOOD = gaussian_cameras(orbit(NAMES, CENTERED))[0]
WRONG = {
    "no list": {"a": 1},
    "empty": [],
    "numbers": [1, 2],
    "no position": [{key: value for key, value in GOOD.items() if key != "position"}],
    "two coordinates": [GOOD | {"position": [1, 2]}],
    "NaN": [GOOD | {"position": [1, 2, float("nan")]}],
    "a huge coordinate": [GOOD | {"position": [1.7e308, 1.7e308, 1.7e308]}],
    "words": [GOOD | {"fx": "a"}],
    "no rotation": [GOOD | {"rotation": [[1, 0, 0], [0, 2, 0], [0, 0, 1]]}],
    "no size": [GOOD | {"width": 0}],
    "huge": [GOOD | {"rotation": [[1e200, 1e200, 0], [1e200, -1e200, 0], [0, 0, 1]]}],
    "ragged": [GOOD | {"rotation": [[1, 0], [0, 2, 0]]}],
}


@pytest.mark.parametrize("name", WRONG)
def test_wrong_gaussian_cameras(tmp_path, name):
    (tmp_path / "cameras.json").write_text(json.dumps(WRONG[name]))
    with check_error():
        read_gaussian_cameras(tmp_path / "cameras.json")


@pytest.mark.parametrize("chunk", [metashape_files.IDENTITY, (TURN, np.array([10.0, -20, 3]), 2.5)])
def test_cameras_of_metashape(photographs, chunk):
    cameras = orbit(NAMES)
    text = metashape_files.export(cameras, chunk, unaligned=("lost", "also lost"))
    (photographs / "export.xml").write_text(text)
    notes = []
    check_scene(read_scene(photographs, on_warning=notes.append), cameras, atol=1e-12)
    check_text("\n".join(notes))


def read(folder, text):
    (folder / "a.xml").write_text(text)
    notes = []
    return read_metashape(folder / "a.xml", notes.append), notes


def test_huge_numbers_and_nested_chunks_are_refused_in_one_line(tmp_path):
    text, count = metashape_files.export(orbit(NAMES)), 20_000
    nested = f"{'<chunk>' * count}<camera><transform/></camera>{'</chunk>' * count}"
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for damaged in (
            re.sub("<rotation>[^ ]+", "<rotation>1e300", text),
            re.sub("<scale>[^<]+", "<scale>1e308", text),
        ):
            with check_error():
                read(tmp_path, damaged)
        with check_error():
            read(tmp_path, f"<document>{nested}</document>")


def test_chunks_without_a_transform(tmp_path):
    text = metashape_files.export(orbit(NAMES), with_transform=False)
    cameras, notes = read(tmp_path, text)
    np.testing.assert_allclose(cameras[3].position, orbit(NAMES)[3].position, atol=1e-12)
    assert not notes


def test_geocentric_chunks_become_local(tmp_path):
    """Distances stay, up is up, and the origin is the mean of the cameras."""
    origin = Gps(47.5, 8.25, 432.0)
    local = orbit(NAMES)
    axes = np.linalg.inv(ecef_from_enu(np.eye(3), origin) - ecef_from_enu(np.zeros((1, 3)), origin))  # ECEF to ENU
    centers = ecef_from_enu(np.array([camera.position for camera in local]), origin)
    rotations = [camera.cam_from_world.rotation @ axes.T for camera in local]
    world = [
        type(camera)(camera.name, camera.intrinsics, Similarity(rotation, -rotation @ center))
        for camera, rotation, center in zip(local, rotations, centers, strict=True)
    ]
    cameras, notes = read(tmp_path, metashape_files.export(world))
    mean = np.mean([camera.position for camera in local], axis=0)
    for read_camera, camera in zip(cameras, local, strict=True):
        # 6e6 m have a last digit of 1e-9 m, and the local frames at the origin and the mean differ by 1e-6 rad.
        np.testing.assert_allclose(read_camera.position, camera.position - mean, atol=1e-5)
        np.testing.assert_allclose(read_camera.direction, camera.direction, atol=1e-6)
    check_text("\n".join(notes))


@pytest.mark.parametrize("gps", [Gps(47.5, 8.25, 432), Gps(-90, 0, 100), Gps(0, 180, -50), Gps(89.9999, -120, 8000)])
def test_geodetic_positions(gps):
    again = gps_from_ecef(ecef_from_enu(np.zeros((1, 3)), gps)[0])
    # Of 6.4e6 m in float64.
    assert (again.latitude_deg, again.altitude) == pytest.approx((gps.latitude_deg, gps.altitude), abs=1e-7)
    assert np.cos(np.radians(gps.latitude_deg)) * np.sin(
        np.radians(again.longitude_deg - gps.longitude_deg)
    ) == pytest.approx(0, abs=1e-12)


def test_a_lens_with_k3_is_exact(tmp_path):
    lens = {"k1": -0.06, "k2": 0.05, "p1": 1e-4, "p2": -2e-4, "k3": -0.02}
    camera = orbit(NAMES, Intrinsics(4000, 3000, 3000, 3000, 2010, 1495))[:1]
    (read_camera,), notes = read(tmp_path, metashape_files.export(camera, lens=lens))
    xy = np.random.default_rng(0).uniform(-0.6, 0.6, (50, 2))
    x, y = xy.T
    r2 = x * x + y * y
    radial = 1 + lens["k1"] * r2 + lens["k2"] * r2**2 + lens["k3"] * r2**3
    p1, p2 = lens["p1"], lens["p2"]  # Metashape manual, appendix C
    distorted = np.stack(
        [x * radial + p1 * (r2 + 2 * x * x) + 2 * p2 * x * y, y * radial + p2 * (r2 + 2 * y * y) + 2 * p1 * x * y], 1
    )
    np.testing.assert_allclose(read_camera.intrinsics.distort(xy), 3000 * distorted + [2010, 1495], atol=1e-9)
    assert not notes


def test_a_fisheye_lens(tmp_path):
    lens = {"k1": -0.01, "k2": 0.002, "k3": -1e-4, "k4": 1e-5}
    camera = orbit(NAMES, Intrinsics(1500, 1500, 900, 900, 750, 750))[:1]
    (read_camera,), _ = read(tmp_path, metashape_files.export(camera, lens=lens, sensor_type="fisheye"))
    angle = np.radians(70.0)
    radius = angle * (1 + sum(lens[f"k{n}"] * angle ** (2 * n) for n in (1, 2, 3, 4)))
    pixel = read_camera.intrinsics.distort(np.array([[np.tan(angle), 0.0]]))
    np.testing.assert_allclose(pixel, [[750 + 900 * radius, 750]], atol=1e-9)


def test_lenses_with_k4(tmp_path):
    """Rays through the image differ by the stated error at most."""
    lens = {"f": 3000.0, "cx": 10.0, "cy": -5.0, "b1": 0.0, "k1": -0.06, "k2": 0.05, "k3": -0.02, "k4": 0.06}
    camera = orbit(NAMES, Intrinsics(4000, 3000, 3000, 3000, 2010, 1495))[:1]
    (read_camera,), notes = read(tmp_path, metashape_files.export(camera, lens=lens))
    k = read_camera.intrinsics
    radii = np.linspace(0, 0.84, 100)  # up to the corner
    expected = lens["f"] * radii * (1 + sum(lens[f"k{n}"] * radii ** (2 * n) for n in (1, 2, 3, 4)))
    ours = k.distort(np.column_stack([radii, np.zeros(100)]))[:, 0] - k.cx
    stated = float(notes[0].rpartition("up to ")[2].removesuffix(" px"))
    assert 0.01 < np.abs(ours - expected).max() <= 1.05 * stated < 1  # two digits are stated
    check_text("\n".join(notes))


TEXT = metashape_files.export(orbit(NAMES))
WRONG_XML = {
    "no XML": "hello",
    "cut": TEXT[:-200],
    "entities": '<?xml version="1.0"?><!DOCTYPE a [<!ENTITY b "c">]><document><chunk/></document>',
    "not aligned": metashape_files.export(orbit(NAMES)[:1])
    .replace("<transform>1", "<other>1")
    .replace("transform", "t"),
    "no sensor": TEXT.replace('sensor id="0"', 'sensor id="7"'),
    "no calibration": TEXT.replace("calibration", "other"),
    "no resolution": TEXT.replace("resolution", "other"),
    "spherical": metashape_files.export(orbit(NAMES), sensor_type="spherical"),
    "fisheye": metashape_files.export(orbit(NAMES), lens={"p1": 0.1}, sensor_type="fisheye"),
    "skew": metashape_files.export(orbit(NAMES), lens={"b2": 1.0}),
    "p3": metashape_files.export(orbit(NAMES), lens={"p3": 0.1}),
    "strong k4": metashape_files.export(orbit(NAMES, Intrinsics(4000, 3000, 1500, 1500, 2000, 1500)), lens={"k4": 0.5}),
    "folded": metashape_files.export(orbit(NAMES), lens={"k3": -50.0}),
    "folded fisheye": metashape_files.export(orbit(NAMES), lens={"k1": -50.0}, sensor_type="fisheye"),
    "folded by k4": metashape_files.export(orbit(NAMES), lens={"k4": -50.0}),
    "no focal length": metashape_files.export(orbit(NAMES), lens={"f": 0.0}),
    "NaN": metashape_files.export(orbit(NAMES), lens={"k1": float("nan")}),
    "words": TEXT.replace("<k1>", "<k1>a"),
    "short matrix": TEXT.replace("</transform></camera>", " 1</transform></camera>", 1),
    "no rotation": metashape_files.export(orbit(NAMES), (np.diag([1.0, 2, 3]), np.zeros(3), 1.0)),
}


@pytest.mark.parametrize("name", WRONG_XML)
def test_wrong_exports_of_metashape(tmp_path, name):
    with check_error():
        read(tmp_path, WRONG_XML[name])


def test_several_chunks(tmp_path):
    chunk = TEXT[TEXT.index("<chunk") : TEXT.index("</document>")]
    cameras, notes = read(tmp_path, f"<document>{chunk}{chunk}</document>")
    assert len(cameras) == len(NAMES) and cameras[0].intrinsics == K
    check_text("\n".join(notes))
