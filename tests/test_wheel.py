"""Contents of wheels for distribution; `make wheel` and `make wheels` build and repair them, and run these tests."""

import os
import subprocess
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


WHEELS = os.environ.get("PCBENCH_WHEELS", "").split()

pytestmark = pytest.mark.skipif(not WHEELS, reason="needs wheels: `make wheel`")


@pytest.fixture(scope="module", params=WHEELS)
def wheel(request):
    with zipfile.ZipFile(ROOT / request.param) as archive:
        yield archive


def tags(wheel):
    """Return the tags of a wheel's name: Python version, binary interface, and systems."""
    _, _, python, abi, systems = Path(wheel.filename).stem.split("-")
    return python, abi, systems.split(".")


def test_name(wheel):
    """The file name states the C library, and Python 3.11 or the stable binary interface of later versions."""
    python, abi, systems = tags(wheel)
    assert (python, abi) in (("cp311", "cp311"), ("cp312", "abi3"))
    assert all(system.startswith("manylinux") for system in systems)


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
    _, abi, systems = tags(wheel)
    processor = "aarch64" if systems[0].endswith("aarch64") else "x86_64"
    suffix = "abi3" if abi == "abi3" else f"cpython-{abi.removeprefix('cp')}-{processor}-linux-gnu"
    modules = {f"{module}.{suffix}.so" for module in MODULES}
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
