"""The article of the experiment: conclusions, failures, tables, pictures, and links to the reports of its scenes."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import PurePath

from pcbench.report.article import Article, ArticleSection, Block, Bullets, DataTable, Link, Links, Paragraph
from pcbench.report.html import PAGE
from pcbench.studies.frame.pages import drawn_pictures
from pcbench.studies.gao.results import GaoStudy
from pcbench.studies.gao.sentences import answer, warnings
from pcbench.studies.gao.table import (
    INJECTED,
    LEGEND,
    cost_table,
    failures,
    injection_table,
    measures_table,
    notes,
    verdicts,
)
from pcbench.studies.views.page import score_blocks, view_pictures
from pcbench.studies.views.scores import ViewStudy
from pcbench.studies.views.table import warnings as views_warnings

_CAPTIONS = {
    "directions": "Accuracy and completeness of each cloud against both references",
    "rings": "Positions of the cameras from above and from the side, and the measured region",
    "growth": "Vertical displacement by distance from the centre and by height",
}


def article(
    study: GaoStudy,
    views: ViewStudy | None,
    figures: Sequence[str] = (),
    view_figures: Sequence[str] = (),
    reports: Sequence[str] = (),
) -> Article:
    """Return the experiment as an article.

    Args:
        study: the experiment.
        views: scores of the novel views, if there are any.
        figures: files of its pictures; all files are relative to the folder of the experiment.
        view_figures: files of the pictures of novel views.
        reports: folders of the reports of each scene against each reference.
    """
    unit = study.unit or "unit"
    pictures = partial(drawn_pictures, figures, _CAPTIONS)
    measures: list[Block] = [
        *pictures("directions"),
        DataTable("Measures of each cloud against both references", list(measures_table(study)), 2),
        Paragraph(f"{LEGEND.format(unit=unit)}."),
    ]
    if reports:
        measures.append(Links([Link(_report_title(PurePath(folder)), f"{folder}/{PAGE}") for folder in reports]))
    sections = [
        ArticleSection("Clouds against both references", measures),
        ArticleSection("Time and memory", [DataTable("Time and memory of each cloud", list(cost_table(study)))]),
    ]
    if any(scene.injected for scene in study.scenes):
        injected = DataTable("Verdicts on deformations of known size", list(injection_table(study)))
        sections.append(
            ArticleSection("Deformations of known size", [Paragraph(f"{INJECTED.format(unit=unit)}."), injected])
        )
    if views is not None:
        sections.append(ArticleSection("New views", [*score_blocks(views), *view_pictures(view_figures)]))
    sections += [
        ArticleSection("Verdicts", [Bullets(list(verdicts(study))), *pictures("growth")]),
        ArticleSection("Cameras and notes", [*pictures("rings"), Bullets(list(notes(study)))]),
    ]
    return Article(
        kind="Gao et al. 2025",
        title="The paper, reproduced",
        answer=list(answer(study)),
        warnings=[*failures(study), *warnings(study), *(() if views is None else views_warnings(views))],
        setup=[],
        sections=sections,
    )


def _report_title(folder: PurePath) -> str:
    """Return the text of the link to a report, whose folder is such as `city_1/against-mvs`."""
    return f"{folder.parent.as_posix()} {folder.name.replace('-', ' ')}: the complete comparison"
