"""Runs of reconstructors on perturbed photographs: every outcome, records, and runs that go on after a stop."""

from dataclasses import replace

import numpy as np
import pytest
from optional import import_or_skip
from task_pools import tasks_in_process  # noqa: F401  # a fixture
from wording import check_error, check_text

from pcbench.errors import InputError
from pcbench.geometry.cameras import Camera, Intrinsics, look_at
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.mesh import Mesh
from pcbench.io import write_cloud
from pcbench.io.ply import write_ply_mesh
from pcbench.plugins.run import Description, Run
from pcbench.studies.stress.reconstructors import runs
from pcbench.studies.stress.reconstructors import study as studies
from pcbench.studies.stress.reconstructors.ladders import PHOTO_LADDERS, Photographs
from pcbench.studies.stress.reconstructors.reconstruction import UNPERTURBED, ReconstructionCell, settle
from pcbench.studies.stress.reconstructors.runs import PhotoRuns, ReconstructorMethod, plan_photo_runs, run_photo_plans
from pcbench.studies.stress.reconstructors.scenes import (
    base_settings,
    read_photographs,
    read_scene_truth,
    rendered_scene,
    write_photographs,
)
from pcbench.studies.stress.reconstructors.study import PhotoPlan, run_reconstructor_stress
from pcbench.studies.stress.results import KIND, StressSettings
from pcbench.studies.stress.subject import CRASH, DEGRADED, REFUSED, RIGHT, TIME_OUT, WARNED
from pcbench.studies.stress.words import warnings

# A reconstructor whose cloud depends on the number of images.
PLUGIN = """
import os
from dataclasses import dataclass
from pathlib import Path
import numpy as np
from pcbench.errors import ReconstructionError
from pcbench.geometry.cloud import Cloud
from pcbench.plugins import Reconstruction

@dataclass(frozen=True)
class Fickle:
    "Return a part of a plane."
    seed: int = 0

    def reconstruct(self, scene, workspace):
        count = len(scene.images)
        if count == 3:
            raise ReconstructionError("three images are too few; take more")
        if count == 2:
            os.abort()
        rng = np.random.default_rng(self.seed)
        points = np.column_stack([rng.uniform(-50, 50, (20000, 2)), np.zeros(20000)])
        notes = [f"{count} images matched"]
        if count in (4, 6):
            points = points[points[:, 0] < -35]
        if count == 4:
            notes.append("warning: a part of the surface is missing")
        return Reconstruction(Cloud(points), "georeferenced", scene.cameras, notes)
"""
SETTINGS = StressSettings(reconstructors=True, only="fewer-images", time_limit_s=60.0)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """A square of 100 m from which ten cameras see the middle."""
    pytest.importorskip("PIL")
    folder = tmp_path_factory.mktemp("scene")
    intrinsics = Intrinsics(32, 24, 35.0, 35.0, 16.0, 12.0)
    places = [(x, y) for x in (-30, -15, 0, 15, 30) for y in (-20, 20)]
    cameras = tuple(
        Camera(f"{k:04d}.png", intrinsics, look_at([x, y, 60.0], [x, y, 0.0])) for k, (x, y) in enumerate(places)
    )
    rng = np.random.default_rng(0)
    images = {camera.name: rng.integers(0, 255, (24, 32, 3)).astype(np.uint8) for camera in cameras}
    write_photographs(folder, Photographs(cameras, images))
    (folder / "truth").mkdir()
    corners = np.array([[-50.0, -50, 0], [50, -50, 0], [50, 50, 0], [-50, 50, 0]])
    write_ply_mesh(folder / "truth" / "mesh.ply", Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]]), unit="m"))
    points = np.column_stack([rng.uniform(-50, 50, (5000, 2)), np.zeros(5000)])
    write_cloud(folder / "truth" / "cloud.ply", Cloud(points, unit="m"))
    return folder


@pytest.fixture(scope="module")
def plugin(tmp_path_factory, scene):
    path = tmp_path_factory.mktemp("plugin") / "fickle.py"
    path.write_text(PLUGIN)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(runs, "rendered_scene", lambda _folder, _settings: scene)
        patch.setattr(studies, "check_renderer", lambda: None)
        yield f"{path}:Fickle"


@pytest.fixture(scope="module")
def alone(plugin, tmp_path_factory):
    """The folder of a study whose runs went on one after another, and its outcome."""
    out = tmp_path_factory.mktemp("alone") / "out"
    return out, run_reconstructor_stress(out, replace(SETTINGS, methods=(plugin,)), figures=False)


