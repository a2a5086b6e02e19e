"""`pcbench stress`: a complete small study, its files, and the errors of its command."""

import csv
import json
from dataclasses import replace

import numpy as np
import pytest
from children_here import stress_runs_here
from command_line import is_one_line
from html_pages import check_page_of_study, markdown_tables
from optional import import_or_skip
from wording import check_error, check_text

from pcbench.errors import InputError
from pcbench.geometry.cloud import Cloud
from pcbench.io import write_cloud
from pcbench.studies.stress.ladders import displaced
from pcbench.studies.stress.reconstructors.study import run_reconstructor_stress
from pcbench.studies.stress.registration import REGISTRATION
from pcbench.studies.stress.results import KIND, StressSettings
from pcbench.studies.stress.scenes import given_pair, scene_pair
from pcbench.studies.stress.study import GivenClouds, StressPlan, run_stress
from pcbench.studies.stress.subject import SILENT
from pcbench.studies.stress.subjects import PAIR_SUBJECTS
from pcbench.studies.stress.table import stress_table
from pcbench.studies.stress.verdicts import VERDICTS

SETTINGS = StressSettings(
    quick=True, only="start-rotation,density,raised-part,degenerate", methods=("icp", "pcbench", "deform", "changes")
)


def small_plan(settings):
    return replace(StressPlan.of(settings), points=3000)


@pytest.fixture(scope="module", autouse=True)
def runs_here():
    with stress_runs_here():
        yield


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    import_or_skip("matplotlib")
    return tmp_path_factory.mktemp("stress") / "out"


@pytest.fixture(scope="module")
def outcome(folder):
    return run_stress(folder, SETTINGS, plan=small_plan(SETTINGS))


@pytest.mark.long
def test_quick_study_answers_each_subject(outcome):
    study = outcome.study
    assert {ladder.name for ladder in study.ladders} == {"start-rotation", "density", "raised-part", "degenerate"}
    for subject in PAIR_SUBJECTS.values():
        assert study.cells(subject), subject.name
    cells = {(cell.ladder, cell.level): cell for cell in study.registrations}
    assert cells["start-rotation", 5].pose_is_right and not cells["start-rotation", 90].pose_is_right
    assert cells["density", 1].pose_is_right
    # The half-turn building is nearly symmetric: an ICP that starts half a turn away ends there.
    assert cells["degenerate", 5.0].angle_error_deg == pytest.approx(180, abs=5)
    # Nothing is deformed; at one point of sixteen, 94 points are too few for a verdict.
    verdicts = {cell.level: cell for cell in study.verdicts if cell.method == "deform"}
    assert (verdicts[1].outcome, verdicts[16].outcome) == ("right", "withheld")
    assert study.sentences and all(sentence.endswith((".", ":")) for sentence in study.sentences)
    assert outcome.without_figures is None and outcome.without_page is None


@pytest.mark.long
def test_files_of_a_study(outcome, folder):
    assert KIND.read(folder) == replace(outcome.study, provenance=None)
    rows = list(csv.DictReader((folder / "stress.csv").read_text().splitlines()))
    assert len(rows) == sum(len(outcome.study.cells(subject)) for subject in PAIR_SUBJECTS.values())
    assert {row["subject"] for row in rows} == set(PAIR_SUBJECTS) and rows[0]["outcome"]
    page = (folder / "stress.md").read_text()
    parsed = check_page_of_study((folder / "report.html").read_text(encoding="utf-8"))
    assert parsed.tables == markdown_tables(page)
    assert len(parsed.values("src")) == len(list((folder / "figures").iterdir()))
    assert all(sentence in page for sentence in outcome.study.sentences)
    for name in (line.split("](")[1].rstrip(")") for line in page.splitlines() if line.startswith("![")):
        assert (folder / name).stat().st_size > 1000, name
    assert (folder / "stress.txt").read_text().strip() == stress_table(outcome.study).strip()
    assert any((folder / "figures").glob("*.png"))


@pytest.mark.long
def test_worst_silent_failures_are_saved_with_their_clouds(outcome, folder):
    silent = [cell for cell in outcome.study.registrations if cell.outcome == SILENT]
    assert len(outcome.study.worst) == min(3, len(silent)) > 0
    for failure in outcome.study.worst:
        assert failure.cell in silent
        with np.load(folder / failure.file) as arrays:
            off = np.sqrt(np.square(arrays["found"] - arrays["true"]).sum(axis=1).mean())
            assert off == pytest.approx(failure.cell.error_rms, rel=0.05)


@pytest.mark.long
def test_a_second_run_reuses_all_records_and_gives_the_same(outcome, folder, monkeypatch):
    def fail(*_, **__):
        raise AssertionError("a child was started although all runs have records")

    monkeypatch.setattr("pcbench.studies.stress.runs.run_module", fail)
    again = run_stress(folder, SETTINGS, plan=small_plan(SETTINGS), figures=False)
    assert replace(again.study, provenance=None) == replace(outcome.study, provenance=None)
    assert stress_table(again.study) == stress_table(outcome.study)


def moved_pair(seed=0):
    pair = displaced(scene_pair("city", seed, 6000), 3.0, 2.0, np.random.default_rng(seed))
    return pair, GivenClouds(Cloud(pair.reference, unit="m"), Cloud(pair.candidate, unit="m"))


