"""Child processes that run in this process instead, because a new one imports its libraries for seconds."""

import contextlib
import inspect
import io
import os
import runpy
import sys
from importlib import import_module
from pathlib import Path
from unittest.mock import Mock

import pytest
from task_pools import ThreadWorkers

from pcbench import children
from pcbench.plugins import describe_child, reconstruct_child


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


def run_script(file, *arguments, **_):
    """Run a Python file as `pcbench.children.run_script` does, without its limits and environment."""
    code, errors = 0, ""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", [str(file), *arguments])
        try:
            runpy.run_path(str(file), run_name="__main__")
        except SystemExit as stop:
            code, errors = (1, stop.code) if isinstance(stop.code, str) else (stop.code or 0, "")
    return children.ChildResult(code, False, 0.0, "", errors, 0)


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


@contextlib.contextmanager
def libraries_read_here():
    """Let trimesh and tifffile read files in this process."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("pcbench.io.gltf.run_script", run_script)
        patch.setattr("pcbench.io.geotiff_heights.run_script", run_script)
        yield


@contextlib.contextmanager
def reconstructing_here():
    """Let reconstructors be described and run in this process."""

    def run_module(name, *arguments, limits, environment=None, log=None):
        with io.TextIOWrapper(io.BytesIO() if log is None else io.FileIO(os.dup(log.fileno()), "w")) as output:
            with contextlib.redirect_stdout(output), contextlib.redirect_stderr(output):
                if name == "pcbench.plugins.reconstruct_child":
                    reconstruct_child.main(Path(arguments[0]))
                else:
                    describe_child.main(arguments[0], Path(arguments[1]))
        return children.ChildResult(code=0, timed_out=False, cpu_s=0.0, output="", errors="", received=0)

    with pytest.MonkeyPatch.context() as patch:
        # The code of the child process does not belong to the inputs of this run.
        patch.setattr(reconstruct_child, "register_plugin_code", lambda module: None)
        patch.setattr("pcbench.plugins.run.run_module", run_module)
        yield