@pytest.mark.long
def test_each_end_of_a_run_is_an_outcome_and_records_are_reused(plugin, alone, monkeypatch):
    settings = replace(SETTINGS, methods=(plugin,))
    out, outcome = alone
    cells = {(cell.ladder, cell.level): cell for cell in outcome.study.reconstructions}
    # 80, 60, 40, 30 and 20 % of ten images.
    assert [cells["fewer-images", level].images for level in (80, 60, 40, 30, 20)] == [8, 6, 4, 3, 2]
    assert [cells["fewer-images", level].outcome for level in (80, 60, 40, 30, 20)] == [
        RIGHT, DEGRADED, WARNED, REFUSED, CRASH,
    ]  # fmt: skip
    standard = cells[UNPERTURBED, 0.0]
    assert standard.outcome == RIGHT and standard.fscore == pytest.approx(1, abs=0.01) and standard.rms < 1e-6
    assert standard.registration == "none" and standard.points == 20_000 and standard.cameras == 10
    poor = cells["fewer-images", 60]
    assert poor.standard == standard.fscore and poor.precision == 1 and poor.recall < 0.3
    assert poor.fscore == pytest.approx(2 * poor.recall / (1 + poor.recall), rel=1e-4)
    assert cells["fewer-images", 40].notes == ("4 images matched", "warning: a part of the surface is missing")
    assert cells["fewer-images", 30].message == "three images are too few; take more"
    assert "SIGABRT" in cells["fewer-images", 20].message
    assert all(cell.cpu_s > 0 for cell in cells.values())
    assert not (out / "work").exists() and not (out / "figures").exists()
    for sentence in outcome.study.sentences:
        check_text(sentence)
    assert KIND.read(out) == replace(outcome.study, provenance=None)

    def fail(*_, **__):
        raise AssertionError("a reconstructor was started although its run has a record")

    monkeypatch.setattr(runs, "run", fail)
    again = run_reconstructor_stress(out, settings, figures=False)
    assert replace(again.study, provenance=None) == replace(outcome.study, provenance=None)
    (out / "runs" / f"{record_of(out, 'fewer-images_80')}").unlink()  # as if the study had been killed there
    with pytest.raises(AssertionError, match="a reconstructor was started"):
        run_reconstructor_stress(out, settings, figures=False)


@pytest.mark.long
def test_workers_give_the_same_results(plugin, alone, tmp_path, tasks_in_process):  # noqa: F811
    settings = replace(SETTINGS, methods=(plugin,), workers=2)
    shared = run_reconstructor_stress(tmp_path / "shared", settings, figures=False).study

    def results(study):
        return [replace(cell, cpu_s=None, wall_s=None, memory_bytes=None) for cell in study.reconstructions]

    assert results(shared) == results(alone[1].study)
    assert KIND.read(tmp_path / "shared").settings.workers == 2
    (warning,) = set(warnings(shared)) - set(warnings(alone[1].study))
    check_text(warning)
    assert not (tmp_path / "shared" / "work").exists()


def record_of(out, start):
    (found,) = [path.name for path in (out / "runs").iterdir() if f"{start}_" in path.name]
    return found


@pytest.mark.parametrize(
    ("status", "outcome"),
    [("failed", REFUSED), ("refused", REFUSED), ("crashed", CRASH), ("garbage", CRASH), ("timeout", TIME_OUT)],
)
def test_a_run_without_a_cloud(status, outcome, plugin, tmp_path, monkeypatch):
    def end(_job, workspace, limit):
        return Run(status, f"ended after {limit:g} s", 3.0, 2.0, None, None, workspace, {}, (), None)

    monkeypatch.setattr(runs, "run", end)
    method = ReconstructorMethod("fickle", plugin, {}, Description())
    (plan,) = plan_photo_runs([], ["fickle"], quick=True, seeds=range(1))
    (found,) = run_photo_plans([plan], {"fickle": method}, PhotoRuns(tmp_path, 5.0, quick=True))
    assert (found.outcome, found.message) == (outcome, "ended after 5 s")
    assert (found.images, found.points, found.fscore, found.cpu_s) == (10, None, None, 2.0)


def test_plan_has_one_unperturbed_run_and_shares_photographs_between_methods():
    ladders = [PHOTO_LADDERS["blur"], PHOTO_LADDERS["texture"]]
    plans = plan_photo_runs(ladders, ["sfm", "mvs"], quick=False, seeds=range(4, 6))
    assert len(plans) == len(set(plans)) == 2 * 2 * (1 + 5 + 4)
    assert len({plan.stem for plan in plans}) == len(plans)
    assert [plan.method for plan in plans[:2]] == ["sfm", "mvs"] and plans[0].pair == plans[1].pair
    assert sum(plan.ladder == UNPERTURBED for plan in plans) == 4


def cell(ladder, level, fscore, notes=(), outcome=RIGHT, seed=0, method="mvs"):
    return ReconstructionCell(
        "photographs", ladder, level, None, method, seed, outcome, fscore=fscore, notes=notes, threshold=2.0
    )


