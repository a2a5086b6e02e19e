"""Each block of the documents is run and its output compared, or names the committed command that creates it."""

import contextlib
import io
import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from docs_blocks import Block, blocks, commands, matches
from optional import import_or_skip
from repository import ROOT
from task_pools import ThreadWorkers
from wording import check_error

from pcbench import cli
from pcbench.tasks import runner

# Their commands reconstruct scenes, or take more than two seconds for other reasons.
LONG_PAGES = {
    f"docs/howto/{name}.md"
    for name in (
        *("change", "checkpoints", "compare", "convert", "crop", "deformation", "field", "maps", "mvs", "plots"),
        *("python", "register", "repeat", "report", "scenes", "scripts", "splat", "stress", "synthetic", "tiles"),
        *("tradeoff", "views"),
    )
} | {"docs/reconstructors.md", "docs/tutorial.md"}
LONG_PAGES |= {
    f"docs/tutorials/{name}.md" for name in ("developer", "photogrammetrist", "researcher", "robotics", "surveyor")
}
RECORDS = ROOT / "docs" / "trials"  # what was printed on a day
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
PAGES = [page for page in PAGES if not page.is_relative_to(RECORDS)]
SHELL_COMMANDS = "cat", "head", "ls"  # commands that a console block may call in addition to pcbench

# Commands that create the inputs of several pages; each is run once.
SHARED_COMMANDS = (
    "pcbench demo --points 200000 --no-bench --no-figures --out demo",
    "pcbench synth city --images 12 --size 240x160 --extent 100 --points 20000 --out city",
)


def _name(page: Path) -> str:
    return str(page.relative_to(ROOT))


def _call(command: str, folder: Path) -> str:
    """Return the standard output and standard error of a command, which must succeed."""
    words = shlex.split(command)
    if words[0] in SHELL_COMMANDS:
        environment = {**os.environ, "LC_ALL": "C"}  # the order of names depends on the language
        return subprocess.run(words, cwd=folder, env=environment, check=True, capture_output=True, text=True).stdout
    assert words[0] == "pcbench", (
        f"expected a command of pcbench or one of {', '.join(SHELL_COMMANDS)}; got {command!r}"
    )
    output = io.StringIO()
    with contextlib.chdir(folder), contextlib.redirect_stdout(output), contextlib.redirect_stderr(output):
        try:
            sys.argv, argv = words, sys.argv
            cli.main()
        except SystemExit as stop:
            assert not stop.code, f"{command}: {output.getvalue()}"
        finally:
            sys.argv = argv
    return output.getvalue()


@pytest.fixture(scope="module")
def call(tmp_path_factory):
    """Run a command of a page in a folder; commands in SHARED are run once and their results copied."""
    outputs = {}

    def run(command: str, folder: Path) -> str:
        if command not in SHARED_COMMANDS:
            return _call(command, folder)
        if command not in outputs:
            home = tmp_path_factory.mktemp("shared")
            outputs[command] = home, _call(command, home)
        home, output = outputs[command]
        shutil.copytree(home, folder, dirs_exist_ok=True)
        return output

    return run


@pytest.mark.parametrize(
    "page",
    [
        pytest.param(page, marks=[pytest.mark.long] if page.relative_to(ROOT).as_posix() in LONG_PAGES else [])
        for page in PAGES
    ],
    ids=_name,
)
def test_output_on_page_matches(page, call, tmp_path, request, monkeypatch):
    page_blocks = blocks(page)
    executed = [block for block in page_blocks if block.mark is None]
    if any("synth city" in block.text for block in executed):
        request.getfixturevalue("renderer")
    if any("off_screen" in block.text or "--screenshot" in block.text for block in executed):
        request.getfixturevalue("off_screen")
    if any(f"reconstruct {name}" in block.text for block in executed for name in ("sfm", "mvs")):
        import_or_skip("pycolmap")
    monkeypatch.setenv("COLUMNS", "132")
    if _name(page) not in LONG_PAGES:  # long pages start processes
        monkeypatch.setattr(runner, "_start", ThreadWorkers)
    namespace, output = {"__name__": "__main__"}, ""
    for block in page_blocks:
        location = f"{_name(page)}:{block.line}"
        if block.title is not None:
            (tmp_path / block.title).write_text(block.text)
        elif block.mark is not None:
            _check_mark(block, location)
        elif block.language == "console":
            for command, expected in commands(block):
                computed = call(command, tmp_path)
                assert not expected or matches(expected, computed), (
                    f"{location}: {command}\nshown:\n{expected}\nprinted:\n{computed}"
                )
        elif block.language == "python":
            stdout = io.StringIO()
            with contextlib.chdir(tmp_path), contextlib.redirect_stdout(stdout):
                exec(compile(block.text, location, "exec"), namespace)
            output = stdout.getvalue()
        elif block.language == "text" and block.follows:
            assert matches(block.text, output), f"{location}\nshown:\n{block.text}\nprinted:\n{output}"
        else:
            pytest.fail(f"{location}: neither run nor marked, see tests/docs_blocks.py")


