"""The command `pcbench evaluate`: one pair, a table of methods, --json, exit codes and errors of one line."""

import json
import re

from command_line import is_one_line, without_progress
from wording import check_text

from pcbench.cli.evaluate import evaluate
from pcbench.measure.protocols.registry import PROTOCOLS

FAST = ("--protocol", "open3d", "--workers", 1)


def test_one_pair_prints_its_scores(files, run):
    code, out, err = run("evaluate", "ref.ply", "a.ply", "--protocol", "open3d:thresholds=0.1")
    assert code == 0 and without_progress(err) == ""
    assert out.startswith("chamfer ")
    check_text(out)


def test_methods_and_scenes_are_a_table(files, run):
    for scene, name in (("x", "a.ply"), ("y", "b.ply")):
        for folder in ("gt", "one", "two"):
            (files / folder).mkdir(exist_ok=True)
            (files / folder / f"{scene}.ply").write_bytes(
                (files / ("ref.ply" if folder == "gt" else name)).read_bytes()
            )
    (files / "two" / "y.ply").write_bytes((files / "ref.ply").read_bytes())
    command = ("evaluate", "gt/{scene}.ply", "one/{scene}.ply", "two/{scene}.ply", *FAST, "--no-figures")
    code, out, err = run(*command, "--out", "t", "--columns", "hausdorff")
    assert code == 0, err
    check_text(out)
    names = {path.name for path in (files / "t").iterdir()}
    assert {
        "report.html",
        "evaluate.md",
        "evaluate.tex",
        "evaluate.csv",
        "means.csv",
        "evaluate.json",
        "pairs",
    } <= names
    (files / "one" / "y.ply").unlink()
    code, out, err = run(*command, "--out", "t", "--columns", "hausdorff,nothing")
    assert (code, out) == (2, "")
    check_text(without_progress(err))
    code, out, _ = run(*command, "--out", "t", "--columns", "hausdorff", "--json", "all.json")
    assert code == 4
    check_text(out)
    study = json.loads((files / "all.json").read_text())
    assert [pair["status"] for pair in study["pairs"]] == ["ok", "ok", "missing", "ok"]
    assert study["means"][0]["scenes"] == 1


def test_errors_are_one_line(files, run):
    (files / "pairs.csv").write_text("reference,candidate\nref.ply,nothing.ply\n")
    for arguments in (
        (),
        ("ref.ply",),
        ("missing.ply", "a.ply"),
        ("ref.ply", "missing.ply"),
        ("ref.ply", "a.ply", "--protocol", "nothing"),
        ("ref.ply", "a.ply", "--protocol", "open3d:thresholds=x"),
        ("ref.ply", "a.ply", "--protocol-data", "nowhere"),
        ("ref.ply", "a.ply", "--register", "matrix:none.txt"),
        ("ref.ply", "a.ply", "--crop", "box:1"),
        ("ref.ply", "a.ply", "--json", "a.ply"),
        ("ref.ply", "a.ply", "--out", "."),
        ("--pairs", "none.csv"),
        ("--pairs", "pairs.csv"),
        ("--pairs", "pairs.csv", "ref.ply"),
        ("ref.ply", "a.ply", "--metric", "far.py:far", "--protocol", "open3d"),
        ("ref.ply", "a.ply", "--metric", "fscore@0.1", "--protocol", "pdal"),
        ("ref.ply", "a.ply", "--columns", "nothing", "--protocol", "open3d", "-q"),
    ):
        code, out, err = run("evaluate", *arguments)
        assert code == 2 and out == "" and is_one_line(err), (arguments, err)
        check_text(err)


def test_conditions_and_user_defined_metrics(files, run):
    (files / "far.py").write_text("def far(pair):\n    return float(pair.accuracy.distances.max())\n")
    conditions = ("--fail-if", "own.far > 0", "--fail-if", "chamfer > 1e9", "--fail-if", "d1_rms.c2r > 0")
    code, out, err = run("evaluate", "ref.ply", "a.ply", "--metric", "far.py:far", *conditions)
    assert code == 3
    far, largest = (float(re.search(rf"{name} +(\S+)", out)[1]) for name in (r"own\.far", "hausdorff"))
    assert 0 < far <= largest
    assert [line.split("'")[1] for line in without_progress(err).splitlines()] == ["own.far > 0", "d1_rms.c2r > 0"]
    (files / "far.py").write_text("def far(pair):\n    return 1 / 0\n")
    code, out, err = run("evaluate", "ref.ply", "a.ply", "--metric", "far.py:far", "--columns", "own.far.x", "-q")
    assert (code, out) == (4, "")
    check_text(err)


def test_the_json_replaces_no_input(files, run):
    table, metric = files / "pairs.csv", files / "own.py"
    table.write_text("reference,candidate\nref.ply,a.ply\n")
    metric.write_text("def one(pair): return 1.0\n")
    for file in (table, metric):
        before = file.read_text()
        code, _, err = run("evaluate", "--pairs", table, "--metric", f"{metric}:one", "--json", file)
        assert code == 2 and "replace an input" in err and file.read_text() == before


def test_the_help_names_all_protocols():
    help_text = next(option.help for option in evaluate.params if option.name == "protocol")
    assert set(PROTOCOLS) <= set(re.findall(r"[\w-]+", help_text))
