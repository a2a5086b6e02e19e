"""`pcbench experiment bend`: results for clouds of known deformation, and the complete experiment on a small scene."""

import csv
import json
import re
from dataclasses import replace

import numpy as np
import pytest
from children_here import drawing_here
from command_line import is_one_line
from optional import import_or_skip
from wording import check_error, check_text

from pcbench.geometry.cameras import Intrinsics
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.mesh import MeshIndex
from pcbench.report import to_json
from pcbench.scenes import read_scene
from pcbench.scenes.synthetic import city
from pcbench.scenes.synthetic.plan import CitySettings
from pcbench.scenes.synthetic.rigs import Site, rig
from pcbench.scenes.synthetic.surface import build_city
from pcbench.scenes.synthetic.truth import surface_cloud
from pcbench.scenes.synthetic.warp import make_warp, similarity_from_angles
from pcbench.studies.bend.bend import _control_lines, register_by_rays
from pcbench.studies.bend.findings import (
    Solution,
    Variant,
    csv_text,
    explain,
    failures,
    intrinsics_error,
    measure_solutions,
    table,
)
from pcbench.studies.bend.page import article
from pcbench.studies.bend.results import (
    KIND,
    BendStudy,
    Lens,
    SurveyedScene,
)
from pcbench.studies.frame.publish import StudyOutcome
from reconstructors.sfm.alignment import transform_camera

INTRINSICS = Intrinsics(400, 300, 350.0, 350.0, 200.0, 150.0, (-0.05, 0.0, 0.0, 0.0))
UNDISTORTED_INTRINSICS = replace(INTRINSICS, distortion=(0.0, 0.0, 0.0, 0.0))


def sample(count, seed, noise):
    rng = np.random.default_rng(seed)
    points, _ = city(0).sample(count, rng)
    return points + rng.normal(0, noise, points.shape)


def solution(name, *factors, bend=None, seed=1, intrinsics=INTRINSICS):
    points = sample(8000, seed, 0.03)
    if bend:
        points = make_warp("dome", points, bend).apply(points)
    cloud = Cloud(points, attributes={"reprojection_error": np.full(len(points), 0.5)})
    return Solution(Variant(name, *factors), 12, 12, cloud, intrinsics)


@pytest.fixture(scope="module")
def study():
    """Study of a correct solution, two domes caused by a wrong lens, and a failure."""
    solutions = [
        solution("true lens", "nadir", "true", "true", False),
        solution("no distortion", "nadir", "true", "zero", False, bend=0.4, seed=2, intrinsics=UNDISTORTED_INTRINSICS),
        solution(
            "no distortion, control points",
            "nadir",
            "true",
            "zero",
            True,
            bend=0.35,
            seed=3,
            intrinsics=UNDISTORTED_INTRINSICS,
        ),
        Solution(Variant("every second", "half", "true", "true", False), 6, failure="nothing registers"),
    ]
    rows = measure_solutions(solutions, Cloud(sample(30_000, 0, 0.0), unit="m"), INTRINSICS)
    scene = SurveyedScene("photos", 12, Lens.from_intrinsics(INTRINSICS), "m")
    return BendStudy(scene, "sfm", rows, tuple(explain(rows, "m")), {"seed": 0})


def test_deformations_against_truth_and_first_solution(study):
    straight, dome, control, failed = study.rows
    assert (straight.truth.verdict, straight.mutual) == ("none", None)
    for row, dome_height in ((dome, 0.4), (control, 0.35)):
        assert row.truth.is_bent
        # Displacements are along the normals, so walls show nothing of a vertical deformation.
        assert 0.6 * dome_height < row.truth.rms < dome_height
        assert row.mutual.is_bent
        assert row.mutual.against == "true lens"
    assert failed.truth is None
    assert dome.reprojection_error == 0.5


