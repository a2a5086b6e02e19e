import contextlib
import io
import os
from pathlib import Path

import pytest
import shapes
from benches import METHODS, RIG, TRUTH
from optional import import_or_skip
from partial_comparisons import skip_changes, skip_deformation

from pcbench import Cloud, write_cloud
from pcbench.children import ChildResult
from pcbench.io.colmap_model import write_colmap_model
from pcbench.plugins import describe_child, reconstruct_child
from pcbench.studies.bench.truth import read_truth


@pytest.fixture
def bench_folder(tmp_path, monkeypatch):
    """Current folder with photos/, truth.ply, made.ply and methods.py."""
    image = import_or_skip("PIL.Image")
    (tmp_path / "photos/images").mkdir(parents=True)
    for camera in RIG:
        image.new("RGB", (40, 30), (len(camera.name), 0, 0)).save(tmp_path / "photos/images" / camera.name)
    write_colmap_model(tmp_path / "photos/sparse", RIG)
    write_cloud(tmp_path / "truth.ply", TRUTH)
    write_cloud(tmp_path / "made.ply", Cloud(shapes.city(1000, seed=2)[0]))
    (tmp_path / "methods.py").write_text(METHODS)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def truth(bench_folder):
    return read_truth(bench_folder / "truth.ply", None, {camera.name: camera for camera in RIG}, print)


@pytest.fixture
def in_process(monkeypatch):
    """Run reconstructors in this process and measure neither changes nor deformation, which saves a second each.

    Tests without this fixture show that separate processes protect the bench from crashes.
    """
    skip_changes(monkeypatch)
    skip_deformation(monkeypatch)

    def run_module(name, *arguments, limits, environment=None, log=None):
        with io.TextIOWrapper(io.BytesIO() if log is None else io.FileIO(os.dup(log.fileno()), "w")) as output:
            with contextlib.redirect_stdout(output), contextlib.redirect_stderr(output):
                if name == "pcbench.plugins.reconstruct_child":
                    reconstruct_child.main(Path(arguments[0]))
                else:
                    describe_child.main(arguments[0], Path(arguments[1]))
        return ChildResult(code=0, timed_out=False, cpu_s=0.0, output="", errors="", received=0)

    # The code of the child process does not belong to the inputs of this run.
    monkeypatch.setattr(reconstruct_child, "register_plugin_code", lambda module: None)
    monkeypatch.setattr("pcbench.plugins.run.run_module", run_module)
