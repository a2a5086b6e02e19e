"""`pcbench --log FILE`: a log of the run in a separate file."""

import logging
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from command_line import is_one_line
from wording import check_text

from pcbench import Cloud, __version__, read_cloud, write_cloud
from pcbench.errors import InputError, record_error

RECORD = re.compile(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{3}Z (DEBUG|INFO|WARNING|ERROR|CRITICAL) (.*)")


def records(path):
    """Return (level, text) of each record; lines of tracebacks belong to the record above."""
    first, *lines = Path(path).read_text().splitlines()
    assert first == "# pcbench log"
    entries = []
    for line in lines:
        if match := RECORD.fullmatch(line):
            entries.append([match[1], match[2]])
        else:
            entries[-1][1] += f"\n{line}"
    return [tuple(record) for record in entries]


def test_steps_settings_and_versions_are_logged(files, run):
    code, _, err = run("--log", "run.log", "crop", "a.ply", "b.ply", "--crop", "quantile:0.5", "-q")
    assert (code, err) == (0, "")
    texts = [text for _, text in records("run.log")]
    assert texts[0] == "command: pcbench --log run.log crop a.ply b.ply --crop quantile:0.5 -q"
    assert any(text.startswith(f"pcbench {__version__}, Python ") for text in texts)
    assert any("numpy" in text for text in texts if text.startswith("libraries: "))
    assert "setting: crop = 'quantile:0.5' (commandline)" in texts
    assert "setting: quiet = True (commandline)" in texts
    steps = [text for text in texts if text.startswith("step: ")]
    assert steps == ["step: reading a.ply", "step: cropping", "step: writing b.ply"]
    assert texts[-1].startswith("finished in ")
    assert not [h for h in logging.getLogger("pcbench").handlers if isinstance(h, logging.FileHandler)]


def test_errors_are_logged_with_their_tracebacks(files, run):
    code, _, err = run("--log", "run.log", "register", "ref.ply", "none.ply")
    assert (code, is_one_line(err)) == (2, True)
    level, text = records("run.log")[-1]
    assert level == "ERROR"
    check_text(text.splitlines()[0])
    assert "Traceback" in text
    assert "Source.open" in text


def test_warnings_of_quiet_runs_are_logged(files, run):
    Path("nan.xyz").write_text("0 0 0\n1 1 1\nnan 2 2\n")
    code, _, err = run("--log", "run.log", "convert", "nan.xyz", "b.ply", "-q")
    assert (code, err) == (0, "")
    assert [text for level, text in records("run.log") if level == "WARNING"] == [
        "nan.xyz: dropped 1 of 3 points with NaN or Inf coordinates"
    ]


def test_errors_that_end_in_a_result_are_logged(files, run, monkeypatch):
    def fail(*_, **__):
        try:
            raise InputError("swallowed")
        except InputError as error:
            raise InputError(record_error(error)) from None

    monkeypatch.setattr("pcbench.io.source.Source.read_cloud", fail)
    run("--log", "run.log", "info", "a.ply")
    debug_texts = [text for level, text in records("run.log") if level == "DEBUG"]
    assert len(debug_texts) == 1
    assert "InputError: swallowed" in debug_texts[0]


def test_a_second_run_appends_to_the_log(files, run):
    for _ in range(2):
        assert run("--log", "run.log", "info", "a.ply")[0] == 0
    assert sum(text.startswith("command: ") for _, text in records("run.log")) == 2


@pytest.mark.parametrize(
    "command",
    ["--log a.ply info a.ply", "--log new.ply crop a.ply new.ply --crop none", "--log . info a.ply",
     "--log none/run.log info a.ply", "--log pipe info a.ply"],
)  # fmt: skip
def test_a_log_replaces_no_other_file(files, run, command):
    os.mkfifo("pipe")
    before = (files / "a.ply").read_bytes()
    code, _, err = run(*command.split())
    assert (code, is_one_line(err)) == (2, True), err
    assert (files / "a.ply").read_bytes() == before


def test_a_log_on_a_full_disk_gives_one_warning(files):
    """Files are limited to 300 bytes, fewer than settings and versions need."""
    script = (
        "import resource, sys; resource.setrlimit(resource.RLIMIT_FSIZE, (300, 300))\n"
        "sys.argv = 'pcbench --log run.log info a.ply'.split()\n"
        "from pcbench.cli import main; main()"
    )
    process = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120)
    assert process.returncode == 0
    assert "1,500 " in process.stdout
    warning_lines = [line for line in process.stderr.splitlines() if line.startswith("warning: ")]
    assert len(warning_lines) == 1
    assert "run.log" in check_text(warning_lines[0])
    assert "Traceback" not in process.stderr


def test_warnings_of_a_comparison_are_logged(files, run):
    write_cloud("far.ply", Cloud(1.02 * read_cloud("a.ply").points))
    code, out, _ = run("--log", "run.log", "compare", "ref.ply", "far.ply", "--no-figures")
    assert code == 0
    printed_warnings = [line.removeprefix("warning: ") for line in out.splitlines() if line.startswith("warning: ")]
    assert printed_warnings
    assert [text for level, text in records("run.log") if level == "WARNING"] == printed_warnings
