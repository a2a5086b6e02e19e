"""Completion with Tab: requests of the shell, and the replies."""

import os
import shutil
import subprocess
import sys

import pytest

# The console script, wherever it is installed.
_PCBENCH = "import sys; sys.argv[0] = 'pcbench'; from pcbench.cli import main; main()"


def answered(**variables):
    command = [sys.executable, "-c", _PCBENCH]
    return subprocess.run(command, env={**os.environ, **variables}, capture_output=True, text=True, timeout=120)


def completed(*words):
    """Return the completions of the last word of a command line."""
    variables = {"COMP_WORDS": " ".join(words), "COMP_CWORD": str(len(words) - 1)}
    lines = answered(_PCBENCH_COMPLETE="bash_complete", **variables).stdout.splitlines()
    return [line.partition(",")[2] for line in lines]


@pytest.mark.skipif(shutil.which("bash") is None, reason="no bash")
def test_bash_gets_a_script():
    done = answered(_PCBENCH_COMPLETE="bash_source")
    assert (done.returncode, done.stderr) == (0, "")
    assert "complete -o nosort -F _pcbench_completion pcbench" in done.stdout
    read = subprocess.run(["bash", "-n"], input=done.stdout, text=True, capture_output=True)
    assert (read.returncode, read.stderr) == (0, "")


def test_commands_and_options_are_offered():
    assert completed("pcbench", "comp") == ["compare"]
    assert completed("pcbench", "synth", "") == ["city", "warp"]
    assert completed("pcbench", "register", "--js") == ["--json"]
    assert completed("pcbench", "views", "--hold-out", "b") == ["blocks"]
