"""Files of a photographed city: images, three camera formats, the true surface; and the command."""

import hashlib
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from optional import import_or_skip
from wording import check_error

from pcbench import read_cloud
from pcbench.geometry.cameras import Intrinsics
from pcbench.geometry.mesh import MeshIndex
from pcbench.io.meshes import read_mesh
from pcbench.scenes.synthetic.files import SceneSettings, write_scene
from pcbench.scenes.synthetic.layout import lay_out
from pcbench.scenes.synthetic.plan import CitySettings
from pcbench.scenes.synthetic.rigs import Site, rig

SMALL_CITY = CitySettings(extent=120.0, seed=3)
DISTORTION = (-0.08, 0.01, 0.002, -0.001)

SETTINGS = SceneSettings(
    SMALL_CITY, 5, replace(Intrinsics.from_fov(160, 90, 50.0), distortion=DISTORTION), points=6000, gps=0.3
)


def file_hashes(folder):
    return {
        str(p.relative_to(folder)): hashlib.sha256(p.read_bytes()).hexdigest()
        for p in sorted(folder.rglob("*"))
        if p.is_file()
    }


@pytest.fixture(scope="module")
def scene(renderer, tmp_path_factory):
    folder = tmp_path_factory.mktemp("scene") / "city"
    write_scene(folder, SETTINGS)
    return folder


def test_scene_files(scene):
    stems = [f"{n:04d}" for n in range(1, 6)]
    files = {"transforms.json", "gps.txt", "truth/mesh.ply", "truth/cloud.ply"}
    files |= {f"sparse/0/{name}.txt" for name in ("cameras", "images", "points3D")}
    files |= {f"images/{s}.png" for s in stems} | {f"truth/depth/{s}.npy" for s in stems}
    assert file_hashes(scene).keys() == files
    assert [p.name for p in scene.parent.iterdir()] == ["city"]


def test_three_camera_formats_agree(scene):
    pycolmap = import_or_skip("pycolmap")
    values = json.loads((scene / "transforms.json").read_text())
    assert [f["file_path"] for f in values["frames"]] == [f"images/{n:04d}.png" for n in range(1, 6)]
    model = pycolmap.Reconstruction(scene / "sparse/0")
    assert model.num_points3D() == 0
    model_camera = model.cameras[1]
    assert model_camera.model.name == "OPENCV"
    names = ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2")
    np.testing.assert_array_equal(model_camera.params, [values[name] for name in names])
    by_name = {image.name: image for image in model.images.values()}
    points = np.random.default_rng(0).uniform(-20, 20, (50, 3))
    true_cameras = rig("circles", 5, Site(120.0, *_heights(scene)), SETTINGS.intrinsics)
    for frame, camera in zip(values["frames"], true_cameras, strict=True):
        pose = np.array(frame["transform_matrix"])
        pose[:3, 1:3] *= -1
        cam_from_world = np.linalg.inv(pose)
        image = by_name[Path(frame["file_path"]).name]
        np.testing.assert_allclose(image.cam_from_world().matrix(), cam_from_world[:3], atol=1e-9)
        np.testing.assert_allclose(camera.cam_from_world.matrix, cam_from_world, atol=1e-9)
        projected = np.array(
            [model_camera.img_from_cam(p) for p in (points @ cam_from_world[:3, :3].T + cam_from_world[:3, 3])]
        )
        np.testing.assert_allclose(camera.project(points)[0], projected, atol=1e-6)


def _heights(scene):
    plan = lay_out(SMALL_CITY)
    return float(np.median(plan.terrain.heights)), plan.top


def test_true_cloud_is_on_the_exposed_surface(scene):
    cloud, mesh = read_cloud(scene / "truth/cloud.ply"), read_mesh(scene / "truth/mesh.ply")
    assert len(cloud) == 6000
    matches = MeshIndex(mesh).query(cloud.points)
    assert matches.distances.max() < 1e-12 * 120
    agreement = np.einsum("ni,ni->n", cloud.normals, mesh.normals()[matches.faces])
    assert np.mean(agreement > 1 - 1e-6) > 0.999  # float32 normals; a point on an edge belongs to two faces
    plan = lay_out(SMALL_CITY)
    for solid in plan.solids:
        x, y = np.abs(solid.local(cloud.points)).T
        is_inside = (x < 0.49 * solid.width) & (y < 0.49 * solid.depth) & (cloud.points[:, 2] < solid.eaves - 0.01)
        assert not is_inside.any()
    visible = cloud.attributes["visible"]
    assert set(np.unique(visible)) == {0, 1}


