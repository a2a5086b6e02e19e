"""`pcbench experiment gao`: clouds, cameras and evaluations, and the complete experiment on a small city."""

import subprocess
import sys
import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from command_line import is_one_line
from optional import import_or_skip
from scene_folders import orbit, ten_images_folder
from wording import check_error, check_text

from pcbench import Cloud, read_cloud, write_cloud
from pcbench.geometry.cameras import Camera, Intrinsics, look_at
from pcbench.geometry.transform import Similarity, fit_similarity
from pcbench.io.colmap_model import write_colmap_model
from pcbench.scenes import read_scene
from pcbench.scenes.synthetic import city
from pcbench.scenes.synthetic.rigs import Site, rig
from pcbench.scenes.synthetic.warp import make_warp, similarity_from_angles
from pcbench.studies.gao import clouds, gao
from pcbench.studies.gao.cameras import camera_deformation, camera_errors, cameras_in_cloud_frame, retriangulate
from pcbench.studies.gao.evaluation import evaluate_against, visible_truth
from pcbench.studies.gao.gao import run_gao
from pcbench.studies.gao.plan import MEANS, MVS, SPARSE, SURFACE, GaoJob, default_region, focus_point, methods
from pcbench.studies.gao.results import (
    TRUTH,
    read_study,
)
from reconstructors.sfm.alignment import transform_camera

K = Intrinsics.from_fov(320, 180, 40.0)


def points_of(path):
    return read_cloud(path).points


def test_default_region_is_centred_on_the_focus():
    cameras = rig("circles", 14, Site(100.0, 2.0, 30.0), K)
    np.testing.assert_allclose(focus_point(cameras), [0, 0, 16], atol=1e-9)
    x, y, z, radius = map(float, default_region(cameras).removeprefix("sphere:").split(","))
    assert (x, y, z) == (0, 0, 16)
    farthest = max(np.linalg.norm(camera.position - [0, 0, 16]) for camera in cameras)
    assert radius == pytest.approx(0.4 * farthest, abs=1e-3)
    down = [Camera(f"{k}.png", K, look_at([10.0 * k, 0, 50], [10.0 * k, 0, 0], up=[0, 1, 0])) for k in range(4)]
    assert focus_point(down) is None
    assert default_region(down) == "quantile:0.5"
    outward = [Camera(c.name, K, look_at(c.position, 2 * c.position)) for c in orbit([f"{k}.png" for k in range(6)])]
    assert focus_point(outward) is None


def cameras_with(move):
    true = {camera.name: camera for camera in rig("circles", 28, Site(100.0, 0.0, 20.0), K)}
    return {name: move(camera) for name, camera in true.items()}, true


