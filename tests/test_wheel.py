"""Contents of the wheel for distribution; `make wheel` builds and repairs one, and runs these tests."""

import os
import subprocess
import sysconfig
import zipfile
from pathlib import Path, PurePosixPath

import pytest
from repository import ROOT

# The only C++ sources in the wheel: headers from which CUDA kernels are compiled at first use.
RUN_TIME_HEADERS = {"reconstructors/splat/maths.h", "reconstructors/splat/pinhole.h"}
MODULES = {
    "pcbench/native/_core",
    "reconstructors/mvs/native/_patchmatch",
    "reconstructors/splat/cpu/_rasterizer",
    "reconstructors/field/native/_field",
}


@pytest.fixture(scope="module")
def wheel():
    path = os.environ.get("PCBENCH_WHEEL")
    if not path:
        pytest.skip("needs a wheel: `make wheel`")
    with zipfile.ZipFile(ROOT / path) as archive:
        yield archive


def test_name(wheel):
    """The file name states the C library and this Python version."""
    _, _, python, abi, system = Path(wheel.filename).stem.split("-")
    assert python == abi == "cp" + sysconfig.get_config_var("py_version_nodot")
    assert all(tag.startswith("manylinux") for tag in system.split("."))


def test_contents(wheel):
    """The wheel contains required sources, compiled modules, the OpenMP library and metadata, nothing else."""
    names = {name for name in wheel.namelist() if not name.endswith("/")}
    print("\n".join(sorted(names)))
    tracked_files = subprocess.run(
        ["git", "ls-files", "pcbench", "reconstructors"], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout.split()
    sources = {
        name for name in tracked_files if PurePosixPath(name).suffix not in (".cpp", ".h") or name in RUN_TIME_HEADERS
    }
    modules = {module + sysconfig.get_config_var("EXT_SUFFIX") for module in MODULES}
    other_names = names - sources - modules
    assert sources - names == set()
    assert modules - names == set()
    metadata = metadata_folder(wheel)
    files = ("METADATA", "WHEEL", "RECORD", "entry_points.txt", "licenses/LICENSE")
    libraries = {name for name in other_names if name.startswith("pcbench.libs/libgomp")}
    assert len(libraries) == 1
    assert other_names - libraries - {name for name in other_names if name.startswith(f"{metadata}/sboms/")} == {
        f"{metadata}/{name}" for name in files
    }


def metadata_folder(wheel):
    return next(name.partition("/")[0] for name in wheel.namelist() if name.endswith(".dist-info/METADATA"))


def test_entry_points(wheel):
    text = wheel.read(f"{metadata_folder(wheel)}/entry_points.txt").decode()
    for line in ("[console_scripts]", "pcbench=pcbench.cli:main", "[pcbench.reconstructors]"):
        assert line in text.replace(" = ", "=")
    for name in ("sfm", "mvs", "splat", "field"):
        assert f"\n{name}=" in text.replace(" = ", "=")
