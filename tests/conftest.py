"""What several test files use."""

import os
import signal
import sys

from data_folder import data_root

# Before numpy is imported. Workers share the cores, and the matrices are small: threads would wait for each other.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# A shell tells what it starts in the background to ignore Ctrl-C, and children inherit that: tests send it.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

import pytest

from pcbench import cli
from pcbench.errors import MissingExtra
from pcbench.opengl import NoFiguresError
from pcbench.scenes.synthetic.render import check_renderer


def pytest_report_header():
    return f"real data: {data_root() or 'none (set PCBENCH_DATA)'}"


@pytest.fixture(scope="session")
def renderer():
    """Skips what takes photographs where none can be taken."""
    try:
        check_renderer()
    except (NoFiguresError, MissingExtra) as error:
        pytest.skip(str(error))


@pytest.fixture
def run(monkeypatch, capsys):
    """Call the command line in this process: (exit code, stdout, stderr)."""

    def call(*arguments, figures=False):
        if arguments[0] == "compare" and not figures:
            arguments = (*arguments, "--no-figures")
        monkeypatch.setattr(sys, "argv", ["pcbench", *map(str, arguments)])
        try:
            cli.main()
            code = 0
        except SystemExit as stop:
            code = stop.code or 0
        captured = capsys.readouterr()
        return code, captured.out, captured.err

    return call
