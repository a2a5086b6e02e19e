"""What several test files use."""

import sys

import pytest

from pcbench import cli


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
