"""Pictures of a report: deviation maps (pyvista), distributions and the charts of a bench (matplotlib).

They are drawn from a report folder, in a process of their own: VTK ends the process where no OpenGL library can be
loaded, and the numbers must be delivered all the same.
"""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

from pcbench.children import Limits, run_module
from pcbench.errors import InputError, MissingExtra, PcbenchError
from pcbench.opengl import OFF_SCREEN, NoFiguresError, check_opengl

_TIME_LIMIT_S = 600


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
    done = run_module(
        "pcbench.report.plot.worker",
        str(report.absolute()),
        *names,
        limits=Limits(seconds=_TIME_LIMIT_S),
        environment=OFF_SCREEN,
    )
    if done.timed_out:
        raise NoFiguresError(f"no pictures: drawing took longer than {_TIME_LIMIT_S} s")
    lines = done.output.splitlines()
    if done.code == 2 and lines:
        raise InputError(lines[-1])
    if done.code != 0:
        raise NoFiguresError(f"no pictures: drawing failed ({done.last_words or 'it crashed'})")
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