def test_deformation_by_solved_cameras():
    points = city(0).sample(4000, np.random.default_rng(0))[0]
    surface = Cloud(points[np.linalg.norm(points, axis=1) < 40])
    motion = Similarity(similarity_from_angles((3, 5, 20), (1, 2, 3), 1.0).rotation, np.array([3.0, -2.0, 1.0]), 1.03)
    solved, true = cameras_with(lambda camera: transform_camera(camera, motion))
    placed, known = retriangulate(solved, true, surface.points)
    assert known.mean() > 0.9
    np.testing.assert_allclose(placed[known], motion.apply(surface.points[known]), atol=1e-8)
    small = Similarity(np.eye(3), np.array([0.3, 0.2, -0.1]), 1.01)
    scaled = camera_deformation(*cameras_with(lambda camera: transform_camera(camera, small)), surface)
    assert scaled.bent < 1e-9  # a scale is affine, but not rigid
    assert scaled.moved == pytest.approx(0.01 * np.std(surface.points[known] - surface.points[known].mean(0)), rel=0.05)

    # A focal length that is too long, checked by two other fits: Kabsch, and one affine map per axis.
    longer = replace(K, fx=1.02 * K.fx, fy=1.02 * K.fy, distortion=(0.02, 0.0, 0.0, 0.0))
    wrong, true = cameras_with(lambda camera: replace(camera, intrinsics=longer))
    found = camera_deformation(wrong, true, surface)
    placed, known = retriangulate(wrong, true, surface.points)
    before, after = surface.points[known], placed[known]
    rigid = fit_similarity(before, after, with_scale=False).apply(before) - after
    assert found.moved == pytest.approx(np.sqrt(np.mean(rigid**2)), rel=0.01)
    columns = np.column_stack([before, np.ones(len(before))])
    rest = after - columns @ np.linalg.lstsq(columns, after, rcond=None)[0]
    assert found.bent == pytest.approx(np.sqrt(np.mean(rest**2)), rel=1e-6)
    assert 0.01 < found.bent < found.moved
    up = Cloud(surface.points, normals=np.tile([0.0, 0.0, 1.0], (len(surface), 1)))
    assert camera_deformation(wrong, true, up).bent == pytest.approx(np.sqrt(np.mean(rest[:, 2] ** 2)), rel=1e-6)

    # The profile by hand: eight rings with equal numbers of points.
    far = np.hypot(*(before - before.mean(axis=0))[:, :2].T)
    order = np.argsort(far)
    at, mean = np.array(found.with_distance).T
    np.testing.assert_allclose(at, [far[rows].mean() for rows in np.array_split(order, 8)])
    np.testing.assert_allclose(
        mean, [-rigid[rows, 2].mean() for rows in np.array_split(order, 8)], atol=0.05 * found.moved
    )
    assert len(found.with_height) == 8
    errors = camera_errors(wrong, true, surface)
    assert (errors.solved, errors.given, errors.median, errors.surface) == (28, 28, pytest.approx(0, abs=1e-9), found)
    assert errors.astray == 0
    # An outlier camera is counted and does not deform the surface.
    name = next(iter(wrong))
    lost = {**wrong, name: transform_camera(wrong[name], Similarity(np.eye(3), np.array([200.0, 0, 0])))}
    jittered = {
        k: transform_camera(c, Similarity(np.eye(3), np.array([0.001 * (n % 3), 0, 0])))
        for n, (k, c) in enumerate(lost.items())
    }
    errors = camera_errors(jittered, true, surface)
    assert (errors.astray, errors.largest) == (1, pytest.approx(200, abs=0.1))
    assert errors.surface.bent == pytest.approx(found.bent, rel=0.1)
    assert cameras_in_cloud_frame(lost, true) is true
    assert cameras_in_cloud_frame({}, true) is true
    far = {name: transform_camera(camera, Similarity(np.eye(3), np.zeros(3), 0.01)) for name, camera in true.items()}
    assert cameras_in_cloud_frame(far, true) is far
    errors = camera_errors(wrong, true, surface)
    assert errors.focal_ratio == pytest.approx(1.02)
    assert camera_errors(wrong, true, None).surface is None
    assert camera_errors(dict(list(wrong.items())[:2]), true, surface) is None


def test_clouds_are_evaluated_once(tmp_path):
    """The deformed cloud is detected, the tiny one fails, and nothing is evaluated twice."""
    rng = np.random.default_rng(0)

    def sample(count, bend=0.0):
        points, _ = city(0).sample(count, rng)
        points = points + rng.normal(0, 0.03, points.shape)
        return make_warp("dome", points, bend).apply(points) if bend else points

    for name, points in {
        "reference": sample(20_000),
        "straight": sample(6000),
        "bent": sample(6000, 0.5),
        "nowhere": rng.normal(size=(5, 3)),
    }.items():
        write_cloud(tmp_path / f"{name}.ply", Cloud(points, unit="m"))
    clouds = {name: tmp_path / f"{name}.ply" for name in ("straight", "bent", "nowhere")}
    region = "sphere:0,0,0,150"
    found = evaluate_against(tmp_path / "reference.ply", TRUTH, clouds, region, tmp_path, 0)
    inside = np.linalg.norm(points_of(tmp_path / "reference.ply"), axis=1) <= 150
    assert found.counts == (20_000, inside.sum())
    straight, bent = found.clouds["straight"], found.clouds["bent"]
    assert (straight.deformation.verdict, bent.deformation.verdict) == ("none", "non-affine")
    assert straight.measures.d2_poisson_mse is None
    assert straight.measures.d2_mse < bent.measures.d2_mse
    assert 0 < straight.r2c_mse < straight.measures.chamfer
    assert "expected" in found.clouds["nowhere"].failure
    stamp = (found.folder / "comparison.json").stat().st_mtime_ns
    again = evaluate_against(tmp_path / "reference.ply", TRUTH, clouds, region, tmp_path, 0)
    assert again == found
    assert (again.folder / "comparison.json").stat().st_mtime_ns == stamp
    # Other inputs are evaluated again.
    nowhere = evaluate_against(tmp_path / "reference.ply", TRUTH, {"nowhere": clouds["nowhere"]}, region, tmp_path, 0)
    assert (nowhere.folder, nowhere.counts) == (None, None)
    assert "expected" in nowhere.clouds["nowhere"].failure
    outside = evaluate_against(
        tmp_path / "reference.ply", TRUTH, {"bent": clouds["bent"]}, "sphere:900,0,0,1", tmp_path, 0
    )
    assert "6,000 points" in check_text(outside.clouds["bent"].failure)


