"""`pcbench experiment gao`: clouds, cameras and evaluations, and the complete experiment on a small city."""

import subprocess
import sys
import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from command_line import is_one_line
from html_pages import check_page_of_study
from optional import import_or_skip
from scene_folders import orbit, ten_images_folder
from task_pools import tasks_in_process  # noqa: F401  # a fixture
from wording import check_error, check_text

from pcbench import Cloud, read_cloud, write_cloud
from pcbench.errors import ReconstructionError
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
from pcbench.studies.gao.plan import FIELD, MEANS, MVS, SPARSE, SURFACE, GaoJob, default_region, focus_point, methods
from pcbench.studies.gao.results import KIND, TRUTH, CloudResult
from pcbench.tasks import Workers
from reconstructors.sfm.alignment import transform_camera

K = Intrinsics.from_fov(320, 180, 40.0)


def read_points(path):
    return read_cloud(path).points


def test_default_region_is_centred_on_the_focus():
    cameras = rig("circles", 14, Site(100.0, 2.0, 30.0), K)
    np.testing.assert_allclose(focus_point(cameras), [0, 0, 16], atol=1e-9)
    x, y, z, radius = map(float, default_region(cameras).removeprefix("sphere:").split(","))
    assert (x, y, z) == (0, 0, 16)
    farthest = max(np.linalg.norm(camera.position - [0, 0, 16]) for camera in cameras)
    assert radius == pytest.approx(0.4 * farthest, abs=1e-3)
    nadir_cameras = [
        Camera(f"{k}.png", K, look_at([10.0 * k, 0, 50], [10.0 * k, 0, 0], up=[0, 1, 0])) for k in range(4)
    ]
    assert focus_point(nadir_cameras) is None
    assert default_region(nadir_cameras) == "quantile:0.5"
    outward_cameras = [
        Camera(c.name, K, look_at(c.position, 2 * c.position)) for c in orbit([f"{k}.png" for k in range(6)])
    ]
    assert focus_point(outward_cameras) is None


def transformed_cameras(move):
    true_cameras = {camera.name: camera for camera in rig("circles", 28, Site(100.0, 0.0, 20.0), K)}
    return {name: move(camera) for name, camera in true_cameras.items()}, true_cameras


