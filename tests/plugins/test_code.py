"""The code digest covers all sources and compiled modules that determine results, of bundled and other plugins."""

import importlib
import sys

import pytest
from optional import import_or_skip

from pcbench.plugins.code import _files_of_packages, digest_files, plugin_files
from pcbench.plugins.run import ReconstructionJob, run
from pcbench.plugins.stages import library_versions

PLUGIN = """
from dataclasses import dataclass
from pathlib import Path
import numpy as np
from pcbench import Cloud
from pcbench.plugins import Reconstruction
from pcbench.plugins.stages import stage
@dataclass(frozen=True)
class Mine:
    def reconstruct(self, scene, workspace):
        {importing}
        def make(folder):
            print("made")
            np.save(folder / "points.npy", np.full((3, 3), value()))
        folder = stage(workspace, "points", {{}}, make)
        return Reconstruction(Cloud(np.load(folder / "points.npy")), "arbitrary")
"""


@pytest.fixture
def package(tmp_path, monkeypatch):
    """A package with sources, a kernel, a header, a compiled module and a file that is no code."""
    folder = tmp_path / "path" / "some_plugin"
    (folder / "cuda").mkdir(parents=True)
    (folder / "__init__.py").write_text("")
    (folder / "mine.py").write_text(PLUGIN.format(importing="from some_plugin.beside import value"))
    (folder / "beside.py").write_text("def value(): return 1.0\n")
    (folder / "cuda/kernel.cu").write_text("// 1")
    (folder / "cuda/maths.h").write_text("// 1")
    (folder / "_core.cpython-311-x86_64-linux-gnu.so").write_bytes(b"1")
    (folder / "README.md").write_text("1")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path / "path"))  # for the child processes
    monkeypatch.syspath_prepend(tmp_path / "path")
    yield folder
    for name in [name for name in sys.modules if name.partition(".")[0] == "some_plugin"]:
        del sys.modules[name]


@pytest.mark.parametrize(
    "edited_file, is_code",
    [
        ("mine.py", True),
        ("beside.py", True),
        ("cuda/kernel.cu", True),
        ("cuda/maths.h", True),
        ("_core.cpython-311-x86_64-linux-gnu.so", True),
        ("new.py", True),
        ("README.md", False),
        ("beside.pyc", False),
    ],
)
def test_digest_covers_a_plugins_package(package, edited_file, is_code):
    importlib.import_module("some_plugin.mine")
    old_digest = digest_files(plugin_files("some_plugin.mine"))
    assert digest_files(plugin_files("some_plugin.mine")) == old_digest
    with (package / edited_file).open("ab") as file:
        file.write(b"\n")
    assert (digest_files(plugin_files("some_plugin.mine")) != old_digest) == is_code


def test_digest_covers_pcbench_and_its_reconstructors():
    files = dict(_files_of_packages(["pcbench", "reconstructors"]))
    compiled_modules = {name.partition(".")[0] for name, file in files.items() if file.suffix == ".so"}
    assert {
        "pcbench/native/_core",
        "reconstructors/mvs/native/_patchmatch",
        "reconstructors/splat/cpu/_rasterizer",
        "reconstructors/field/native/_field",
    } <= compiled_modules
    assert {"reconstructors/splat/train.py", "reconstructors/splat/maths.h", "pcbench/measure/scores.py"} <= set(files)
    assert any(name.startswith("reconstructors/splat/cuda/") and name.endswith(".cu") for name in files)
    assert len(library_versions()["code"]) == 64


def test_bundled_plugins_have_one_digest():
    importlib.import_module("reconstructors")
    digests = {digest_files(plugin_files(f"reconstructors.{name}.{name}")) for name in ("splat", "mvs")}
    assert digests == {digest_files(_files_of_packages(["reconstructors"]))}


@pytest.fixture
def photographs(tmp_path):
    image = import_or_skip("PIL.Image")
    (tmp_path / "photos/images").mkdir(parents=True)
    image.new("RGB", (40, 30)).save(tmp_path / "photos/images/0.png")
    return tmp_path / "photos"


def test_editing_a_plugins_package_outdates_its_stage(package, photographs, tmp_path):
    job = ReconstructionJob("some_plugin.mine:Mine", photographs)

    def run_job():
        result = run(job, tmp_path / "work")
        return result.log.read_text(), result.require_reconstruction().cloud.points[0, 0]

    assert run_job() == ("made\n", 1.0)
    assert run_job() == ("", 1.0)
    # Of another size: within a second, Python recognises an edited source by its size only.
    (package / "beside.py").write_text("def value(): return 2.00\n")
    assert run_job() == ("made\n", 2.0)


@pytest.mark.long
def test_editing_a_module_next_to_a_plugin_file_outdates_its_stage(photographs, tmp_path):
    """A plugin in one file may import modules next to it, also inside a function."""
    folder = tmp_path / "loose"
    (folder / "below").mkdir(parents=True)
    import_line = "import sys, pathlib; sys.path.insert(0, str(pathlib.Path(__file__).parent)); import below.deep\n"
    (folder / "mine.py").write_text(import_line + PLUGIN.format(importing="from beside import value"))
    (folder / "beside.py").write_text("def value(): return 1.0\n")
    (folder / "below/deep.py").write_text("")
    job = ReconstructionJob(f"{folder}/mine.py:Mine", photographs)

    def run_job():
        return run(job, tmp_path / "work").log.read_text()

    assert run_job() == "made\n"
    (folder / "beside.py").write_text("def value(): return 2.00\n")
    assert run_job() == "made\n"
    (folder / "below/deep.py").write_text("# edited")
    assert run_job() == "made\n"
    (folder / "notes.txt").write_text("not code")
    assert run_job() == ""
