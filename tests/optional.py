"""Optional libraries: skip tests without one, and simulate machines on which one cannot be loaded.

As a program it lists the libraries of pcbench and its tests that cannot be imported here, except peers of benchmarks
and of the stress study, which no extra installs.
"""

import os
import sys
from pathlib import Path

import pytest

from pcbench.errors import MissingExtra
from pcbench.extras import LIBRARIES, import_problem, require

NO_LIBUSB = "OSError('libusb-1.0.so.0: cannot open shared object file: No such file or directory')"
_OPENGL = ("libEGL.so.1", "libOSMesa.so.8", "libOSMesa.so.6", "libOSMesa.so")
SYSTEM_LIBRARIES = ("libusb-1.0.so.0", "libGL.so.1", *_OPENGL)
PEERS = ("cv2", "fricp_cpp", "point_cloud_utils", "small_gicp")  # measured beside pcbench if they are installed
_TEST_LIBRARIES = ("laspy", "skimage.metrics", "nbclient")


def import_or_skip(module):
    """Import a module of an optional library; skip the test or the file if that fails."""
    try:
        return require(module)
    except MissingExtra as error:
        pytest.skip(str(error), allow_module_level=True)


def break_library(monkeypatch, folder, name, error=NO_LIBUSB):
    """Replace a package by one that raises `error` at import, here and in child processes.

    Args:
        error: a Python expression; None simulates a library that is not installed.
    """
    exception = error or f"ModuleNotFoundError({f'No module named {name!r}'!r}, name={name!r})"
    package = Path(folder) / name
    package.mkdir(parents=True)
    (package / "__init__.py").write_text(f"raise {exception}\n")
    path = os.environ.get("PYTHONPATH")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(folder), *([path] if path else [])]))
    monkeypatch.syspath_prepend(folder)
    for module in list(sys.modules):
        if f"{module}.".startswith(f"{name}."):
            monkeypatch.delitem(sys.modules, module)


def break_system_libraries(folder, names=SYSTEM_LIBRARIES):
    """Return an environment in which the dynamic loader finds empty files for these libraries and fails."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        (folder / name).touch()
    return {"LD_LIBRARY_PATH": str(folder), "DISPLAY": ""}


if __name__ == "__main__":
    required = (library for library in (*LIBRARIES, *_TEST_LIBRARIES) if library not in PEERS)
    problems = [line for library in required if (line := import_problem(library))]
    sys.exit("\n".join(problems) or 0)
