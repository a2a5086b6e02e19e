"""Pictures of a report: deviation maps (pyvista) and distributions (matplotlib).

They are drawn from a report folder, in a process of their own: VTK ends the process where no OpenGL library can be
loaded, and the numbers must be delivered all the same. A study draws its charts in the same way, with a `Drawer` of its
own.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

from pcbench.children import Limits, run_module
from pcbench.errors import InputError, MissingExtra, PcbenchError
from pcbench.opengl import OFF_SCREEN, NoFiguresError, check_opengl

_MAX_SECONDS = 600


class Picture(NamedTuple):
    """One picture of a folder.

    Args:
        draw: writes it to a path; false where there is nothing to draw.
        why_not: what is then said to somebody who asked for it by name.
    """

    draw: Callable[[Path], bool]
    why_not: str = "there is nothing to draw"


class Drawer(NamedTuple):
    """What draws the pictures of one kind of folder.

    Args:
        function: `module:function` of a function from the folder to its pictures by name, `dict[str, Picture]`. It is
            looked up in the drawing process alone, so that libraries for drawing are loaded there and nowhere else.
        documents: a folder of this kind holds one of these files.
        is_spatial: whether pyvista draws, which needs OpenGL; else matplotlib alone does.
    """

    function: str
    documents: tuple[str, ...]
    is_spatial: bool

    def fits(self, folder: Path) -> bool:
        """Whether the folder is of its kind."""
        return any((folder / name).is_file() for name in self.documents)


REPORT = Drawer("pcbench.report.plot.pictures:pictures", ("comparison.json", "deformation.json"), is_spatial=True)


def draw(report: Path, names: tuple[str, ...] = (), drawer: Drawer = REPORT) -> list[Path]:
    """Draw the pictures of a report folder into its `figures/`, or those of them that are named.

    Returns:
        The files that were written.

    Raises:
        InputError: the folder is not of the drawer's kind, or no picture has that name.
        NoFiguresError, MissingExtra: a library is missing or fails.
    """
    if not drawer.fits(report):
        raise InputError(f"{report}: expected a report folder (with {' or '.join(drawer.documents)})")
    if drawer.is_spatial:
        check_libraries()
    else:
        _check_library("matplotlib")
    done = run_module(
        "pcbench.report.plot.worker",
        str(report.absolute()),
        drawer.function,
        *names,
        limits=Limits(seconds=_MAX_SECONDS),
        environment=OFF_SCREEN,
    )
    if done.timed_out:
        raise NoFiguresError(f"no pictures: drawing took longer than {_MAX_SECONDS} s")
    lines = done.output.splitlines()
    if done.code == 2 and lines:
        raise InputError(lines[-1])
    if done.code != 0:
        raise NoFiguresError(f"no pictures: drawing failed ({done.last_words or 'it crashed'})")
    return [report / line for line in lines]


def draw_if_possible(report: Path, drawer: Drawer = REPORT) -> str | None:
    """Draw a report's pictures; what stands in the way is returned, because the numbers are delivered all the same."""
    try:
        draw(report, drawer=drawer)
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
