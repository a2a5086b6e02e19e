"""Optional libraries: tests skip where one cannot be used, and imitate machines on which one does not load.

Run as a program it names each library that pcbench or its tests can use and that cannot be imported here.
"""

import os
import sys
from pathlib import Path

import pytest

from pcbench.errors import MissingExtra
from pcbench.extras import LIBRARIES, require, unavailable

NO_LIBUSB = "OSError('libusb-1.0.so.0: cannot open shared object file: No such file or directory')"
_OPENGL = ("libEGL.so.1", "libOSMesa.so.8", "libOSMesa.so.6", "libOSMesa.so")
SYSTEM_LIBRARIES = ("libusb-1.0.so.0", "libGL.so.1", *_OPENGL)
_OF_TESTS = ("laspy", "pymeshlab", "skimage.metrics", "nbclient")


def import_or_skip(module):
    """The module of an optional library; skips the test, or the file, where the library is absent or does not load."""
    try:
        return require(module)
    except MissingExtra as error:
        pytest.skip(str(error), allow_module_level=True)


def break_library(monkeypatch, folder, name, error=NO_LIBUSB):
    """Put a package of this name that raises `error` at import in front of the real one, here and in child processes.

    Args:
        error: a Python expression; None imitates a library that is not installed.
    """
    raised = error or f"ModuleNotFoundError({f'No module named {name!r}'!r}, name={name!r})"
    package = Path(folder) / name
    package.mkdir(parents=True)
    (package / "__init__.py").write_text(f"raise {raised}\n")
    path = os.environ.get("PYTHONPATH")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(folder), *([path] if path else [])]))
    monkeypatch.syspath_prepend(folder)
    for module in list(sys.modules):
        if f"{module}.".startswith(f"{name}."):
            monkeypatch.delitem(sys.modules, module)


def break_system_libraries(folder, names=SYSTEM_LIBRARIES):
    """Environment in which the dynamic loader finds empty files for these libraries, and gives up at them."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        (folder / name).touch()
    return {"LD_LIBRARY_PATH": str(folder), "DISPLAY": ""}


if __name__ == "__main__":
    problems = [line for library in (*LIBRARIES, *_OF_TESTS) if (line := unavailable(library))]
    sys.exit("\n".join(problems) or 0)
