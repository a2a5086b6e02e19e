"""The article of the trade-off study: the answer first, then charts and tables."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

from pcbench.report.article import Article, ArticleSection, DataTable, Paragraph
from pcbench.studies.frame.pages import drawn_pictures
from pcbench.studies.tradeoff.results import Tradeoff
from pcbench.studies.tradeoff.table import LEGEND, error_rows, table_rows
from pcbench.studies.tradeoff.words import percent, warnings

_CAPTIONS = {
    "errors": "Error of each metric beside CPU seconds",
    "bias": "Bias of mean distances to thinned clouds, with and without the correction by the floor",
}


def article(study: Tradeoff, figures: Sequence[str] = ()) -> Article:
    """Return the study as an article; `figures` are the files of its charts, relative to its folder."""
    exact = study.exact
    unit = f" {exact.unit}" if exact.unit else ""
    threshold = "" if exact.threshold is None else f" F-score at {exact.threshold:.4g}{unit}."
    setup = (
        f"Reference of {exact.points[0]:,} and candidate of {exact.points[1]:,} points; the exact comparison takes"
        f" {exact.cpu_s:.3g} CPU s. {study.settings.seeds} rounds with different seeds; intervals are 95 % prediction"
        f" intervals of one run.{threshold}"
    )
    pictures = partial(drawn_pictures, figures, _CAPTIONS)
    legend = Paragraph(f"{LEGEND[0].upper()}{LEGEND[1:]}.")
    table = DataTable("Errors and costs of approximations", table_rows(study))
    errors = DataTable("Errors of all metrics", error_rows(study))
    sections = [
        ArticleSection("Error and cost", [*pictures("errors"), table, legend]),
        *(ArticleSection("Bias of mean distances", [picture]) for picture in pictures("bias")),
        ArticleSection("Errors of all metrics in %", [errors], "all errors"),
    ]
    return Article(
        kind="Trade-off between cost and accuracy",
        title=f"What cheaper comparisons cost, at a tolerance of {percent(study.settings.tolerance)}",
        answer=study.sentences,
        warnings=list(warnings(study)),
        setup=[setup],
        sections=sections,
    )