def test_deformation_by_solved_cameras():
    points = city(0).sample(4000, np.random.default_rng(0))[0]
    surface = Cloud(points[np.linalg.norm(points, axis=1) < 40])
    motion = Similarity(similarity_from_angles((3, 5, 20), (1, 2, 3), 1.0).rotation, np.array([3.0, -2.0, 1.0]), 1.03)
    solved, true_cameras = transformed_cameras(lambda camera: transform_camera(camera, motion))
    triangulated, is_triangulated = retriangulate(solved, true_cameras, surface.points)
    assert is_triangulated.mean() > 0.9
    np.testing.assert_allclose(triangulated[is_triangulated], motion.apply(surface.points[is_triangulated]), atol=1e-8)
    small_motion = Similarity(np.eye(3), np.array([0.3, 0.2, -0.1]), 1.01)
    scale_deformation = camera_deformation(
        *transformed_cameras(lambda camera: transform_camera(camera, small_motion)), surface
    )
    assert scale_deformation.bent < 1e-9  # a scale is affine, but not rigid
    assert scale_deformation.moved == pytest.approx(
        0.01 * np.std(surface.points[is_triangulated] - surface.points[is_triangulated].mean(0)), rel=0.05
    )

    # A focal length that is too long, checked by two other fits: Kabsch, and one affine map per axis.
    wrong_intrinsics = replace(K, fx=1.02 * K.fx, fy=1.02 * K.fy, distortion=(0.02, 0.0, 0.0, 0.0))
    wrong_cameras, true_cameras = transformed_cameras(lambda camera: replace(camera, intrinsics=wrong_intrinsics))
    deformation = camera_deformation(wrong_cameras, true_cameras, surface)
    triangulated, is_triangulated = retriangulate(wrong_cameras, true_cameras, surface.points)
    true_points, moved_points = surface.points[is_triangulated], triangulated[is_triangulated]
    rigid_residuals = fit_similarity(true_points, moved_points, with_scale=False).apply(true_points) - moved_points
    assert deformation.moved == pytest.approx(np.sqrt(np.mean(rigid_residuals**2)), rel=0.01)
    columns = np.column_stack([true_points, np.ones(len(true_points))])
    affine_residuals = moved_points - columns @ np.linalg.lstsq(columns, moved_points, rcond=None)[0]
    assert deformation.bent == pytest.approx(np.sqrt(np.mean(affine_residuals**2)), rel=1e-6)
    assert 0.01 < deformation.bent < deformation.moved
    upward_surface = Cloud(surface.points, normals=np.tile([0.0, 0.0, 1.0], (len(surface), 1)))
    assert camera_deformation(wrong_cameras, true_cameras, upward_surface).bent == pytest.approx(
        np.sqrt(np.mean(affine_residuals[:, 2] ** 2)), rel=1e-6
    )

    # The profile by hand: eight rings with equal numbers of points.
    far = np.hypot(*(true_points - true_points.mean(axis=0))[:, :2].T)
    order = np.argsort(far)
    radii, mean_heights = np.array(deformation.with_distance).T
    np.testing.assert_allclose(radii, [far[rows].mean() for rows in np.array_split(order, 8)])
    np.testing.assert_allclose(
        mean_heights,
        [-rigid_residuals[rows, 2].mean() for rows in np.array_split(order, 8)],
        atol=0.05 * deformation.moved,
    )
    assert len(deformation.with_height) == 8
    errors = camera_errors(wrong_cameras, true_cameras, surface)
    assert (errors.solved, errors.given, errors.median, errors.surface) == (
        28,
        28,
        pytest.approx(0, abs=1e-9),
        deformation,
    )
    assert errors.astray == 0
    # An outlier camera is counted and does not deform the surface.
    name = next(iter(wrong_cameras))
    with_outlier = {
        **wrong_cameras,
        name: transform_camera(wrong_cameras[name], Similarity(np.eye(3), np.array([200.0, 0, 0]))),
    }
    jittered_cameras = {
        k: transform_camera(c, Similarity(np.eye(3), np.array([0.001 * (n % 3), 0, 0])))
        for n, (k, c) in enumerate(with_outlier.items())
    }
    errors = camera_errors(jittered_cameras, true_cameras, surface)
    assert (errors.astray, errors.largest) == (1, pytest.approx(200, abs=0.1))
    assert errors.surface.bent == pytest.approx(deformation.bent, rel=0.1)
    assert cameras_in_cloud_frame(with_outlier, true_cameras) is true_cameras
    assert cameras_in_cloud_frame({}, true_cameras) is true_cameras
    far = {
        name: transform_camera(camera, Similarity(np.eye(3), np.zeros(3), 0.01))
        for name, camera in true_cameras.items()
    }
    assert cameras_in_cloud_frame(far, true_cameras) is far
    errors = camera_errors(wrong_cameras, true_cameras, surface)
    assert errors.focal_ratio == pytest.approx(1.02)
    assert camera_errors(wrong_cameras, true_cameras, None).surface is None
    assert camera_errors(dict(list(wrong_cameras.items())[:2]), true_cameras, surface) is None


@pytest.mark.long
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
    evaluation = evaluate_against(tmp_path / "reference.ply", TRUTH, clouds, region, tmp_path, 0)
    in_region = np.linalg.norm(read_points(tmp_path / "reference.ply"), axis=1) <= 150
    assert evaluation.counts == (20_000, in_region.sum())
    straight_result, bent_result = evaluation.clouds["straight"], evaluation.clouds["bent"]
    assert (straight_result.deformation.verdict, bent_result.deformation.verdict) == ("none", "non-affine")
    assert straight_result.measures.d2_poisson_mse is None
    assert straight_result.measures.d2_mse < bent_result.measures.d2_mse
    assert 0 < straight_result.r2c_mse < straight_result.measures.chamfer
    assert "expected" in evaluation.clouds["nowhere"].failure
    stamp = (evaluation.folder / "comparison.json").stat().st_mtime_ns
    repeated_evaluation = evaluate_against(tmp_path / "reference.ply", TRUTH, clouds, region, tmp_path, 0)
    assert repeated_evaluation == evaluation
    assert (repeated_evaluation.folder / "comparison.json").stat().st_mtime_ns == stamp
    # Other inputs are evaluated again.
    failed_evaluation = evaluate_against(
        tmp_path / "reference.ply", TRUTH, {"nowhere": clouds["nowhere"]}, region, tmp_path, 0
    )
    assert (failed_evaluation.folder, failed_evaluation.counts) == (None, None)
    assert "expected" in failed_evaluation.clouds["nowhere"].failure
    empty_evaluation = evaluate_against(
        tmp_path / "reference.ply", TRUTH, {"bent": clouds["bent"]}, "sphere:900,0,0,1", tmp_path, 0
    )
    assert "6,000 points" in check_text(empty_evaluation.clouds["bent"].failure)