def test_experiment_json_round_trip(study, tmp_path):
    assert list(KIND.values(study)) == ["schema", "scene", "plugin", "rows", "sentences", "provenance"]
    (tmp_path / "experiment.json").write_text(to_json(KIND.values(study)))
    restored = KIND.read(tmp_path)
    assert to_json(KIND.values(restored)) == (tmp_path / "experiment.json").read_text()
    assert [row.truth for row in restored.rows] == [row.truth for row in study.rows]
    assert [row.lens for row in restored.rows] == [row.lens for row in study.rows]
    np.testing.assert_array_equal(restored.rows[1].cells, study.rows[1].cells)
    row = json.loads((tmp_path / "experiment.json").read_text())["rows"][1]
    assert {*row} == {
        *("name", "factors", "images_given", "images", "failure", "notes", "points", "reprojection_error"),
        *("lens", "lens_error_px", "truth", "mutual", "cells"),
    }
    keys = {"verdict", "model", "rms", "ci", "p_value", "detectable", "growth", "warnings", "conditional"}
    assert {*row["truth"]} == keys
    assert {*row["mutual"]} == {*keys, "against"}
    assert {*row["lens"]} == {"fx", "fy", "distortion", "size"}
    for content in ("{}", "[]", '{"schema": "pcbench.experiment.gao/1"}', '{"schema": "pcbench.experiment.bend/1"}'):
        (tmp_path / "experiment.json").write_text(content)
        with check_error():
            KIND.read(tmp_path)


def test_cause_is_the_setting_that_changes_the_deformation(study):
    sentences = study.sentences
    check_text("\n".join(sentences))
    assert re.search(r"lens distortion.* 0\.3", sentences[0])
    assert "('no distortion' against 'true lens')" in sentences[0]
    assert any("0.5 and 0.5 px" in sentence for sentence in sentences)


def test_cause_follows_from_results(study):
    """Other factors for the same rows change the cause."""
    straight, dome, control = study.rows[:3]
    changed_factors = {**straight.factors, "images": "half"}
    rows = [straight, replace(dome, factors=changed_factors), replace(control, factors=straight.factors)]
    check_text(next(explain(rows[:2], "m")))

    def rows_with(**changes):
        return [replace(row, truth=replace(row.truth, **changes)) for row in rows]

    check_text(*explain(rows_with(verdict="none"), "m"))
    undecided = rows_with(verdict="none")
    undecided[1] = replace(rows[1], truth=replace(rows[1].truth, verdict="undecided"))
    assert "'no distortion'" in check_text(*explain(undecided, "m"))
    check_text(*explain(study.rows[3:], "m"))
    uncertain = rows_with(verdict="non-affine", ci=(0.0, 1.0))
    check_text(next(explain(uncertain[:2], "m")))


def test_verdicts_of_doubtful_registrations_are_conditional(study):
    def sentence_with(*names):
        rows = [
            replace(row, truth=replace(row.truth, conditional=True)) if row.name in names else row for row in study.rows
        ]
        doubtful = replace(study, rows=rows)
        verdicts = {line[0]: line[5] for line in table(doubtful)}
        assert all(("(?)" in verdict) == (name in names) for name, verdict in verdicts.items())
        assert "(?)" in " ".join(article(doubtful).sections[0].blocks[-1].text.split())
        return next(explain(rows, "m"))

    assert sentence_with() == study.sentences[0]
    check_text(sentence_with("no distortion"))
    measured = [row.name for row in study.rows if row.truth is not None]
    assert sentence_with(*measured).startswith("If the poses are right (the registrations are doubtful), the cause is ")


@pytest.fixture(scope="module")
def town():
    return build_city(CitySettings(extent=120.0, seed=3), texel=0.5)


def test_control_points_are_marked_well_inside_the_images(town):
    surface = MeshIndex(town.mesh)
    cameras = rig("drone", 18, Site(120.0, 0.0, town.plan.top), INTRINSICS)
    lines = list(_control_lines(cameras, surface, surface_cloud(town.plan, surface, cameras, 3000), 0))
    marks = np.array([line.split()[-2:] for line in lines], dtype=np.float64)
    assert len(marks) > 20
    margin = 0.05 * np.array([400, 300]) - 3  # 3: marks have an error of 0.5 pixels
    assert (marks > margin).all()
    assert (marks < [400, 300] - margin).all()


