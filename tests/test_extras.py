"""Missing optional libraries, and installed ones that cannot be loaded, give one line; tests are skipped."""

import os
import subprocess
import sys

import numpy as np
import pytest
from optional import NO_LIBUSB, PEERS, SYSTEM_LIBRARIES, break_library, break_system_libraries
from repository import ROOT, TESTS
from wording import check_error, check_text

from pcbench import Cloud, write_cloud
from pcbench.errors import MissingExtra
from pcbench.extras import LIBRARIES, debian_package, import_problem, require
from pcbench.opengl import NoFiguresError
from pcbench.scenes.synthetic.render import check_renderer


@pytest.mark.parametrize(
    "error",
    [
        NO_LIBUSB,
        "ImportError('libGL.so.1: cannot open shared object file: No such file')",
        "OSError('/usr/lib/libEGL.so.1: file too short')",
        "RuntimeError('two\\nlines')",
        "ModuleNotFoundError('No module named inner', name='inner')",
        None,
    ],
)
def test_import_errors_become_one_line(monkeypatch, tmp_path, error):
    break_library(monkeypatch, tmp_path, "open3d", error)
    with check_error(MissingExtra) as caught:
        require("open3d")
    assert import_problem("json", "open3d") == str(caught.value)


def test_submodule_of_a_broken_library(monkeypatch, tmp_path):
    break_library(monkeypatch, tmp_path, "matplotlib", None)
    with check_error(MissingExtra):
        require("matplotlib.figure")


def test_interrupted_import_is_not_a_missing_library(monkeypatch, tmp_path):
    break_library(monkeypatch, tmp_path, "open3d", "KeyboardInterrupt()")
    with pytest.raises(KeyboardInterrupt):
        require("open3d")


def test_loadable_libraries_are_available():
    assert import_problem("json", "importlib.util") is None
    assert require("importlib.util").find_spec("json")


@pytest.mark.parametrize(
    "library, package",
    [
        ("libusb-1.0.so.0", "libusb-1.0-0"),
        ("libGL.so.1", "libgl1"),
        ("libEGL.so.1", "libegl1"),
        ("libgomp.so.1", "libgomp1"),
        ("libX11.so.6", "libx11-6"),
        ("libOpenGL.so.0", "libopengl0"),
        ("libOSMesa.so.8", "libosmesa6"),
    ],
)
def test_debian_packages(library, package):
    """The package names are those of `dpkg --search` on Debian 12."""
    assert debian_package(library) == package


def test_named_extras_exist():
    import tomllib

    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    for name, extra in LIBRARIES.values():
        assert not extra or any(name in line for line in extras[extra])


def test_tests_install_all_optional_libraries_but_peers():
    pins = (line.partition("==")[0] for line in (ROOT / "constraints.txt").read_text().splitlines())
    assert {library.name for module, library in LIBRARIES.items() if module not in PEERS} <= set(pins)


@pytest.mark.long
@pytest.mark.parametrize("library", ["pycolmap", "PIL"])
def test_reconstructors_with_a_broken_library_cannot_run(run, monkeypatch, tmp_path, library):
    break_library(monkeypatch, tmp_path / "packages", library)
    code, out, _ = run("plugins", "sfm", "mvs", "splat", "field")
    assert code == 0
    assert out.count("cannot run here") == 4
    assert out.count("apt-get install libusb-1.0-0") == 4


def test_commands_report_a_broken_library_on_one_line(run, monkeypatch, tmp_path):
    cloud = Cloud(np.random.default_rng(0).normal(size=(200, 3)))
    write_cloud(tmp_path / "a.ply", cloud)
    for library in ("pymeshlab", "open3d"):
        break_library(monkeypatch, tmp_path / "packages", library)
    code, out, err = run("compare", tmp_path / "a.ply", tmp_path / "a.ply", "--map", "poisson", "--out", tmp_path / "r")
    assert (code, out) == (2, "")
    assert check_text(err).count("\n") == 1
    assert "apt-get install libusb-1.0-0" in err


def run_tests(*tests):
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *(str(TESTS / test) for test in tests)]
    process = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    return process.returncode, process.stdout


@pytest.mark.long
def test_tests_are_skipped_if_a_library_cannot_be_loaded(monkeypatch, tmp_path):
    break_library(monkeypatch, tmp_path, "open3d")
    code, out = run_tests("io/test_io_pcd.py")
    assert code == 0
    assert "skipped" in out and "failed" not in out
    assert "apt-get install libusb-1.0-0" in out


@pytest.mark.long
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="only Linux has LD_LIBRARY_PATH")
def test_demo_skips_the_bench_without_opengl(tmp_path):
    """The loader finds empty files for EGL and OSMesa, so `dlopen` fails."""
    environment = os.environ | break_system_libraries(tmp_path / "libraries")
    command = [sys.executable, "-m", "pcbench.cli", "demo", "--points", "20000", "--out", str(tmp_path / "demo")]
    process = subprocess.run([*command, "--no-figures"], env=environment, capture_output=True, text=True)
    assert process.returncode == 0, process.stderr
    assert (tmp_path / "demo" / "report" / "comparison.json").is_file()
    notices = [line for line in process.stdout.splitlines() if line.startswith("bench skipped: ")]
    assert len(notices) == 1
    assert "libegl1" in notices[0]


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="only Linux is checked for OpenGL")
def test_broken_renderer_is_reported_before_rendering(monkeypatch, tmp_path):
    monkeypatch.setenv("DISPLAY", "")
    monkeypatch.setattr("pcbench.opengl._LIBRARIES", SYSTEM_LIBRARIES[:0])
    with pytest.raises(NoFiguresError):
        check_renderer()
    monkeypatch.setenv("DISPLAY", ":0")
    break_library(monkeypatch, tmp_path, "pyvista", "ImportError('libXrender.so.1: cannot open shared object file')")
    with check_error(MissingExtra):
        check_renderer()
