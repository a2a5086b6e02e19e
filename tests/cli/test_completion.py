"""Completion with Tab: requests of the shell, and the replies."""

import os
import shutil
import subprocess
import sys

import pytest
from click.shell_completion import ShellComplete

from pcbench.cli import app

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


def offers(*words):
    """Return the completions of the last word, without a shell: names, or the kind of name that the shell completes."""
    items = ShellComplete(app, {}, "pcbench", "").get_completions([*words[:-1]], words[-1])
    return [item.value if item.type == "plain" else item.type for item in items]


def test_names_are_offered_as_values():
    compare = "compare", "ref.ply", "a.ply"
    assert offers(*compare, "--register", "global") == ["global", "global-similarity"]
    assert offers(*compare, "--register", "p") == ["points:"]
    assert offers(*compare, "--preset", "mpeg,p") == ["mpeg,pdal", "mpeg,pytorch3d", "mpeg,point-cloud-utils"]
    assert offers("evaluate", "--protocol", "e") == ["eth3d"]
    assert offers("bench", "city", "--register", "g") == ["gauge", "global", "global-similarity"]
    assert offers("reconstruct", "mv") == offers("bench", "city", "--method", "mv") == ["mvs"]
    assert offers("quality", "a.laz", "--background", "") == ["dark", "white", "black"]


@pytest.mark.parametrize(
    "words",
    [("change", ""), ("change", "--zones", ""), ("compare", "--json", ""), ("reconstruct", "mine.p")],
    ids=" ".join,
)
def test_the_shell_completes_files(words):
    assert offers(*words) == ["file"]