def test_truth_is_limited_to_visible_points(tmp_path):
    points = np.arange(30.0).reshape(10, 3)
    write_cloud(tmp_path / "cloud.ply", Cloud(points, attributes={"visible": (np.arange(10) < 4).astype(np.uint8)}))
    assert len(read_points(visible_truth(tmp_path / "cloud.ply", tmp_path))) == 4
    write_cloud(tmp_path / "cloud.ply", Cloud(points))
    assert len(read_points(visible_truth(tmp_path / "cloud.ply", tmp_path))) == 10


def test_splat_clouds_differ_in_one_setting():
    methods_by_name = {method.name: method for method in methods(GaoJob(settings={"steps": "7", "density": "gao2025"}))}
    assert methods_by_name[SPARSE].settings["poses"] == "solve"
    assert methods_by_name[MVS].settings["poses"] == "given"
    means, surface = methods_by_name[MEANS], methods_by_name[SURFACE]
    assert means.workspace == surface.workspace
    assert {k for k in means.settings if means.settings[k] != surface.settings[k]} == {"cloud"}
    assert methods_by_name[FIELD].settings["hold_out"] == means.settings["hold_out"]
    assert (means.settings["start"], means.settings["steps"], means.settings["density"]) == ("sfm", "7", "gao2025")