def test_no_evaluated_solution_is_an_error(study, run, monkeypatch, tmp_path):
    failed_study = replace(study, rows=study.rows[3:], sentences=tuple(explain(study.rows[3:], "m")))
    monkeypatch.setattr("pcbench.studies.bend.bend.run_bend", lambda *_, **__: StudyOutcome(failed_study))
    code, out, err = run("experiment", "bend", "--out", tmp_path)
    assert code == 2
    check_text(out)
    assert is_one_line(err)
    assert "none of 1 " in check_text(err)
    monkeypatch.setattr("pcbench.studies.bend.bend.run_bend", lambda *_, **__: StudyOutcome(study))
    assert run("experiment", "bend", "--out", tmp_path)[0] == 0


def test_table_and_csv(study):
    header, *lines = table(study)
    assert len(header) == len(lines[0]) == len(lines[3])
    assert lines[1][0] == "no distortion"
    assert lines[1][1:3] == ["12/12", "8,000"]
    assert lines[1][5] == "non-affine"
    assert lines[3][5] == "failed"
    assert list(failures(study)) == ["'every second' failed: nothing registers"]
    csv_rows = list(csv.DictReader(csv_text(study).splitlines()))
    assert [row["name"] for row in csv_rows] == [line[0] for line in lines]
    assert float(csv_rows[1]["truth_rms"]) == pytest.approx(study.rows[1].truth.rms)
    assert float(csv_rows[1]["truth_low"]) < float(csv_rows[1]["truth_rms"]) < float(csv_rows[1]["truth_high"])
    assert csv_rows[3]["failure"] == "nothing registers"


def test_intrinsics_error_ignores_focal_length():
    assert intrinsics_error(INTRINSICS, INTRINSICS) == pytest.approx(0, abs=1e-9)
    # Half the focal length with matching distortion: the same images of a flat scene from half the height.
    half_focal_length = replace(INTRINSICS, fx=175.0, fy=175.0, distortion=(-0.05 / 4, 0.0, 0.0, 0.0))
    assert intrinsics_error(half_focal_length, INTRINSICS) == pytest.approx(0, abs=1e-9)
    # By hand: k1 r^3 f minus its best multiple of r over the image, with r up to 0.71.
    u, v = np.meshgrid(np.linspace(-200, 200, 400) / 350, np.linspace(-150, 150, 300) / 350)
    r = np.hypot(u, v)
    displacements = 0.05 * r**3
    displacements = displacements - r * (displacements * r).sum() / (r * r).sum()
    # The true rays are slightly further out than their pixels.
    assert intrinsics_error(UNDISTORTED_INTRINSICS, INTRINSICS) == pytest.approx(
        350 * np.sqrt(np.mean(displacements**2)), rel=0.1
    )


def test_clouds_are_registered_by_rays(town):
    """Clouds in any frame are registered."""
    surface = MeshIndex(town.mesh)
    cameras = {c.name: c for c in rig("drone", 18, Site(120.0, 0.0, town.plan.top), INTRINSICS)}
    points = surface_cloud(town.plan, surface, list(cameras.values()), 3000).points
    frame = similarity_from_angles((20, 30, 40), (5, 6, 7), 0.1)
    solved_cameras = {name: transform_camera(camera, frame) for name, camera in cameras.items()}
    cloud = Cloud(
        frame.apply(points), attributes={"reprojection_error": np.ones(len(points)), "other": np.ones(len(points))}
    )
    registered = register_by_rays(cloud, solved_cameras, cameras, surface)
    error = np.linalg.norm(registered.points - points, axis=1)
    assert error.max() < 0.01  # occluded points are outliers among the pairs
    assert set(registered.attributes) == {"reprojection_error"}


def test_picture_is_drawn(study, tmp_path):
    import_or_skip("matplotlib")
    from PIL import Image

    from pcbench.studies.bend.figure import draw_bend

    draw_bend(study, tmp_path / "bend.png")
    with Image.open(tmp_path / "bend.png") as image:
        assert image.width > 1000
        assert np.asarray(image.convert("L")).std() > 10


