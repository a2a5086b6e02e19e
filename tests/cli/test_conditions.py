"""--fail-if: a separate exit code after the outputs, a line per condition, and refusals before the long work."""

import json
from pathlib import Path

import pytest
from command_line import is_one_line, without_progress
from wording import check_text


def test_a_condition_that_holds_has_its_own_exit_code(files, run):
    code, out, err = run("compare", "ref.ply", "a.ply", "b.ply", "--json", "-", "--fail-if", "d2_rms.c2r > 0.01")
    assert code == 3
    numbers = {c["name"]: c["metrics"]["d2_rms"]["candidate_to_reference"] for c in json.loads(out)["candidates"]}
    line = without_progress(err).splitlines()[-1]
    assert all(f"{name}: d2_rms.c2r = {value:.6g}" in line for name, value in numbers.items())
    check_text(line)


def test_the_report_is_written_before_and_each_condition_has_a_line(files, run):
    conditions = ("--fail-if", "d2_rms.c2r > 1%", "--fail-if", "points < 1000", "--fail-if", "points > 1e9")
    code, out, err = run("compare", "ref.ply", "a.ply", "b.ply", "--out", "r", "--no-figures", "-q", *conditions)
    assert (code, out) == (3, "")
    first, second = err.splitlines()
    assert "a: " in first and "b: " in first
    assert "b: points = 700" in second and "a: " not in second
    assert Path("r/comparison.json").is_file()


def test_without_a_failure_nothing_changes(files, run):
    assert run("compare", "ref.ply", "a.ply", "-q", "--fail-if", "d2_rms.c2r > 100")[0::2] == (0, "")


@pytest.mark.parametrize("condition", ["d2_rsm.c2r > 0.2", "d2_rms.c2r > 0.2 or", "d2_rms > 0.2"])
def test_a_mistake_is_refused_before_the_work(files, run, condition):
    code, out, err = run("compare", "ref.ply", "a.ply", "--out", "r", "--fail-if", condition)
    assert (code, out, is_one_line(err)) == (2, "", True), err
    assert not Path("r").exists()


def test_conditions_on_an_untested_deformation_are_refused_before_the_work(files, run):
    options = ("--no-deformation", "--out", "r", "--fail-if", "points > 1e9 or deformation.amplitude.rms > 0.1")
    code, out, err = run("compare", "ref.ply", "a.ply", *options)
    assert (code, out, is_one_line(err)) == (2, "", True), err
    check_text(err)
    assert not Path("r").exists()


def test_check_points_and_changes_have_conditions(files, run):
    Path("points.csv").write_text("name,x,y,z\np1,0,0,0.1\np2,5,5,0.2\np3,-8,9,0.1\n")
    condition = "every.errors.rmse > 1 mm"
    assert run("checkpoints", "ref.ply", "points.csv", "--fail-if", condition)[0] == 2  # numbers have no unit
    code, _, err = run("checkpoints", "ref.ply", "points.csv", "-q", "--fail-if", "points[p2].dz < 100")
    assert code == 3 and err.count("\n") == 1
    code, _, err = run("change", "ref.ply", "a.ply", "-q", "--fail-if", "whole.volumes.net[0] > -1e9")
    assert code == 3 and "a: whole.volumes.net[0] = " in err
    for command in ("checkpoints ref.ply points.csv", "change ref.ply a.ply"):
        code, out, err = run(*command.split(), "--fail-if", "whole.nett > 1")
        assert (code, out, is_one_line(err)) == (2, "", True), err
