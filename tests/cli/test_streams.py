"""Standard streams that are closed, full or not read: an exit code, at most one line, and no traceback."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from command_line import is_one_line, without_progress
from wording import check_text

from pcbench import read_cloud

PCBENCH = f"{sys.executable} -m pcbench.cli"


def shell(command, *, unbuffered=False):
    """Run a shell command; return its exit code and its standard error, unless redirected."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    if unbuffered:
        environment["PYTHONUNBUFFERED"] = "1"
    shell_command = ["bash", "-c", f"set -o pipefail; {command}"]
    process = subprocess.run(shell_command, capture_output=True, text=True, timeout=120, env=environment)
    return process.returncode, process.stdout, process.stderr


def test_a_closed_output_is_an_error_if_something_was_printed(files):
    code, _, err = shell(f"{PCBENCH} info a.ply >&-")
    assert (code, is_one_line(err)) == (2, True), err
    check_text(err)


def test_a_closed_output_is_no_error_if_nothing_is_printed(files):
    """No file gets the descriptor of the closed stream, or output of libraries would be written into it."""
    assert shell(f"{PCBENCH} convert -q a.ply b.ply <&- >&- 2>&-")[0] == 0
    assert len(read_cloud("b.ply")) == len(read_cloud("a.ply"))


@pytest.mark.parametrize(
    ("unbuffered", "closed"),
    [
        pytest.param(False, (">&-", "2>&-", ">&- 2>&-", "2>/dev/full", ">/dev/full 2>&1"), marks=pytest.mark.long),
        (True, ("2>&-", ">/dev/full 2>&1")),
    ],
    ids=["buffered", "unbuffered"],
)
def test_exit_codes_are_the_same_without_standard_error(files, unbuffered, closed):
    for streams in closed:
        code, _, err = shell(f"{PCBENCH} info none.ply {streams}", unbuffered=unbuffered)
        assert code == 2
        assert "Traceback" not in err
    assert shell(f"{PCBENCH} info a.ply 2>&-")[0] == 0


@pytest.mark.parametrize(
    ("arguments", "pipes"),
    [
        ("info a.ply", ("| head -1", "2>&1 | true")),
        pytest.param("info a.ply", ("| true", "|& head -1"), marks=pytest.mark.long),
        pytest.param("compare ref.ply a.ply --full --no-figures", ("| head -1",), marks=pytest.mark.long),
        ("--help", ("| true",)),
    ],
    ids=["info", "info in other pipes", "compare", "help"],
)
def test_a_closed_pipe_ends_the_run_quietly(files, arguments, pipes):
    """`true` reads nothing; the pipe is full or closed at the first line."""
    for pipe in pipes:
        code, _, err = shell(f"{PCBENCH} {arguments} {pipe}")
        assert code in (0, 2)
        assert without_progress(err) == ""


@pytest.mark.long
def test_a_report_is_written_without_a_reader_of_its_answer(files):
    shell(f"{PCBENCH} compare ref.ply a.ply --no-figures --out report | head -1")
    assert Path("report/comparison.json").is_file()


def test_a_full_output_is_an_error(files):
    code, _, err = shell(f"{PCBENCH} info a.ply >/dev/full")
    assert (code, is_one_line(err)) == (2, True), err
    assert os.strerror(28) in err
