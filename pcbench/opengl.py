"""Whether photographs of a scene can be taken here: VTK needs OpenGL, from a display or a library that does without."""

from __future__ import annotations

import ctypes
import os
import sys

from pcbench.errors import PcbenchError

_LIBRARIES = ("libEGL.so.1", "libOSMesa.so.8", "libOSMesa.so.6", "libOSMesa.so")  # any one of them will do

OFF_SCREEN = {"MPLBACKEND": "agg", "PYVISTA_OFF_SCREEN": "true"}
"""Environment variables of a process that draws into files, never into a window."""


class NoFiguresError(PcbenchError):
    """Pictures cannot be drawn on this machine; the numbers are not concerned."""


def check_opengl() -> None:
    """Say that VTK cannot draw here, before it is loaded: it does not raise, it crashes.

    Raises:
        NoFiguresError: neither a display nor EGL nor OSMesa is there.
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
        "no pictures: neither a display nor EGL nor OSMesa is there; install Debian's libegl1 (or libosmesa6)"
    )
