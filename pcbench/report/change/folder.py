"""The folder of a measured change: its document, tables, maps, pictures, sheets and page."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

from pcbench.io.json_values import to_json
from pcbench.measure.dem.result import AreaHistory
from pcbench.report.article import markdown
from pcbench.report.change.article import article
from pcbench.report.change.document import DOCUMENT, SCHEMA, ChangeDocument
from pcbench.report.change.maps import write_maps
from pcbench.report.change.tables import CSV, volumes_csv
from pcbench.report.figures import Figures, record_figures
from pcbench.report.html import PAGE, Origin, article_page, write_page
from pcbench.report.plot import Drawer, Drawn, draw_if_possible

MARKDOWN = "change.md"
PICTURES = Drawer("pcbench.report.change.pictures:pictures", (DOCUMENT,), SCHEMA)
"""Draws the pictures of a folder."""


class ChangeFiles(NamedTuple):
    """Why the page or requested pictures of a change are missing, or None."""

    without_page: str | None = None
    without_figures: str | None = None


def write_change(
    folder: Path,
    history: AreaHistory,
    document: ChangeDocument,
    figures: Figures | None,
    step: Callable[[str], None],
) -> ChangeFiles:
    """Write a change into an empty folder.

    Args:
        folder: the folder.
        history: the measured change.
        document: the same as plain values.
        figures: appearance of the pictures, recorded in settings.json; None: draw none, and no sheets.
        step: called with a short text before each step that takes time.

    Raises:
        OSError: a file cannot be written.
    """
    step("writing the maps")
    (folder / DOCUMENT).write_text(to_json(document.values()), encoding="utf-8")
    # File names need not be Unicode.
    (folder / CSV).write_text(volumes_csv(document), encoding="utf-8", errors="backslashreplace")
    write_maps(folder, history)
    drawn = Drawn([])
    if figures is not None:
        record_figures(folder / "settings.json", figures)
        step("drawing the pictures")
        drawn = draw_if_possible(folder, PICTURES, replace(figures, format="png"))  # for the page
        if figures.format != "png" and drawn.problem is None:
            draw_if_possible(folder, PICTURES, figures)
    made = article(document, drawn.relative_to(folder))
    problems = [
        write_page(folder / MARKDOWN, partial(markdown, made)),
        write_page(folder / PAGE, lambda: article_page(made, Origin(document.provenance), folder)),
    ]
    return ChangeFiles("; ".join(filter(None, problems)) or None, drawn.problem)
