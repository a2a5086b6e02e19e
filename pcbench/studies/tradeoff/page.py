"""The article of the trade-off study: the answer first, then charts and tables."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import PurePath

from pcbench.report.article import Article, ArticleSection, Bullets, DataTable, Figure, Paragraph
from pcbench.studies.tradeoff.results import Tradeoff
from pcbench.studies.tradeoff.table import LEGEND, error_rows, table_rows
from pcbench.studies.tradeoff.words import answer, bias_sentences, percent, verdict_sentences, warnings

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
    sections = [
        ArticleSection(
            "Error and cost",
            [
                *_picture("errors", figures),
                DataTable("Errors and costs of approximations", table_rows(study)),
                Paragraph(f"{LEGEND[0].upper()}{LEGEND[1:]}."),
            ],
        ),
        ArticleSection("Bias of mean distances", [Bullets(list(bias_sentences(study))), *_picture("bias", figures)]),
        ArticleSection("The verdict on deformation", [Bullets(list(verdict_sentences(study)))]),
        ArticleSection(
            "Errors of all metrics in %", [DataTable("Errors of all metrics", error_rows(study))], "all errors"
        ),
    ]
    return Article(
        kind="Trade-off between cost and accuracy",
        title=f"What cheaper comparisons cost, at a tolerance of {percent(study.settings.tolerance)}",
        answer=list(answer(study)),
        warnings=list(warnings(study)),
        setup=[setup],
        sections=sections,
    )


def _picture(name: str, figures: Sequence[str]) -> list[Figure]:
    return [Figure(file, _CAPTIONS[name]) for file in figures if PurePath(file).stem == name]
