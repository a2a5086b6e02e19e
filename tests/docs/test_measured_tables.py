"""`make measured` writes what commands print into the pages, once for each state of the code that they import."""

import json
from types import SimpleNamespace

import pytest
from repository import ROOT

COMMAND = "python benchmarks/speed.py --runs 2"
PAGE = f"# Speed\n\n<!-- made by: {COMMAND} -->\n```text\nold\n```\n\nEnd of the page.\n"
SCRIPT = """
import sys
import kernel
print("table of", kernel.VALUE, sys.argv[1:])
print()
"""


@pytest.fixture
def docs(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "docs")
    import remeasure
    import stale_tables
    import written_tables

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
    assert remeasure(docs, monkeypatch, "--only", "tiles") == 0 and page(root) == PAGE
    assert remeasure(docs, monkeypatch) == 0
    assert page(root) == PAGE.replace("old", "table of 7 ['--runs', '2']")
    (record,) = (root / "docs/measured/runs").iterdir()
    assert json.loads(record.read_text())["lines"] == ["table of 7 ['--runs', '2']"]
    run = docs[1].read_run(root, COMMAND)
    assert {"benchmarks/speed.py", "benchmarks/kernel.py"} <= set(run.code)
    (root / "benchmarks/kernel.py").write_text("VALUE = 7  # as always\n")
    remeasure(docs, monkeypatch, "--only", "speed")
    assert ": current, " in capsys.readouterr().out
    (root / "benchmarks/kernel.py").write_text("VALUE = 80\n")
    (measurement,) = docs[2].all_measurements(root)
    assert "1 of" in docs[2].status(measurement, root) and "(benchmarks/kernel.py)" in docs[2].status(measurement, root)
    monkeypatch.setattr(site_hooks, "_ROOT", root)
    shown = site_hooks.on_page_markdown(page(root), page=SimpleNamespace(file=SimpleNamespace(src_uri="speed.md")))
    assert "```\n\n*Commit " in shown and "has changed since.*\n\nEnd of the page." in shown
    remeasure(docs, monkeypatch)
    assert "table of 80" in page(root) and docs[2].status(*docs[2].all_measurements(root), root) is None


@pytest.mark.parametrize(
    "script, reason",
    [
        ("raise SystemExit('no disk')", "exit code 1: no disk"),
        ("print('a; missing: a peer')", "a peer is needed: missing: a peer"),
        ("import time; time.sleep(60)", "longer than its limit of 1 s"),
    ],
)
def test_a_command_that_fails_changes_nothing(docs, root, monkeypatch, capsys, script, reason):
    monkeypatch.setattr(docs[0], "_FIRST_LIMIT_S", 1.0 if "sleep" in script else 60.0)
    (root / "benchmarks/speed.py").write_text(script)
    assert remeasure(docs, monkeypatch) == 1
    assert reason in capsys.readouterr().out
    assert page(root) == PAGE and not (root / "docs/measured/runs").exists()


def test_code_of_compiled_modules_is_their_source(docs):
    site = ROOT / ".venv/lib/python3/site-packages"
    files = docs[0].code_files(ROOT, [str(site / "reconstructors/splat/cpu/_rasterizer.so"), str(site / "numpy/a.so")])
    assert {"reconstructors/splat/cpu/rasterizer.cpp", "reconstructors/splat/maths.h"} <= set(files)
    assert not [name for name in files if name.endswith(".py")]


def test_commands_of_several_tables_and_of_unknown_folders_are_left_to_people(docs):
    commands = [table.command for table in docs[1].tables(ROOT)]
    assert "python benchmarks/compare.py --runs 3" in commands and len(set(commands)) == len(commands)
    assert not [command for command in commands if "FOLDER" in command]