def _check_mark(block: Block, location: str) -> None:
    kind, target = block.mark
    if kind == "checked by":
        file, function = target.split("::")
        assert f"def {function}(" in (ROOT / file).read_text(), f"{location}: no {target}"
    elif kind == "part of":
        lines = {" ".join(line.split()) for line in (ROOT / target).read_text().splitlines()}
        for line in block.text.splitlines():
            assert " ".join(line.split()) in lines | {""}, f"{location}: {line!r} is not in {target}"
    else:
        _check_command(target, location)


def _check_command(command: str, location: str) -> None:
    """Check that a target of the Makefile, a script of the repository or a pcbench command has these options."""
    words = shlex.split(command)
    if words[0] == "make":
        assert re.search(rf"^{re.escape(words[1])}:", (ROOT / "Makefile").read_text(), re.MULTILINE), (
            f"{location}: no target {words[1]}"
        )
        return
    if words[0] == "python":
        text = (ROOT / words[1]).read_text()
    else:
        assert words[0] == "pcbench", f"{location}: expected make, python or pcbench; got {command!r}"
        text = _call(" ".join([*_command_words(words), "--help"]), ROOT)
    for option in (word for word in words if word.startswith("--")):
        assert option in text, f"{location}: {words[0]} {words[1]} has no option {option}"


def _command_words(words: list[str]) -> list[str]:
    return words[: 3 if words[1] in ("synth", "experiment") else 2]


@pytest.mark.long
def test_commands_of_the_readme(call, tmp_path):
    """The comparison of the README works on any clouds of these names, and its make target exists."""
    call(SHARED_COMMANDS[0], tmp_path)
    for name, cloud in (("ref", "densified"), ("a", "sparse"), ("b", "sparse")):  # the dense reference takes long
        shutil.copy(tmp_path / "demo" / "clouds" / f"{cloud}.ply", tmp_path / f"{name}.ply")
    (block,) = (b for b in blocks(ROOT / "README.md") if b.mark and b.mark[1].endswith("test_commands_of_the_readme"))
    make, compare = (command.partition("#")[0].strip() for command, _ in commands(block))
    _check_command(make, "README.md")
    assert "report: report" in call(f"{compare.removeprefix('.venv/bin/')} --no-figures", tmp_path)


def test_targets_of_make():
    for block in blocks(ROOT / "CONTRIBUTING.md"):
        for command, _ in commands(block):
            make, *targets = command.partition("#")[0].split()
            assert make == "make"
            for target in targets:
                _check_command(f"make {target}", "CONTRIBUTING.md")


@pytest.mark.slow
def test_table_of_readme_matches_demo(tmp_path):
    """The demo runs at its full size, as in the README."""
    (expected,) = (b.text for b in blocks(ROOT / "README.md") if b.mark == ("made by", "pcbench demo --out demo"))
    assert matches(expected, _call("pcbench demo --out demo --no-bench --no-figures", tmp_path))


@pytest.mark.parametrize(
    "expected, computed, is_match",
    [
        ("a 1.234  b", "a 1.235 b", True),  # one in the last digit
        ("a 1,234 b", "a 1,300 b", False),
        ("0 of 418 tiles", "4 of 418 tiles", False),
        ("took ... s", "took 12.3 s", True),
        ("1.50 none", "1.50 affine", False),
    ],
)
def test_output_matches_with_tolerance_in_last_digit(expected, computed, is_match):
    assert matches(expected, computed) is is_match


def test_block_without_mark_is_an_error(call, tmp_path, request, monkeypatch):
    page = SimpleNamespace(read_text=lambda: "```text\nnot marked\n```\n", relative_to=lambda root: "page.md")
    with check_error(pytest.fail.Exception):
        test_output_on_page_matches(page, call, tmp_path, request, monkeypatch)


def test_readme_is_short():
    """The README gives an overview in a minute; details are on other pages."""
    assert len((ROOT / "README.md").read_text().splitlines()) <= 125


def test_the_readme_lists_all_commands_for_tasks():
    """Commands that only describe or draw are named on the pages of the tasks."""
    table = (ROOT / "README.md").read_text().partition("## What can it do?")[2].partition("##")[0]
    tasks = cli.app.commands.keys() - {"demo", "info", "plot", "plugins", "scene", "views"}
    assert [name for name in sorted(tasks) if f"`pcbench {name}`" not in table] == []


def test_links_and_pictures_exist():
    """mkdocs checks the links between its pages; these two files are not among them."""
    for page in (ROOT / "README.md", ROOT / "CONTRIBUTING.md"):
        for target in re.findall(r"\]\(([^)#]+?)(?:#[^)]*)?\)", page.read_text()):
            assert target.startswith("http") or (ROOT / target).exists(), f"{_name(page)}: no {target}"
