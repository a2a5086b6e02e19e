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
from wording import check_error

from pcbench import cli

PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
SHELL = "cat", "head", "ls"  # commands that a console block may call in addition to pcbench

# Commands that create the inputs of several pages; each is run once.
SHARED = (
    "pcbench demo --points 200000 --no-bench --no-figures --out demo",
    "pcbench synth city --images 12 --size 240x160 --extent 100 --points 20000 --out city",
)


def _name(page: Path) -> str:
    return str(page.relative_to(ROOT))


def _call(command: str, folder: Path) -> str:
    """Return the standard output and standard error of a command, which must succeed."""
    words = shlex.split(command)
    if words[0] in SHELL:
        environment = {**os.environ, "LC_ALL": "C"}  # the order of names depends on the language
        return subprocess.run(words, cwd=folder, env=environment, check=True, capture_output=True, text=True).stdout
    assert words[0] == "pcbench", f"expected a command of pcbench or one of {', '.join(SHELL)}; got {command!r}"
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
    shared = {}

    def run(command: str, folder: Path) -> str:
        if command not in SHARED:
            return _call(command, folder)
        if command not in shared:
            home = tmp_path_factory.mktemp("shared")
            shared[command] = home, _call(command, home)
        home, output = shared[command]
        shutil.copytree(home, folder, dirs_exist_ok=True)
        return output

    return run


@pytest.mark.parametrize("page", PAGES, ids=_name)
def test_output_on_page_matches(page, call, tmp_path, request, monkeypatch):
    found = blocks(page)
    runs = [block for block in found if block.mark is None]
    if any("synth city" in block.text for block in runs):
        request.getfixturevalue("renderer")
    if any(f"reconstruct {name}" in block.text for block in runs for name in ("sfm", "mvs")):
        import_or_skip("pycolmap")
    monkeypatch.setenv("COLUMNS", "132")
    namespace, output = {"__name__": "__main__"}, ""
    for block in found:
        where = f"{_name(page)}:{block.line}"
        if block.title is not None:
            (tmp_path / block.title).write_text(block.text)
        elif block.mark is not None:
            _check_mark(block, where)
        elif block.language == "console":
            for command, shown in commands(block):
                printed = call(command, tmp_path)
                assert not shown or matches(shown, printed), f"{where}: {command}\nshown:\n{shown}\nprinted:\n{printed}"
        elif block.language == "python":
            stdout = io.StringIO()
            with contextlib.chdir(tmp_path), contextlib.redirect_stdout(stdout):
                exec(compile(block.text, where, "exec"), namespace)
            output = stdout.getvalue()
        elif block.language == "text" and block.follows:
            assert matches(block.text, output), f"{where}\nshown:\n{block.text}\nprinted:\n{output}"
        else:
            pytest.fail(f"{where}: neither run nor marked, see tests/docs_blocks.py")


def _check_mark(block: Block, where: str) -> None:
    kind, what = block.mark
    if kind == "checked by":
        file, function = what.split("::")
        assert f"def {function}(" in (ROOT / file).read_text(), f"{where}: no {what}"
    elif kind == "part of":
        lines = {" ".join(line.split()) for line in (ROOT / what).read_text().splitlines()}
        for line in block.text.splitlines():
            assert " ".join(line.split()) in lines | {""}, f"{where}: {line!r} is not in {what}"
    else:
        _check_command(what, where)


def _check_command(command: str, where: str) -> None:
    """Check that a target of the Makefile, a script of the repository or a pcbench command has these options."""
    words = shlex.split(command)
    if words[0] == "make":
        assert re.search(rf"^{re.escape(words[1])}:", (ROOT / "Makefile").read_text(), re.MULTILINE), (
            f"{where}: no target {words[1]}"
        )
        return
    if words[0] == "python":
        text = (ROOT / words[1]).read_text()
    else:
        assert words[0] == "pcbench", f"{where}: expected make, python or pcbench; got {command!r}"
        text = _call(" ".join([*_names(words), "--help"]), ROOT)
    for option in (word for word in words if word.startswith("--")):
        assert option in text, f"{where}: {words[0]} {words[1]} has no option {option}"


def _names(words: list[str]) -> list[str]:
    return words[: 3 if words[1] in ("synth", "experiment") else 2]


def test_commands_of_the_readme(call, tmp_path):
    """The first command of the README works on any clouds of these names, and its make targets exist."""
    call(SHARED[0], tmp_path)
    for name, made in (("ref", "reference"), ("a", "sparse"), ("b", "densified")):
        (tmp_path / "demo" / "clouds" / f"{made}.ply").rename(tmp_path / f"{name}.ply")
    marked = [b for b in blocks(ROOT / "README.md") if b.mark and b.mark[1].endswith("test_commands_of_the_readme")]
    (compare,), makes = (commands(block) for block in marked)
    assert "report: report" in call(f"{compare[0]} --no-figures", tmp_path)
    for command, _ in makes:
        _check_command(command.partition("#")[0], "README.md")


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
    (shown,) = (b.text for b in blocks(ROOT / "README.md") if b.mark == ("made by", "pcbench demo --out demo"))
    assert matches(shown, _call("pcbench demo --out demo --no-bench --no-figures", tmp_path))


@pytest.mark.parametrize(
    "shown, printed, same",
    [
        ("a 1.234  b", "a 1.235 b", True),  # one in the last digit
        ("a 1,234 b", "a 1,300 b", False),
        ("0 of 418 tiles", "4 of 418 tiles", False),
        ("took ... s", "took 12.3 s", True),
        ("1.50 none", "1.50 affine", False),
    ],
)
def test_comparison_of_shown_and_printed_text(shown, printed, same):
    assert matches(shown, printed) is same


def test_block_without_mark_is_found(call, tmp_path, request, monkeypatch):
    page = SimpleNamespace(read_text=lambda: "```text\nsaid by nobody\n```\n", relative_to=lambda root: "page.md")
    with check_error(pytest.fail.Exception):
        test_output_on_page_matches(page, call, tmp_path, request, monkeypatch)


def test_readme_is_short():
    """The README gives an overview in a minute; details are on other pages."""
    assert len((ROOT / "README.md").read_text().splitlines()) <= 200


def test_links_and_pictures_exist():
    """mkdocs checks the links between its pages; these two files are not among them."""
    for page in (ROOT / "README.md", ROOT / "CONTRIBUTING.md"):
        for target in re.findall(r"\]\(([^)#]+?)(?:#[^)]*)?\)", page.read_text()):
            assert target.startswith("http") or (ROOT / target).exists(), f"{_name(page)}: no {target}"