@pytest.mark.long
def test_a_given_pair_is_stressed_about_the_pose_that_was_found(tmp_path):
    pair, clouds = moved_pair()
    truth = given_pair(clouds.reference, clouds.candidate, "icp")
    assert np.sqrt(np.square(truth.points - pair.points).sum(axis=1).mean()) < 0.2 * pair.spacing
    settings = StressSettings(quick=True, only="start-rotation,warp", methods=("icp", "deform"))
    out = tmp_path / "out"
    study = run_stress(out, settings, clouds, figures=False).study
    assert study.registrations[0].outcome == "right" and not study.cells(VERDICTS)
    assert {cell.scene for cell in study.cells(REGISTRATION)} == {"given"}
    assert study.scenes[0].unit == "m" and study.scenes[0].noise is None
    # The folder keeps its pair; a file of the pair that is damaged is written again.
    with check_error():
        run_stress(out, settings, moved_pair(1)[1])
    with check_error():
        run_stress(out, settings)
    (out / "given.npz").write_bytes(b"damaged")
    run_stress(out, settings, clouds, figures=False)


def test_a_pair_without_a_certain_pose_is_refused(tmp_path):
    _, clouds = moved_pair()
    other = Cloud(scene_pair("terrain", 0, 6000).points)
    with check_error(InputError):
        run_stress(tmp_path / "out", SETTINGS, GivenClouds(clouds.reference, other))
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "settings",
    [
        StressSettings(methods=("ICP",)),
        StressSettings(only="nothing"),
        StressSettings(only="warp", methods=("icp",)),
    ],
)
def test_settings_that_leave_nothing_to_run(settings, tmp_path):
    with check_error():
        run_stress(tmp_path / "out", settings)


def test_methods_of_missing_libraries_are_named(monkeypatch):
    monkeypatch.setattr("pcbench.studies.stress.subject.find_spec", lambda _: None)
    plan = StressPlan.of(StressSettings(methods=("icp", "small_gicp GICP", "global")))
    assert plan.methods["registration"] == ("icp",)
    for method in plan.missing:
        check_text(f"{method.name}: {method.reason}")
    assert [method.name for method in plan.missing] == ["global", "small_gicp GICP"]
    with check_error():
        StressPlan.of(StressSettings(methods=("small_gicp GICP",)))


def test_quick_plan_leaves_out_slow_methods():
    names = StressPlan.of(StressSettings(quick=True)).methods["registration"]
    assert "icp" in names and "global-similarity" not in names
    asked = StressPlan.of(StressSettings(quick=True, methods=("icp-point",)))
    assert asked.methods["registration"] == ("icp-point",) and asked.methods["verdicts"] == ()


def test_command(run, tmp_path):
    out = tmp_path / "out"
    code, printed, _ = run(
        "stress", "--quick", "--only", "density", "--methods", "icp-point", "--no-figures", "--out", out
    )
    assert code == 0 and f"report: {out}" in printed
    values = json.loads((out / "stress.json").read_text())
    assert values["settings"]["methods"] == ["icp-point"] and len(values["registrations"]) == 2
    assert not (out / "figures").exists()


def test_warnings_of_the_reader_are_lines(run, tmp_path):
    points = np.random.default_rng(0).normal(size=(400, 3))
    paths = [tmp_path / f"{name}.xyz" for name in ("reference", "candidate")]
    for path in paths:
        np.savetxt(path, np.vstack([points, [[np.nan, 0, 0]]]))
    options = ("--only", "nothing", "--out", tmp_path / "out")
    _, _, said = run("stress", *paths, *options)
    assert [line.split(":")[0] for line in said.splitlines()] == ["warning", "warning", "error"]
    assert "UserWarning" not in said
    _, _, said = run("stress", *paths, *options, "--quiet")
    assert is_one_line(said)


@pytest.mark.long
def test_a_folder_keeps_its_study(outcome, folder):
    """Results of other clouds would replace those of the study, so another folder is asked for."""
    before = {path: path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}
    scene = scene_pair("object", 0, 3000)
    with check_error():
        run_stress(folder, SETTINGS, GivenClouds(Cloud(scene.reference), Cloud(scene.points)))
    with check_error():
        run_reconstructor_stress(folder, SETTINGS)
    assert {path: path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()} == before


@pytest.mark.long
def test_clouds_in_the_output_folder_are_not_replaced(run, outcome, folder, tmp_path):
    cloud = folder / "worst_9.npz"
    write_cloud(tmp_path / "a.ply", Cloud(np.random.default_rng(0).normal(size=(100, 3))))
    code, _, said = run("stress", tmp_path / "a.ply", cloud, "--out", folder)
    assert code == 2
    check_text(said)


def test_a_pose_that_the_geometry_does_not_fix_is_no_truth(tmp_path):
    points = np.random.default_rng(0).random((3000, 3)) * [1, 1, 0]
    with pytest.raises(InputError, match="the study needs a true pose: the geometry does not fix"):
        run_stress(tmp_path / "out", SETTINGS, GivenClouds(Cloud(points[:2000]), Cloud(points[1000:])))


def test_errors_of_the_command(run, tmp_path):
    cloud = tmp_path / "a.ply"
    write_cloud(cloud, Cloud(np.random.default_rng(0).normal(size=(100, 3))))
    for arguments in (
        (cloud, "--out", tmp_path / "out"),
        ("--register", "icp", "--out", tmp_path / "out"),
        ("--only", "none", "--out", tmp_path / "out"),
        ("--only", "start-offset", "--quick", "--out", tmp_path / "out"),
        ("--time-limit", "1e10", "--out", tmp_path / "out"),
    ):
        code, _, error = run("stress", *arguments)
        assert code == 2
        check_text(error)