def test_depth_files_match_the_images(scene):
    depth = np.load(scene / "truth/depth/0005.npy")
    assert depth.dtype == np.float32
    assert depth.shape == (90, 160)
    mesh = read_mesh(scene / "truth/mesh.ply")
    values = json.loads((scene / "transforms.json").read_text())
    pose = np.array(values["frames"][4]["transform_matrix"])
    v, u = np.nonzero(depth)
    rays = SETTINGS.intrinsics.directions(np.stack([u, v], axis=1) + 0.5) * depth[v, u][:, None]
    points = (rays * [1, -1, -1]) @ pose[:3, :3].T + pose[:3, 3]
    assert MeshIndex(mesh).query(points).distances.max() < 3e-5  # float32 at 200 m


def test_scene_is_written_to_new_folders_only(scene, tmp_path):
    with check_error():
        write_scene(scene, SETTINGS)
    (tmp_path / "file").write_text("x")
    with check_error():
        write_scene(tmp_path / "file", SETTINGS)
    with check_error():
        write_scene(tmp_path / "no/where", SETTINGS)
    with check_error():
        write_scene(
            tmp_path / "new", replace(SETTINGS, intrinsics=replace(SETTINGS.intrinsics, distortion=(-3.0, 0, 0, 0)))
        )
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


# ---- the command ----

TINY_OPTIONS = "--images 2 --size 80x50 --extent 100 --points 1000 -q"


@pytest.mark.long
def test_the_command_gives_the_same_bytes(run, scene, tmp_path):
    options = [
        "--images",
        "5",
        "--size",
        "160x90",
        "--fov",
        "50",
        "--gps",
        "0.3",
        "--extent",
        "120",
        "--seed",
        "3",
        "--points",
        "6000",
        "-q",
    ]
    distortion = f"--distortion={','.join(map(str, DISTORTION))}"
    assert run("synth", "city", "--out", tmp_path / "city", distortion, *options) == (0, "", "")
    assert file_hashes(tmp_path / "city") == file_hashes(scene)


def test_the_command_passes_its_settings_on(run, tmp_path, monkeypatch):
    calls = []
    monkeypatch.setattr("pcbench.scenes.synthetic.files.write_scene", lambda *arguments: calls.append(arguments))
    run("synth", "city", "--out", tmp_path / "city", *TINY_OPTIONS.split(), "--hard", "--rig", "orbit", "--vignetting")
    ((_, settings, _),) = calls
    assert settings.city == CitySettings(extent=100.0).hard()
    assert (settings.images, settings.rig, settings.gps, settings.points) == (2, "orbit", None, 1000)
    assert settings.optics.vignetting == 1


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("--size 80", "WIDTHxHEIGHT"),
        ("--size ax9", "--size"),
        ("--size 0x9", "at least one pixel"),
        ("--size 20000x20000", "at most 8192"),
        ("--rig spiral", "choose one of circles"),
        ("--distortion 1,2", "four numbers"),
        ("--distortion=-5,0,0,0", "folds the image over"),
        ("--extent 5", "100 to 2000"),
        ("--texture 2", "from 0 to 1"),
        ("--images 0", "--images"),
        ("--out .", "expected an empty folder"),
    ],
)
def test_invalid_options_give_a_one_line_error(run, renderer, tmp_path, monkeypatch, options, message):
    monkeypatch.chdir(tmp_path)
    Path("mine").write_text("x")
    code, out, err = run("synth", "city", "--out", "new", *TINY_OPTIONS.split(), *options.split())
    assert code == 2
    assert not out
    assert err.startswith("error: ")
    assert err.count("\n") == 1
    assert message in err
    assert [p.name for p in tmp_path.iterdir()] == ["mine"]


def test_without_opengl_nothing_is_written(run, tmp_path, monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.setattr("pcbench.opengl._LIBRARIES", ("libNoSuchGL.so",))
    code, _, err = run("synth", "city", "--out", tmp_path / "city", *TINY_OPTIONS.split())
    assert code == 2
    assert "libegl1" in err
    assert not list(tmp_path.iterdir())
