"""`make measured` writes what commands print into the pages, once for each state of the code that they import."""

import json
import re
import tomllib
from pathlib import Path
from types import SimpleNamespace

import pytest
from repository import ROOT

COMMAND = "python benchmarks/speed.py --runs 2"
PAGE = f"# Speed\n\n<!-- made by: {COMMAND} -->\n```text\nold\n```\n\nEnd of the page.\n"
SCRIPT = """
import sys
import tempfile
import kernel
print("table of", kernel.VALUE, sys.argv[1:])
with tempfile.TemporaryDirectory() as folder:
    print("in", folder + "/study")
"""
BLOCKS = """
import os
print("commit 1234567\\n\\nnear\\na\\nb\\n\\n   far\\nthreads", os.environ.get("OMP_NUM_THREADS"))
"""


@pytest.fixture
def docs(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "docs")
    import remeasure
    import stale_tables
    import written_tables

    monkeypatch.setattr(remeasure, "_QUIET_WAIT_S", 0.0)
    monkeypatch.setattr(remeasure, "_QUIET_POLL_S", 0.0)
    return remeasure, written_tables, stale_tables


@pytest.fixture
def site_hooks(docs):
    import site_hooks

    return site_hooks


@pytest.fixture
def root(tmp_path, docs, monkeypatch):
    """A project with a page, a script and the module that it measures."""
    for folder in ("docs/measured", "benchmarks"):
        (tmp_path / folder).mkdir(parents=True)
    (tmp_path / "docs/measured/speed.md").write_text(PAGE)
    (tmp_path / "docs/measured/commands.toml").write_text(f'[timings]\n"{COMMAND}" = 1\n')
    (tmp_path / "benchmarks/speed.py").write_text(SCRIPT)
    (tmp_path / "benchmarks/kernel.py").write_text("VALUE = 7\n")
    (tmp_path / "README.md").touch()
    monkeypatch.setattr(docs[0], "ROOT", tmp_path)
    return tmp_path


def remeasure(docs, monkeypatch, *options):
    monkeypatch.setattr("sys.argv", ["remeasure.py", *options])
    return docs[0].main()


def page(root):
    return (root / "docs/measured/speed.md").read_text()


def test_a_table_is_written_until_its_code_is_the_same(docs, site_hooks, root, monkeypatch, capsys):
    """Comments of the code do not count, and tables of other words are left alone."""

    def shown():
        return site_hooks.on_page_markdown(page(root), page=SimpleNamespace(file=SimpleNamespace(src_uri="speed.md")))

    monkeypatch.setattr(site_hooks, "_ROOT", root)
    assert remeasure(docs, monkeypatch, "--only", "tiles") == 0 and page(root) == PAGE
    assert "has not written it yet.*\n\nEnd of the page." in shown()
    assert remeasure(docs, monkeypatch) == 0
    assert page(root) == PAGE.replace("old", "table of 7 ['--runs', '2']\nin study")
    (record,) = (root / "docs/measured/runs").iterdir()
    assert json.loads(record.read_text())["lines"] == ["table of 7 ['--runs', '2']", "in study"]
    run = docs[1].read_run(root, COMMAND)
    assert {"benchmarks/speed.py", "benchmarks/kernel.py"} <= set(run.code)
    (root / "benchmarks/kernel.py").write_text("VALUE = 7  # as always\n")
    capsys.readouterr()
    remeasure(docs, monkeypatch, "--only", "speed")
    assert capsys.readouterr().out.startswith("0 commands, ")
    (root / "benchmarks/kernel.py").write_text("VALUE = 80\n")
    (finding,) = docs[2].findings(root)
    assert "1 of" in finding and "(benchmarks/kernel.py)" in finding
    assert "```\n\n*Commit " in shown() and "has changed since.*\n\nEnd of the page." in shown()
    remeasure(docs, monkeypatch)
    assert "table of 80" in page(root) and not list(docs[2].findings(root))


