"""Child processes that run in this process instead, because a new one imports its libraries for seconds."""

import contextlib
import inspect
import io
import sys
from importlib import import_module
from unittest.mock import Mock

import pytest
from task_pools import ThreadWorkers

from pcbench import children


def run_module(name, *arguments, **_):
    """Run a module as `pcbench.children.run_module` does, without its limits, environment and log."""
    program = import_module(name)
    output, errors = io.StringIO(), io.StringIO()
    with (
        pytest.MonkeyPatch.context() as patch,
        contextlib.redirect_stdout(output),
        contextlib.redirect_stderr(errors),
    ):
        patch.setattr(sys, "argv", [program.__file__, *arguments])
        try:
            code = program.main(*arguments if inspect.signature(program.main).parameters else ())
        except SystemExit as stop:
            code = stop.code
    return children.ChildResult(code or 0, False, 0.0, output.getvalue(), errors.getvalue(), 0)


@contextlib.contextmanager
def stress_runs_here():
    """Let the runs of `pcbench stress` be done in a thread of this process."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("pcbench.tasks.runner._start", ThreadWorkers)
        patch.setattr("pcbench.studies.stress.runs.run_module", run_module)
        patch.setattr("pcbench.studies.stress.child.faulthandler", Mock())  # its time limit ends the process
        yield


@contextlib.contextmanager
def rendering_here():
    """Let images of the synthetic city be rendered in this process."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("pcbench.scenes.synthetic.render.run_module", run_module)
        yield


@contextlib.contextmanager
def drawing_here():
    """Let pictures of reports be drawn in this process."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("pcbench.report.plot.run_module", run_module)
        yield
