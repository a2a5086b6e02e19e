"""Pictures of a report: maps of distances and deformation, and distributions.

They are drawn with matplotlib from a report folder, in a process of their own with a time limit: whatever happens
there, the numbers are delivered. Clouds become images in `splats`, without any graphics library. A study draws its
charts in the same way, with a `Drawer` of its own.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from pcbench.children import Limits, run_module
from pcbench.errors import InputError, PcbenchError, recorded
from pcbench.extras import require
from pcbench.opengl import OFF_SCREEN, NoFiguresError
from pcbench.report.figures import Figures, recorded_figures
from pcbench.report.manifest import check_figures_folder, complete_replacement, record_files

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
        function: `module:function` of a function from the folder and `Figures` to its pictures by name,
            `dict[str, Picture]`. It is looked up in the drawing process alone, so that libraries for drawing are loaded
            there and nowhere else.
        documents: a folder of this kind holds one of these files.
    """

    function: str
    documents: tuple[str, ...]

    def fits(self, folder: Path) -> bool:
        """Whether the folder is of its kind."""
        return any((folder / name).is_file() for name in self.documents)


REPORT = Drawer("pcbench.report.plot.pictures:pictures", ("comparison.json", "deformation.json"))


def draw(
    report: Path, names: tuple[str, ...] = (), drawer: Drawer = REPORT, figures: Figures | None = None
) -> list[Path]:
    """Draw the pictures of a report folder into its `figures/`, or those of them that are named.

    Args:
        names: with an ending, `distribution.svg`, in that format.
        figures: how they look; None: as the report's settings have it.

    Returns:
        The files that were written.

    Raises:
        InputError: the folder is not of the drawer's kind, its `figures` is a link, or no picture has that name.
        NoFiguresError, MissingExtra: matplotlib is missing or fails.
    """
    complete_replacement(report)
    if not drawer.fits(report):
        raise InputError(f"{report}: expected a report folder (with {' or '.join(drawer.documents)})")
    check_figures_folder(report)
    look = figures or recorded_figures(report / "settings.json")
    done = run_module(
        "pcbench.report.plot.worker",
        str(report.absolute()),
        drawer.function,
        json.dumps(look.plain()),
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
        require("matplotlib")
        raise NoFiguresError(f"no pictures: drawing failed ({done.last_words or 'it crashed'})")
    record_files(report, lines)
    return [report / line for line in lines]


def drawing_seconds(candidates: int) -> float:
    """Roughly what the pictures of a report take, for progress bars."""
    return 2.0 + 2.0 * candidates


def draw_if_possible(report: Path, drawer: Drawer = REPORT, figures: Figures | None = None) -> str | None:
    """Draw a report's pictures; what stands in the way is returned, because the numbers are delivered all the same."""
    try:
        draw(report, drawer=drawer, figures=figures)
    except PcbenchError as error:
        return recorded(error)
    return None