def test_one_run_fills_tables_on_several_pages(docs, root, monkeypatch, capsys):
    """A table that ends in `...` keeps its length; a block that the command does not print is an error."""
    near, far, whole = (
        f"<!-- made by: {COMMAND}{block} -->\n```text\n{old}\n```\n"
        for block, old in ((" | near", "old\nold\n..."), (" | far", "old"), ("", "old\n..."))
    )
    (root / "docs/measured/speed.md").write_text(far)
    (root / "README.md").write_text(near + "\nand\n\n" + whole)
    (root / "docs/measured/commands.toml").write_text(f'[scores]\n"{COMMAND}" = 90\n')
    (root / "benchmarks/speed.py").write_text(BLOCKS)
    assert remeasure(docs, monkeypatch) == 0
    assert capsys.readouterr().out.splitlines()[1] == "1 commands, 1 min: 0 for timings, 1 for the others"
    assert page(root) == far.replace("old", "   far\nthreads 1")
    near = near.replace("old\nold", "near\na")
    assert (root / "README.md").read_text() == near + "\nand\n\n" + whole.replace("old", "commit 1234567")
    (root / "docs/measured/speed.md").write_text(near.replace("near\na", "old\nold"))
    assert remeasure(docs, monkeypatch) == 0 and page(root) == near  # from the stored run
    (root / "docs/measured/speed.md").write_text(far.replace("far", "middle"))
    assert remeasure(docs, monkeypatch, "--again") == 1
    assert "starts with 'middle'; the command printed 'commit 1234567', 'near', 'far'" in capsys.readouterr().out


@pytest.mark.parametrize(
    "script, reason",
    [
        ("raise SystemExit('no disk')", "exit code 1: no disk"),
        ("print('a; missing: a peer')", "a peer is needed: missing: a peer"),
        ("import time; time.sleep(60)", "longer than its limit of 1 s"),
    ],
)
def test_a_command_that_fails_changes_nothing(docs, root, monkeypatch, capsys, script, reason):
    monkeypatch.setattr(docs[0], "_LEAST_LIMIT_S", 0.0 if "sleep" in script else 60.0)
    monkeypatch.setattr(docs[0], "_LIMIT_FACTOR", 1.0)
    (root / "benchmarks/speed.py").write_text(script)
    assert remeasure(docs, monkeypatch) == 1
    assert reason in capsys.readouterr().out
    assert page(root) == PAGE and not (root / "docs/measured/runs").exists()


def test_quoted_figures_are_compared_with_their_run(docs, root, monkeypatch, capsys):
    remeasure(docs, monkeypatch)
    (root / "README.md").write_text("It takes\n7.0 s, and 8 s.\n")
    figures = [["takes ([0-9.]+) s", "speed", "of (.)", "first"], ["and (.) s", "speed", "of (.)", "largest"]]
    (root / "docs/measured/quoted.toml").write_text(
        f'runs = {{speed = "{COMMAND}"}}\n[figures]\n"README.md" = {json.dumps(figures)}\n'
    )
    (finding,) = docs[2].findings(root)
    assert finding.startswith("README.md: 8 in 'and (.) s' is 7 in the last run")


@pytest.mark.parametrize("folder", [ROOT, Path("/home/pcbench"), Path("/tests/pcbench/benchmarks")])
def test_code_of_compiled_modules_is_their_source(docs, folder):
    """The folder of the repository may have the name of a package."""
    site = folder / ".venv/lib/python3/site-packages"
    files = docs[0].code_files(ROOT, [str(site / "reconstructors/splat/cpu/_rasterizer.so"), str(site / "numpy/a.so")])
    assert {"reconstructors/splat/cpu/rasterizer.cpp", "reconstructors/splat/maths.h"} <= set(files)
    assert not [name for name in files if name.endswith(".py")]
    assert docs[0].code_files(ROOT, [str(site / "numpy/a.so")]) == []


def test_each_command_has_its_cost_and_all_fit_into_an_afternoon(docs):
    commands = {table.command for table in docs[1].tables(ROOT)}
    costs = docs[1].read_costs(ROOT)
    assert commands == set(costs)
    assert len({docs[1]._record(ROOT, command) for command in commands}) == len(commands)
    assert not [command for command in commands if re.search(r"\b[A-Z]{3,}\b", command)]  # a folder of one person
    seconds = tomllib.loads((ROOT / docs[1].COMMANDS).read_text())  # runs beside other work take longer
    assert sum(seconds["timings"].values()) + sum(seconds["scores"].values()) / 2 < 3 * 3600


def test_tables_of_the_pages_are_those_of_their_runs(docs):
    """Nobody edits them by hand; a table whose command has no stored run is not checked."""
    _, written_tables, _ = docs
    runs = [run for table in written_tables.tables(ROOT) if (run := written_tables.read_run(ROOT, table.command))]
    for page in written_tables.pages(ROOT):
        text = page.read_text()
        for run in runs:
            assert run.command not in text or written_tables.with_lines(text, run) == text, f"{page}: {run.command}"


def test_quoted_figures_of_the_pages_are_those_of_the_runs(docs):
    from quoted_figures import QUOTED, differing_figures

    names = tomllib.loads((ROOT / QUOTED).read_text())["runs"].values()
    assert set(names) <= {table.command for table in docs[1].tables(ROOT)}
    assert list(differing_figures(ROOT)) == []