def test_unusable_input_is_rejected(run, tmp_path):
    import_or_skip("pycolmap")
    import_or_skip("torch")
    folder_without_cameras = ten_images_folder(tmp_path / "bare")
    folder_with_few_images = ten_images_folder(tmp_path / "few")
    for k in range(8, 10):
        (folder_with_few_images / f"images/{k}.png").unlink()
    write_colmap_model(folder_with_few_images / "sparse/0", orbit([f"{k}.png" for k in range(8)]))
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/notes.txt").write_text("mine")
    for arguments in (
        (folder_without_cameras, "--poses", "given"),
        (folder_with_few_images,),
        (folder_without_cameras, "--images", "20"),
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
    monkeypatch.setattr(gao, "_run", lambda job, scenes, *_: calls.append(scenes))
    run_gao(GaoJob((scene,)), tmp_path / "out")
    assert [len(read.cameras) for read in calls[0].values()] == [0]
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
    executed = []

    def make(maker, method, *_):
        executed.append(method.name)
        folder = tmp_path / method.name
        folder.mkdir()
        write_cloud(folder / "cloud.ply", Cloud(np.arange(30.0).reshape(10, 3)))
        return CloudResult(method.name, folder=folder)

    monkeypatch.setattr(clouds._CloudMaker, "make", make)
    job = GaoJob((scene.folder,), crop="sphere:900,0,0,1")
    with check_error():
        clouds.make_clouds(job, scene, scene.folder, tmp_path, None, lambda _: None)
    assert executed == [SPARSE]


def test_later_clouds_have_the_unit_of_the_sparse_cloud(tmp_path, monkeypatch):
    """Photographs with GPS have no cameras and no unit until they are solved."""
    scene = read_scene(ten_images_folder(tmp_path / "scene"))
    units = {}

    def make(maker, method, *_):
        units[method.name] = maker.unit
        folder = tmp_path / method.name
        folder.mkdir()
        write_cloud(folder / "cloud.ply", Cloud(np.arange(30.0).reshape(10, 3), unit="m"))
        return CloudResult(method.name, folder=folder)

    monkeypatch.setattr(clouds._CloudMaker, "make", make)
    clouds.make_clouds(GaoJob((scene.folder,)), scene, scene.folder, tmp_path, None, lambda _: None)
    assert units == {SPARSE: None, MVS: "m", MEANS: "m", SURFACE: "m", FIELD: "m"}


def test_scenes_on_workers_give_the_same_results(tmp_path, monkeypatch, tasks_in_process):  # noqa: F811
    scenes = tuple(ten_images_folder(tmp_path / name) for name in ("first", "second"))
    monkeypatch.setattr(gao, "find_plugin", lambda _: SimpleNamespace(missing=None, configure=lambda _: None))

    def make(job, scene, path, out, unit, step, *, beside_others):
        step(f"{scene.name}: made")
        return [CloudResult(method.name, failure=f"no cloud of {path.name}") for method in methods(job)]

    monkeypatch.setattr(gao, "make_clouds", make)
    studies, steps = [], []
    for out, workers in ((tmp_path / "alone", None), (tmp_path / "shared", Workers(2))):
        with pytest.raises(ReconstructionError):
            run_gao(GaoJob(scenes), out, workers=workers, figures=False, step=steps.append)
        studies.append(replace(KIND.read(out), provenance=None))
    assert studies[0] == studies[1]
    assert [scene.name for scene in studies[0].scenes] == ["first", "second"]
    assert {"1 of 2: first: made", "2 of 2: second: made", "done: 0 of 2 runs"} <= set(steps)


def test_times_beside_other_scenes_are_marked(tmp_path, monkeypatch):
    scene = read_scene(ten_images_folder(tmp_path / "scene"))
    stored = []

    def run(*_):
        cloud = Cloud(np.arange(30.0).reshape(10, 3))
        result = SimpleNamespace(cloud=cloud, gauge="similarity", cameras={}, notes=())
        return SimpleNamespace(require_reconstruction=lambda: result, wall_s=2.0, peak_rss_bytes=1, warnings=())

    monkeypatch.setattr(clouds, "run", run)
    monkeypatch.setattr(clouds, "describe", lambda _: SimpleNamespace(sha256="0"))
    for beside_others in (True, False):  # the second uses the stored clouds, and what they record
        job = GaoJob((scene.folder,))
        made = clouds.make_clouds(job, scene, scene.folder, tmp_path, None, print, beside_others=beside_others)
        stored.append([run.beside_others for run in made])
    assert stored == [[True] * 5] * 2


SMALL_SCENE_OPTIONS = ("--cities", "1", "--images", "28", "--size", "240x136", "--extent", "100", "--poses", "given")


@pytest.mark.slow
def test_killed_experiment_is_resumed_and_completed(run, renderer, tmp_path):
    """Killed once, then with a failing training: finished results stay, and failures are reported."""
    import_or_skip("pycolmap")
    import_or_skip("torch")
    import_or_skip("matplotlib")
    out = tmp_path / "gao"
    failing_command = ("experiment", "gao", "--out", out, *SMALL_SCENE_OPTIONS, "--set", "memory=0.001")
    kill_when_file_exists(["pcbench.cli", *map(str, failing_command)], out / "city_1/runs/sparse/stage.json")
    stamp = (out / "city_1/runs/sparse/stage.json").stat().st_mtime_ns
    assert not (out / "experiment.json").exists()

    code, out_text, err = run(*failing_command)
    assert code == 0, err
    assert "splat-means" in out_text
    assert "memory=0.001" in out_text
    failed_study = KIND.read(out)
    assert [bool(cloud.failure) for cloud in failed_study.scenes[0].clouds] == [False, False, True, True, False]
    assert failed_study.scenes[0].views is None
    assert "mvs deviates from the truth by 0." in out_text  # the other clouds were measured

    code, out_text, err = run("experiment", "gao", "--out", out, *SMALL_SCENE_OPTIONS, "--set", "steps=1200")
    assert code == 0, err
    assert (out / "city_1/runs/sparse/stage.json").stat().st_mtime_ns == stamp
    (scene,) = KIND.read(out).scenes
    assert scene.references[TRUTH][1] > scene.references[MVS][1] / 100 > 0
    assert all(not cloud.failure for cloud in scene.clouds)
    sparse, mvs, means, surface, field = scene.clouds
    assert field.evaluation(TRUTH).r2c_rms < sparse.evaluation(TRUTH).r2c_rms
    assert means.points > 1.2 * sparse.points  # splats were densified
    assert surface.seconds < means.seconds  # one training for both
    assert mvs.evaluation(TRUTH).r2c_rms < sparse.evaluation(TRUTH).r2c_rms
    assert (scene.views.train_views, scene.views.test_views) == (24, 4)
    for name in ("rings", "directions", "growth"):
        assert (out / f"figures/{name}.png").stat().st_size > 10_000
    for name in (SPARSE, MEANS, SURFACE):
        assert (out / f"city_1/against-mvs/figures/{name}_poisson_distance.png").stat().st_size > 10_000
    for name in ("splat", "field"):
        assert (out / f"views/figures/city_1_{name}.png").stat().st_size > 10_000
    page = check_page_of_study((out / "report.html").read_text(encoding="utf-8"))
    assert page.values("href") == ["./city_1/against-mvs/report.html", "./city_1/against-truth/report.html"]
    assert len(page.values("src")) == 5
    contents = {path: path.read_bytes() for path in (out / "experiment.csv", out / "gao.md")}
    assert run("experiment", "gao", "--out", out, *SMALL_SCENE_OPTIONS, "--set", "steps=1200")[:2] == (0, out_text)
    assert all(path.read_bytes() == text for path, text in contents.items())


def kill_when_file_exists(module, file, seconds=300.0):
    """Run `python -m MODULE ...` and kill it as soon as the file exists."""
    process = subprocess.Popen([sys.executable, "-m", *module], stdout=subprocess.DEVNULL)
    deadline = time.monotonic() + seconds
    while not file.exists():
        assert process.poll() is None, "it ended before it was killed"
        assert time.monotonic() < deadline
        time.sleep(0.05)
    process.kill()
    process.wait()