def test_truth_is_limited_to_visible_points(tmp_path):
    points = np.arange(30.0).reshape(10, 3)
    write_cloud(tmp_path / "cloud.ply", Cloud(points, attributes={"visible": (np.arange(10) < 4).astype(np.uint8)}))
    assert len(points_of(visible_truth(tmp_path / "cloud.ply", tmp_path))) == 4
    write_cloud(tmp_path / "cloud.ply", Cloud(points))
    assert len(points_of(visible_truth(tmp_path / "cloud.ply", tmp_path))) == 10


def test_settings_of_the_clouds():
    plan = {method.name: method for method in methods(GaoJob(settings={"steps": "7", "density": "gao2025"}))}
    assert plan[SPARSE].settings["poses"] == "solve"
    assert plan[MVS].settings["poses"] == "given"
    means, surface = plan[MEANS], plan[SURFACE]
    assert means.workspace == surface.workspace
    assert {k for k in means.settings if means.settings[k] != surface.settings[k]} == {"cloud"}
    assert (means.settings["start"], means.settings["steps"], means.settings["density"]) == ("sfm", "7", "gao2025")


def test_unusable_input_is_rejected(run, tmp_path):
    import_or_skip("pycolmap")
    import_or_skip("torch")
    bare = ten_images_folder(tmp_path / "bare")
    few = ten_images_folder(tmp_path / "few")
    for k in range(8, 10):
        (few / f"images/{k}.png").unlink()
    write_colmap_model(few / "sparse/0", orbit([f"{k}.png" for k in range(8)]))
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/notes.txt").write_text("mine")
    for arguments in (
        (bare, "--poses", "given"),
        (few,),
        (bare, "--images", "20"),
        ("--image-scale", "0.5"),
        ("--set", "cloud=means"),
        ("--set", "hold_out=none"),
        ("--set", "foo=1"),
        ("--set", "steps=0"),
        ("--crop", "blah"),
    ):
        code, _, err = run("experiment", "gao", *arguments, "--out", tmp_path / "out")
        assert code == 2
        check_text(err.partition(" (see ")[0])  # the rest depends on how pytest was started
        assert is_one_line(err)
        assert not (tmp_path / "out").exists()
    code, _, err = run("experiment", "gao", "--out", tmp_path / "mine")
    assert code == 2
    check_text(err)


def test_photographs_need_no_cameras_if_poses_are_solved(tmp_path, monkeypatch):
    scene = ten_images_folder(tmp_path / "bare")
    calls = []
    monkeypatch.setattr(gao, "find_plugin", lambda _: SimpleNamespace(missing=None, configure=lambda _: None))
    monkeypatch.setattr(gao, "_run", lambda job, given, *_: calls.append(given))
    run_gao(GaoJob((scene,)), tmp_path / "out")
    assert [len(found.cameras) for found in calls[0].values()] == [0]
    with check_error():
        run_gao(GaoJob((scene,), poses="given"), tmp_path / "other")
    assert not (tmp_path / "other").exists()


