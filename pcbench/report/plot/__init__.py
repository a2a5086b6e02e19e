"""Pictures of a report: deviation maps (pyvista), distributions and the charts of a bench (matplotlib).

They are drawn from a report folder, in a process of their own: VTK ends the process where no OpenGL library can be
loaded, and the numbers must be delivered all the same.
"""

from __future__ import annotations

import ctypes
import os
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

from pcbench.errors import InputError, MissingExtra, PcbenchError

_TIME_LIMIT_S = 600
_OPENGL = ("libEGL.so.1", "libOSMesa.so.8", "libOSMesa.so.6", "libOSMesa.so")


class NoFiguresError(PcbenchError):
    """Pictures cannot be drawn on this machine; the numbers are not concerned."""


def draw(report: Path, names: tuple[str, ...] = ()) -> list[Path]:
    """Draw the pictures of a report folder into its `figures/`, or those of them that are named.

    Returns:
        The files that were written.

    Raises:
        InputError: the folder holds no report, or no picture has that name.
        NoFiguresError, MissingExtra: a library is missing or fails.
    """
    if not any((report / name).is_file() for name in ("comparison.json", "deformation.json", "bench.json")):
        raise InputError(f"{report}: expected a report folder (with comparison.json) or a bench's (with bench.json)")
    if (report / "bench.json").is_file():
        _check_library("matplotlib")
    else:
        check_libraries()
    command = [sys.executable, "-m", "pcbench.report.plot.worker", str(report.absolute()), *names]
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=_TIME_LIMIT_S, env=drawing_environment(), check=False
        )
    except subprocess.TimeoutExpired:
        raise NoFiguresError(f"no pictures: drawing took longer than {_TIME_LIMIT_S} s") from None
    lines = done.stdout.splitlines()
    if done.returncode == 2 and lines:
        raise InputError(lines[-1])
    if done.returncode != 0:
        reason = next((line for line in reversed(done.stderr.splitlines()) if line.strip()), "it crashed")
        raise NoFiguresError(f"no pictures: drawing failed ({reason.strip()})")
    return [report / line for line in lines]


def draw_if_possible(report: Path) -> str | None:
    """Draw a report's pictures; what stands in the way is returned, because the numbers are delivered all the same."""
    try:
        draw(report)
    except PcbenchError as error:
        return str(error)
    return None


def check_libraries() -> None:
    """Say what is missing before VTK is loaded: it does not raise, it crashes.

    Raises:
        MissingExtra: pyvista or matplotlib is not installed.
        NoFiguresError: neither a display nor EGL nor OSMesa is there.
    """
    for library in ("pyvista", "matplotlib"):
        _check_library(library)
    try:
        check_opengl()
    except NoFiguresError as error:
        raise NoFiguresError(f"{error}, then run: pcbench plot REPORT") from None


def _check_library(name: str) -> None:
    if find_spec(name) is None:
        raise MissingExtra(name, "plot", "pictures")


def check_opengl() -> None:
    """Say that VTK cannot draw here.

    Raises:
        NoFiguresError: neither a display nor EGL nor OSMesa is there.
    """
    if not sys.platform.startswith("linux") or os.environ.get("DISPLAY"):
        return
    for name in _OPENGL:
        try:
            ctypes.CDLL(name)
            return
        except OSError:
            continue
    raise NoFiguresError(
        "no pictures: neither a display nor EGL nor OSMesa is there; install Debian's libegl1 (or libosmesa6)"
    )


def drawing_environment() -> dict[str, str]:
    """Environment variables of a drawing process: it must find this very package, wherever it is run from."""
    path = os.pathsep.join(filter(None, [str(Path(__file__).parents[3]), os.environ.get("PYTHONPATH")]))
    return {**os.environ, "PYTHONPATH": path, "MPLBACKEND": "agg", "PYVISTA_OFF_SCREEN": "true"}
