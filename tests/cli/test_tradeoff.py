"""The command `pcbench tradeoff`: its output, --json, and errors of one line."""

import json

from command_line import is_one_line
from wording import check_text

ONLY = ("--only", "random both", "--levels", "50%", "--seeds", 3)


def test_the_answer_comes_first_and_the_folder_repeats_its_runs(files, run):
    command = ("tradeoff", "b.ply", "a.ply", *ONLY, "--out", "t", "--no-figures")
    code, out, err = run(*command, "--tolerance", "400%")
    assert code == 2 and is_one_line(err)
    code, out, _ = run(*command, "--tolerance", "1e-3")
    assert code == 0
    assert out.startswith("Nothing cheaper keeps every mean distance")
    assert "report: t/" in out
    assert {"tradeoff.md", "tradeoff.csv", "tradeoff.json"} <= {path.name for path in (files / "t").iterdir()}
    code, out, _ = run(*command, "--tolerance", "1e-3", "--json", "-")
    assert code == 0
    study = json.loads(out)
    assert study["schema"] == "pcbench.tradeoff/1"
    assert [row["name"] for row in study["rows"]] == ["random both 50 %"]
    assert study["rows"][0]["errors"]["mean c→r"][0] > 0


def test_errors_are_one_line(files, run):
    for arguments in (
        ("missing.ply", "a.ply"),
        ("ref.ply", "a.ply", "--tolerance", "small"),
        ("ref.ply", "a.ply", "--levels", "50%,x"),
        ("ref.ply", "a.ply", "--only", "nothing"),
        ("ref.ply", "a.ply", "--out", "."),
    ):
        code, out, err = run("tradeoff", *arguments)
        assert code == 2 and out == "" and is_one_line(err), err
        check_text(err)
