"""The article of rendered views: scores in words, the table, and pictures of the worst, median and best views."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from pcbench.measure.wording import pluralize
from pcbench.report.article import Article, ArticleSection, Block, Bullets, DataTable, Figure
from pcbench.studies.views.scores import ViewStudy
from pcbench.studies.views.table import answer, legend, table, warnings


def article(study: ViewStudy, figures: Sequence[str] = ()) -> Article:
    """Return scores of rendered views as an article.

    Args:
        study: the scores.
        figures: files of the pictures, relative to the folder of the study.
    """
    scenes = [scene.views.scene for scene in study.scenes]
    sections = [ArticleSection("Scores", score_blocks(study))]
    if figures:
        sections.append(ArticleSection("Pictures, from the worst to the best view", view_pictures(figures)))
    return Article(
        kind="Rendered views",
        title=f"Rendered views of {scenes[0] if len(scenes) == 1 else pluralize(len(scenes), 'scene')}",
        answer=list(answer(study)),
        warnings=warnings(study),
        setup=[],
        sections=sections,
    )


def score_blocks(study: ViewStudy) -> list[Block]:
    """Return the table of scores and its legend."""
    rows = table(study)
    return [DataTable("Scores of training and held-out views", rows, rows[0].index("views")), Bullets(legend(study))]


def view_pictures(figures: Sequence[str]) -> list[Block]:
    """Return pictures of views with captions; `figures` are their files, relative to the folder of the article."""
    what = "photograph, rendering, and absolute error in grey levels"
    return [Figure(file, f"{Path(file).stem}: {what}") for file in figures]
