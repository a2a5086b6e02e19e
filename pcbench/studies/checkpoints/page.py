"""The article of `pcbench checkpoints`: the answer and the statement, the pictures, and the tables."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

from pcbench.geometry.crs import crs_label
from pcbench.measure.wording import pluralize
from pcbench.report.article import Article, ArticleSection, Block, Bullets, DataTable
from pcbench.report.checkpoints import point_rows, statistics_rows
from pcbench.studies.checkpoints.results import CheckPointStudy
from pcbench.studies.frame.pages import drawn_pictures

_CAPTIONS = {
    "errors": "Error of height at each check point, cloud minus survey, with the RMSE, and their histogram",
    "map": "Errors of height on the cloud's plan view; hollow: not covered by the cloud",
}


def article(study: CheckPointStudy, figures: Sequence[str] = ()) -> Article:
    """Return the study as an article; `figures` are the files of its pictures, relative to its folder."""
    accuracy = study.accuracy
    system = "an unnamed coordinate system" if study.crs is None else crs_label(study.crs)
    unit = "an unknown unit" if accuracy.unit is None else accuracy.unit
    pictures = partial(drawn_pictures, figures, _CAPTIONS)
    statistics: list[Block] = list(pictures("errors"))
    if rows := statistics_rows(accuracy):
        statistics.append(DataTable("Statistics of the errors", rows))
    sections = [
        *([ArticleSection("Statement", [Bullets(study.statements)])] if study.statements else []),
        ArticleSection("Errors", statistics),
        *(ArticleSection("Map", [picture]) for picture in pictures("map")),
        ArticleSection("Check points", [DataTable("Error at each check point", point_rows(accuracy), 2)]),
    ]
    return Article(
        kind="Accuracy by check points",
        title=f"Accuracy of {Path(study.cloud).name} by {pluralize(len(accuracy.points), 'check point')}",
        answer=study.sentences,
        warnings=study.warnings,
        setup=[
            f"{pluralize(study.count, 'point')} of {study.cloud}, and {pluralize(len(accuracy.points), 'check point')}"
            f" of {study.check_points}, in {system}; lengths in {unit}.",
            " ".join(study.notes),
        ],
        sections=sections,
    )
