"""Completion with Tab: requests of the shell, and the replies."""

import os
import shutil
import subprocess
import sys

import pytest

# The console script, wherever it is installed.
_PCBENCH = "import sys; sys.argv[0] = 'pcbench'; from pcbench.cli import main; main()"


def run_pcbench(**variables):
    command = [sys.executable, "-c", _PCBENCH]
    return subprocess.run(command, env={**os.environ, **variables}, capture_output=True, text=True, timeout=120)


def complete(*words):
    """Return the completions of the last word of a command line."""
    variables = {"COMP_WORDS": " ".join(words), "COMP_CWORD": str(len(words) - 1)}
    lines = run_pcbench(_PCBENCH_COMPLETE="bash_complete", **variables).stdout.splitlines()
    return [line.partition(",")[2] for line in lines]


@pytest.mark.skipif(shutil.which("bash") is None, reason="no bash")
def test_bash_gets_a_script():
    process = run_pcbench(_PCBENCH_COMPLETE="bash_source")
    assert (process.returncode, process.stderr) == (0, "")
    assert "complete -o nosort -F _pcbench_completion pcbench" in process.stdout
    syntax_check = subprocess.run(["bash", "-n"], input=process.stdout, text=True, capture_output=True)
    assert (syntax_check.returncode, syntax_check.stderr) == (0, "")


def test_commands_and_options_are_offered():
    assert complete("pcbench", "comp") == ["compare"]
    assert complete("pcbench", "synth", "") == ["city", "warp"]
    assert complete("pcbench", "register", "--js") == ["--json"]
    assert complete("pcbench", "views", "--hold-out", "b") == ["blocks"]
