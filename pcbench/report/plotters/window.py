"""Check that a window can be opened, or a picture rendered, before VTK does it in this process."""

from __future__ import annotations

import os
import sys

from pcbench.children import Limits, run_module
from pcbench.extras import require
from pcbench.opengl import OFF_SCREEN_ENVIRONMENT, NoFiguresError, check_opengl

_MAX_SECONDS = 60


def check_window(*, off_screen: bool) -> None:
    """Check in a child process that OpenGL works, because VTK ends the process where it is broken.

    Args:
        off_screen: whether a picture is rendered instead of opening a window.

    Raises:
        MissingExtra: pyvista is not installed.
        NoFiguresError: there is no display for a window, or OpenGL fails.
    """
    result = "picture" if off_screen else "window"
    if not off_screen and not has_display():
        raise NoFiguresError("no window: this machine has no display")
    check_opengl()  # before VTK, which pyvista imports
    require("pyvista")
    probe = run_module(
        "pcbench.report.plotters.window_worker",
        result,
        limits=Limits(seconds=_MAX_SECONDS),
        environment=OFF_SCREEN_ENVIRONMENT if off_screen else None,
    )
    if probe.code != 0:
        raise NoFiguresError(f"no {result}: OpenGL fails ({probe.last_error_line or 'it crashed'})")


def has_display() -> bool:
    """Return whether this machine may have a display: on Linux, one of the variables that name it is set."""
    return not sys.platform.startswith("linux") or any(os.environ.get(n) for n in ("DISPLAY", "WAYLAND_DISPLAY"))
