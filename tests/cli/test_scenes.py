"""`pcbench scene`; tests/scenes tests the output of `synth`."""

import json
from pathlib import Path

import numpy as np
import pytest
from command_line import is_one_line
from optional import import_or_skip
from wording import check_text

from pcbench import read_cloud


def test_scene_lists_its_files_and_converts_cameras(tmp_path, monkeypatch, run):
    from pcbench.geometry.cameras import Camera, Intrinsics, look_at
    from pcbench.io.colmap_model import write_colmap_model

    image = import_or_skip("PIL.Image")
    monkeypatch.chdir(tmp_path)
    Path("photos/images").mkdir(parents=True)
    cameras = []
    for number in range(3):
        image.new("RGB", (40, 30)).save(f"photos/images/{number}.png")
        cameras.append(Camera(f"{number}.png", Intrinsics(40, 30, 35, 35, 20, 15), look_at([number, 0, 5], [1, 1, 0])))
    write_colmap_model(Path("photos/sparse"), cameras)
    code, out, err = run("scene", "photos", "--write-cameras", "photos/transforms.json", "--figure", "cameras.png")
    assert (code, err) == (0, "")
    check_text(out)
    for value in ("3 images", "40 x 30", "cameras 3", "GPS 0", "masks 0"):
        assert value in out
    assert Path("cameras.png").stat().st_size
    assert run("scene", "photos", "--figure", "cameras.png")[0] == 0  # its own picture may be replaced
    code, out, err = run("scene", "photos", "--cameras", "photos/transforms.json", "--image-scale", "0.5")
    assert (code, err) == (0, "")
    assert "20 x 15" in out
    before = Path("photos/images/1.png").read_bytes()
    code, out, err = run("scene", "photos", "--figure", "photos/images/1.png")
    assert code == 2
    assert is_one_line(err)
    check_text(err)
    assert Path("photos/images/1.png").read_bytes() == before
    for arguments in (("nowhere",), ("photos", "--image-scale", "2")):
        code, out, err = run("scene", *arguments, "--figure", "other.png")
        assert (code, out) == (2, "")
        assert is_one_line(err)
    assert not Path("other.png").exists()


@pytest.mark.long
def test_earth_studio_gives_metres_of_wgs84(tmp_path, monkeypatch, run):
    """Four cameras are a kilometre apart; on a sphere the distance is 0.26 % less eastwards, 0.11 % more northwards."""
    image = import_or_skip("PIL.Image")
    monkeypatch.chdir(tmp_path)
    Path("photos").mkdir()
    frames = []
    for number, (latitude, longitude) in enumerate([(41.8, 12.2), (41.81, 12.2), (41.8, 12.21), (41.81, 12.21)]):
        image.new("RGB", (64, 36)).save(f"photos/{number}.png")
        a, b = np.radians([latitude, longitude])
        position = (6_371_010 + 500) * np.array([np.cos(a) * np.cos(b), np.cos(a) * np.sin(b), np.sin(a)])
        frame = {"coordinate": {"latitude": latitude, "longitude": longitude, "altitude": 500}, "fovVertical": 40}
        frame |= {key: dict(zip("xyz", v, strict=True)) for key, v in (("position", position), ("rotation", (0, 0, 0)))}
        frames.append(frame)
    document = {"width": 64, "height": 36, "numFrames": 3, "cameraFrames": frames, "trackPoints": []}
    Path("photos/export.json").write_text(json.dumps(document))
    Path("mine.py").write_text(
        "from dataclasses import dataclass\n"
        "import numpy as np\n"
        "from pcbench import Cloud\n"
        "from pcbench.plugins import Reconstruction\n"
        "@dataclass(frozen=True)\n"
        "class Mine:\n"
        "    gauge: str = 'georeferenced'\n"
        "    def reconstruct(self, scene, workspace):\n"
        "        points = np.stack([camera.position for camera in scene.cameras.values()])\n"
        "        return Reconstruction(Cloud(points), self.gauge, scene.cameras, origin=scene.origin)\n"
    )
    code, out, err = run("scene", "photos", "--write-cameras", "sphere.json")
    assert code == 0
    assert "-0.26 %" in check_text(err)
    code, out, err = run("scene", "photos", "--wgs84", "--write-cameras", "wgs84.json")
    assert (code, err) == (0, "")
    check_text(out)
    sphere, wgs84 = (
        np.array([frame["transform_matrix"] for frame in json.loads(Path(name).read_text())["frames"]])[:, :3, 3]
        for name in ("sphere.json", "wgs84.json")
    )
    np.testing.assert_allclose(sphere[2, 0] / wgs84[2, 0], 0.9974, atol=1e-4)
    np.testing.assert_allclose(sphere[1, 1] / wgs84[1, 1], 1.0011, atol=1e-4)
    arguments = ("reconstruct", "mine.py:Mine", "photos", "-o", "cloud.ply", "--wgs84", "--write-cameras", "made.json")
    code, out, err = run(*arguments)
    assert (code, err) == (0, "")
    np.testing.assert_allclose(read_cloud("cloud.ply").points, wgs84, atol=1e-3)
    matrices = np.array([frame["transform_matrix"] for frame in json.loads(Path("made.json").read_text())["frames"]])
    np.testing.assert_allclose(matrices[:, :3, 3], wgs84, atol=1e-6)
    code, out, err = run(*arguments, "--set", "gauge=arbitrary")
    assert code == 0
    check_text(err)
    with_crs = (*arguments[:5], "--crs", "EPSG:32632", "--write-cameras", "made.json")  # implies metres of WGS 84
    code, out, err = run(*with_crs)
    assert code == 0, err
    check_text(err)
    cloud = read_cloud("cloud.ply")
    assert (cloud.crs, cloud.unit) == ("EPSG:32632", "m")
    matrices = np.array([frame["transform_matrix"] for frame in json.loads(Path("made.json").read_text())["frames"]])
    np.testing.assert_allclose(matrices[:, :3, 3], cloud.points, atol=1e-3)
    code, out, err = run(*with_crs, "--set", "gauge=arbitrary")
    assert code == 2
    check_text(err)
    for command in (("scene", "photos"), arguments):
        code, out, err = run(*command, "--wgs84", "--cameras", "none")
        assert (code, out) == (2, "")
        assert is_one_line(err)
        check_text(err)
