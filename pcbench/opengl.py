"""Check that OpenGL, which VTK needs, is available: on a display or in a library for off-screen rendering."""

from __future__ import annotations

import ctypes
import os
import sys

from pcbench.errors import PcbenchError

_VTK_WINDOWS = {"libEGL": "vtkEGLRenderWindow", "libOSMesa": "vtkOSOpenGLRenderWindow"}  # by library
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
    if _has_display() or _off_screen_library() is not None:
        return
    raise NoFiguresError(
        "no pictures: this machine has no display, EGL or OSMesa; install Debian's libegl1 (or libosmesa6)"
    )


def select_opengl() -> None:
    """Let VTK render off screen if there is no display; it would look for one first, and print a warning."""
    if _has_display() or (library := _off_screen_library()) is None:
        return
    os.environ.setdefault("VTK_DEFAULT_OPENGL_WINDOW", _VTK_WINDOWS[library.partition(".")[0]])


def _has_display() -> bool:
    """Return whether VTK finds OpenGL with the display: there is one, or the system is not Linux."""
    return not sys.platform.startswith("linux") or bool(os.environ.get("DISPLAY"))


def _off_screen_library() -> str | None:
    """Return the first library for off-screen rendering that can be loaded; None if there is none."""
    for name in _LIBRARIES:
        try:
            ctypes.CDLL(name)
            return name
        except OSError:
            continue
    return None