def test_half_of_the_unperturbed_score_of_the_same_method_and_seed_is_right():
    cells = [
        cell(UNPERTURBED, 0.0, 0.8, ("8 images matched",)),
        cell(UNPERTURBED, 0.0, 0.2, seed=1),
        cell("blur", 1, 0.4),
        cell("blur", 2, 0.399),
        cell("blur", 2, 0.1, seed=1),
        cell("blur", 4, None, outcome=REFUSED),
        cell("blur", 8, None),
    ]
    assert [(c.outcome, c.standard) for c in settle(cells)] == [
        (RIGHT, 0.8), (RIGHT, 0.2), (RIGHT, 0.8), (DEGRADED, 0.8), (RIGHT, 0.2), (REFUSED, 0.8), (DEGRADED, 0.8),
    ]  # fmt: skip


def test_only_a_note_that_is_marked_as_a_warning_counts_as_one():
    standard = cell(UNPERTURBED, 0.0, 0.8, ("8 images matched",))
    for notes, outcome in (
        ((), DEGRADED),
        (("2 of 8 images are not registered",), DEGRADED),
        (("3 images matched", "warning: most pairs contradict the cameras"), WARNED),
    ):
        assert settle([standard, cell("blur", 2, 0.1, notes)])[1].outcome == outcome
    assert settle([standard, cell("blur", 2, 0.7, ("warning: a part is missing",))])[1].outcome == RIGHT


def test_without_an_unperturbed_score_no_cloud_is_right():
    cells = [cell(UNPERTURBED, 0.0, None, outcome=REFUSED), cell("blur", 1, 0.9)]
    assert [c.outcome for c in settle(cells)] == [REFUSED, REFUSED]


@pytest.mark.long
def test_methods_that_cannot_run_here_are_named(monkeypatch):
    known = studies.describe

    def describe(spec, *rest):
        return replace(known(spec, *rest), missing="a library is not installed" if spec == "sfm" else None)

    monkeypatch.setattr(studies, "describe", describe)
    plan = PhotoPlan.of(StressSettings(quick=True, reconstructors=True))
    assert list(plan.methods) == ["mvs"] and [method.name for method in plan.missing] == ["sfm"]
    assert plan.infos()[0].is_ours
    with check_error(InputError):
        PhotoPlan.of(StressSettings(reconstructors=True, methods=("sfm",)))
    with check_error(InputError):
        PhotoPlan.of(StressSettings(reconstructors=True, methods=("icp",)))


def test_errors_of_the_command(run, tmp_path):
    write_cloud(tmp_path / "a.ply", Cloud(np.random.default_rng(0).normal(size=(100, 3))))
    clouds = (tmp_path / "a.ply", tmp_path / "a.ply")
    for arguments in (clouds, ("--only", "warp"), ("--methods", "icp"), ("--register", "icp")):
        code, _, error = run("stress", "--reconstructors", *arguments, "--out", tmp_path / "out")
        assert code == 2
        check_text(error)
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_command_on_a_rendered_city(run, tmp_path, renderer):
    for library in ("pycolmap", "matplotlib"):
        import_or_skip(library)
    out = tmp_path / "out"
    arguments = ("--quick", "--only", "positions", "--methods", "mvs", "--out", out)
    code, printed, _ = run("stress", "--reconstructors", *arguments)
    assert code == 0 and "errors of camera positions [m]" in printed
    study = KIND.read(out)
    clean, small, large = study.reconstructions
    assert (clean.ladder, small.level, large.level) == (UNPERTURBED, 0.3, 3)
    assert clean.outcome == small.outcome == RIGHT and clean.fscore > 0.9 and clean.rms < 1
    # Errors of 3 m are 2.5 pixels on the surface: no three depth maps agree.
    assert large.outcome != RIGHT and (large.fscore or 0.0) < 0.3
    assert study.photographs.threshold == pytest.approx(2 * study.photographs.pixel)
    assert (out / "figures" / "scores_cameras.png").stat().st_size > 10_000
    truth = read_scene_truth(next((out / "scenes").iterdir()) / "scene")
    assert truth.surface is not None and len(truth.cameras) == 10
    texture = replace(base_settings(0, quick=True), points=2000)
    bare = rendered_scene(tmp_path, replace(texture, city=replace(texture.city, texture=0.0)))
    base = read_photographs(next((out / "scenes").iterdir()) / "scene")
    changed = read_photographs(bare)
    assert [c.cam_from_world.matrix.tolist() for c in changed.cameras] == [
        c.cam_from_world.matrix.tolist() for c in base.cameras
    ]
    contrast = [
        np.mean([np.abs(np.diff(image.astype(float), axis=1)).mean() for image in scene.images.values()])
        for scene in (base, changed)
    ]
    assert contrast[1] < 0.8 * contrast[0]