def test_empty_crop_is_rejected_before_any_work(tmp_path, monkeypatch):
    scene = ten_images_folder(tmp_path / "scene")
    (scene / "truth").mkdir()
    write_cloud(scene / "truth/cloud.ply", Cloud(np.arange(30.0).reshape(10, 3)))
    monkeypatch.setattr(gao, "find_plugin", lambda _: SimpleNamespace(missing=None, configure=lambda _: None))
    with check_error():
        run_gao(GaoJob((scene,), crop="sphere:900,0,0,1"), tmp_path / "out")
    with check_error():
        run_gao(GaoJob((scene,), crop=""), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_crop_without_sparse_points_stops_early(tmp_path, monkeypatch):
    scene = read_scene(ten_images_folder(tmp_path / "scene"))
    methods_made = []

    def make(maker, method, before):
        methods_made.append(method.name)
        folder = tmp_path / method.name
        folder.mkdir()
        write_cloud(folder / "cloud.ply", Cloud(np.arange(30.0).reshape(10, 3)))
        return clouds.CloudRun(method, folder)

    monkeypatch.setattr(clouds._CloudMaker, "make", make)
    job = GaoJob((scene.folder,), crop="sphere:900,0,0,1")
    with check_error():
        clouds.make_clouds(job, scene, scene.folder, tmp_path, None, lambda _: None)
    assert methods_made == [SPARSE]


SMALL = ("--cities", "1", "--images", "28", "--size", "240x136", "--extent", "100", "--poses", "given")


@pytest.mark.slow
def test_a_small_experiment(run, renderer, tmp_path):
    """Killed once, then with a failing training: finished results stay, and failures are reported."""
    import_or_skip("pycolmap")
    import_or_skip("torch")
    import_or_skip("matplotlib")
    out = tmp_path / "gao"
    refusal = ("experiment", "gao", "--out", out, *SMALL, "--set", "memory=0.001")
    kill_when(["pcbench.cli", *map(str, refusal)], out / "city_1/runs/sparse/stage.json")
    first = (out / "city_1/runs/sparse/stage.json").stat().st_mtime_ns
    assert not (out / "experiment.json").exists()

    code, out_text, err = run(*refusal)
    assert code == 0, err
    assert "splat-means" in out_text
    assert "memory=0.001" in out_text
    found = read_study(out)
    assert [bool(cloud.failure) for cloud in found.scenes[0].clouds] == [False, False, True, True]
    assert found.scenes[0].views is None
    assert "mvs deviates from the truth by 0." in out_text  # the other clouds were measured

    code, out_text, err = run("experiment", "gao", "--out", out, *SMALL, "--set", "steps=1200")
    assert code == 0, err
    assert (out / "city_1/runs/sparse/stage.json").stat().st_mtime_ns == first
    (scene,) = read_study(out).scenes
    assert scene.references[TRUTH][1] > scene.references[MVS][1] / 100 > 0
    assert all(not cloud.failure for cloud in scene.clouds)
    sparse, mvs, means, surface = scene.clouds
    assert means.points > 1.2 * sparse.points  # splats were densified
    assert surface.seconds < means.seconds  # one training for both
    assert mvs.evaluation(TRUTH).r2c_rms < sparse.evaluation(TRUTH).r2c_rms
    assert (scene.views.train_views, scene.views.test_views) == (24, 4)
    for name in ("rings", "directions", "growth"):
        assert (out / f"figures/{name}.png").stat().st_size > 10_000
    for name in (SPARSE, MEANS, SURFACE):
        assert (out / f"city_1/against-mvs/figures/{name}_poisson_distance.png").stat().st_size > 10_000
    assert (out / "views/figures/city_1_splat.png").stat().st_size > 10_000
    written = {path: path.read_bytes() for path in (out / "experiment.csv", out / "gao.md")}
    assert run("experiment", "gao", "--out", out, *SMALL, "--set", "steps=1200")[:2] == (0, out_text)
    assert all(path.read_bytes() == text for path, text in written.items())


def kill_when(module, file, seconds=300.0):
    """Run `python -m MODULE ...` and kill it as soon as the file exists."""
    process = subprocess.Popen([sys.executable, "-m", *module], stdout=subprocess.DEVNULL)
    end = time.monotonic() + seconds
    while not file.exists():
        assert process.poll() is None, "it ended before it was killed"
        assert time.monotonic() < end
        time.sleep(0.05)
    process.kill()
    process.wait()
