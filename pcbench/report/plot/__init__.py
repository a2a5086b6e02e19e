"""Pictures of a report: maps of distances and deformation, and distributions.

A child process draws them with matplotlib from a report folder, with a time limit, so that a failure does not affect
the numbers. `splats` renders clouds as images without a graphics library. A study draws its charts in the same way,
with its own `Drawer`.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from pcbench.children import Limits, run_module
from pcbench.errors import InputError, PcbenchError, record_error
from pcbench.extras import require
from pcbench.opengl import OFF_SCREEN_ENVIRONMENT, NoFiguresError
from pcbench.regular_files import read_json_object
from pcbench.report.figures import Figures, recorded_figures
from pcbench.report.manifest import check_figures_folder, complete_replacement, record_files

_MAX_SECONDS = 600


class Picture(NamedTuple):
    """A picture of a folder.

    Args:
        draw: writes the picture to a path; returns false if there is nothing to draw.
        reason: the message for a user who requested it by name if there is nothing to draw.
        file: its path relative to the folder if it has only one format; None: `figures/NAME.FORMAT`.
    """

    draw: Callable[[Path], bool]
    reason: str = "there is nothing to draw"
    file: str | None = None


class Drawer(NamedTuple):
    """The function that draws the pictures of one kind of folder.

    Args:
        function: `module:function` of a function that takes the folder and `Figures` and returns `dict[str, Picture]`.
            Only the drawing process imports it, so that drawing libraries are loaded only there.
        documents: file names, one of which identifies a folder of this kind.
        schema: schema of the document, if folders of other kinds have a document of the same name.
    """

    function: str
    documents: tuple[str, ...]
    schema: str | None = None

    def fits(self, folder: Path) -> bool:
        """Return whether a folder is of this kind."""
        files = [folder / name for name in self.documents]
        if self.schema is None:
            return any(file.is_file() for file in files)
        return any(read_json_object(file).get("schema") == self.schema for file in files)


class Drawn(NamedTuple):
    """The files of drawn pictures, or the reason why they could not be drawn."""

    files: list[Path]
    problem: str | None = None

    def relative_to(self, folder: Path) -> list[str]:
        """Return the files relative to a folder, with forward slashes."""
        return [path.relative_to(folder).as_posix() for path in self.files]


REPORT = Drawer("pcbench.report.plot.pictures:pictures", ("comparison.json", "deformation.json"))


def draw(
    report: Path, names: tuple[str, ...] = (), drawer: Drawer = REPORT, figures: Figures | None = None
) -> list[Path]:
    """Draw all or some pictures of a report folder into its `figures/`.

    Args:
        report: the folder.
        names: names of the pictures, all by default. An extension selects the format, as in `distribution.svg`.
        drawer: the kind of folder.
        figures: appearance of the pictures; default: as recorded in the report.

    Returns:
        The written files.

    Raises:
        InputError: the folder is not of the drawer's kind, its `figures` is a link, or no picture has that name.
        NoFiguresError, MissingExtra: matplotlib is missing or fails.
    """
    complete_replacement(report)
    if not drawer.fits(report):
        raise InputError(f"{report}: expected a report folder (with {' or '.join(drawer.documents)})")
    check_figures_folder(report)
    style = figures or recorded_figures(report / "settings.json")
    result = run_module(
        "pcbench.report.plot.worker",
        str(report.absolute()),
        drawer.function,
        json.dumps(style.plain()),
        *names,
        limits=Limits(seconds=_MAX_SECONDS),
        environment=OFF_SCREEN_ENVIRONMENT,
    )
    if result.timed_out:
        raise NoFiguresError(f"no pictures: drawing took longer than {_MAX_SECONDS} s")
    lines = result.output.splitlines()
    if result.code == 2 and lines:
        raise InputError(lines[-1])
    if result.code != 0:
        require("matplotlib")
        raise NoFiguresError(f"no pictures: drawing failed ({result.last_error_line or 'it crashed'})")
    record_files(report, lines)
    return [report / line for line in lines]


def drawing_seconds(candidates: int) -> float:
    """Return the approximate time to draw the pictures of a report, for progress bars."""
    return 2.0 + 2.0 * candidates


def draw_if_possible(report: Path, drawer: Drawer = REPORT, figures: Figures | None = None) -> Drawn:
    """Draw the pictures of a report; the numbers do not depend on them."""
    try:
        return Drawn(draw(report, drawer=drawer, figures=figures))
    except PcbenchError as error:
        return Drawn([], record_error(error))