@pytest.mark.long
def test_plot_draws_the_picture_again(study, run, tmp_path):
    import_or_skip("matplotlib")
    (tmp_path / "experiment.json").write_text(to_json(KIND.values(study)))
    for extension, start in ((".png", b"\x89PNG"), (".svg", b"<?xml")):
        picture = tmp_path / "figures" / f"bend{extension}"
        with drawing_here():
            assert run("plot", tmp_path, f"bend{extension}")[:2] == (0, f"{picture}\n")
        assert picture.read_bytes().startswith(start)


def test_solutions_without_deformation_stay_in_the_picture(study):
    import_or_skip("matplotlib")
    from matplotlib.figure import Figure

    from pcbench.studies.bend.figure import _draw_sizes

    rows = [replace(row, truth=replace(row.truth, rms=0.0, ci=(0.0, 0.5))) for row in study.rows[:1]] + [
        *study.rows[1:]
    ]
    axis = Figure().subplots()
    _draw_sizes(axis, rows, {row.name: "black" for row in rows}, "m")
    measured = [row for row in rows if row.truth is not None]
    assert len(axis.containers) == len(measured)
    lowest, highest = axis.get_ylim()
    heights = [container.lines[0].get_ydata()[0] for container in axis.containers]
    assert all(lowest < height < highest for height in heights)
    assert heights[0] == min(heights)


@pytest.mark.long
def test_small_deformations_have_a_panel_only_if_its_scale_is_finer(study, tmp_path, monkeypatch):
    import_or_skip("matplotlib")
    from pcbench.studies.bend import figure

    titles = []
    monkeypatch.setattr(figure, "_draw_growth", lambda *args: titles.append(args[-1]))
    figure.draw_bend(study, tmp_path / "bend.png")
    monkeypatch.setattr(figure, "_highest", lambda rows: 1.0)
    figure.draw_bend(study, tmp_path / "bend.png")
    assert ["Zoom" in title for title in titles] == [False, True, False]


def test_scene_without_truth_is_rejected(run, tmp_path):
    from PIL import Image

    Image.fromarray(np.zeros((30, 40, 3), np.uint8)).save(tmp_path / "a.png")
    for arguments in ((tmp_path,), (tmp_path, "--images", "20"), ("--size", "20")):
        code, _, err = run("experiment", "bend", *arguments, "--out", tmp_path / "out")
        assert code == 2
        check_text(err.partition(" (see ")[0])  # the rest depends on how pytest was started


@pytest.mark.slow
def test_repeated_experiment_reuses_its_runs(run, renderer, tmp_path):
    import_or_skip("pycolmap")
    code, out, err = run("experiment", "bend", "--out", tmp_path / "bend", "--images", "18", "--size", "480x360")
    assert code == 0, err
    assert f"report: {tmp_path / 'bend'}/ has report.html" in out
    study = KIND.read(tmp_path / "bend")
    rows = {row.name: row for row in study.rows}
    assert all(row.failure is None for row in rows.values())
    assert rows["no distortion"].truth.rms > 3 * rows["true lens"].truth.rms
    assert "lens distortion" in study.sentences[0]
    assert rows["true lens"].lens_error_px < 1e-6 < 1 < rows["no distortion"].lens_error_px
    assert len(read_scene(tmp_path / "bend/scene")) == 18
    first_bytes = (tmp_path / "bend/true-lens.ply").read_bytes()
    stamps = {path: path.stat().st_mtime_ns for path in (tmp_path / "bend/runs").glob("*/stage.json")}
    assert len(stamps) == len(rows)
    code, second_out, _ = run("experiment", "bend", "--out", tmp_path / "bend", "--images", "18", "--size", "480x360")
    assert (code, second_out) == (0, out)
    assert {path: path.stat().st_mtime_ns for path in stamps} == stamps
    assert (tmp_path / "bend/true-lens.ply").read_bytes() == first_bytes
