"""Check that OpenGL, which VTK needs, is available: on a display or in a library for off-screen rendering."""

from __future__ import annotations

import ctypes
import os
import sys

from pcbench.errors import PcbenchError

_LIBRARIES = ("libEGL.so.1", "libOSMesa.so.8", "libOSMesa.so.6", "libOSMesa.so")  # any one is sufficient

OFF_SCREEN_ENVIRONMENT = {"MPLBACKEND": "agg", "PYVISTA_OFF_SCREEN": "true"}
"""Environment variables of a process that renders into files only, never into a window."""


class NoFiguresError(PcbenchError):
    """Figures cannot be rendered on this machine; the numbers are not affected."""


def check_opengl() -> None:
    """Refuse to render if there is no OpenGL. Call it before VTK is loaded, which would crash.

    Raises:
        NoFiguresError: there is no display, no EGL and no OSMesa.
    """
    if not sys.platform.startswith("linux") or os.environ.get("DISPLAY"):
        return
    for name in _LIBRARIES:
        try:
            ctypes.CDLL(name)
            return
        except OSError:
            continue
    raise NoFiguresError(
        "no pictures: this machine has no display, EGL or OSMesa; install Debian's libegl1 (or libosmesa6)"
    )
