"""The article of a bench: the best configurations, failures and doubts, charts and tables."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from pcbench.report.article import Article, ArticleSection, Bullets, DataTable, Paragraph
from pcbench.report.words import join_words
from pcbench.studies.bench.pareto import Configuration, configurations, front_configurations, fscore_column
from pcbench.studies.bench.results import Bench
from pcbench.studies.bench.table import LABELS, bench_table, legend, threshold_table, threshold_text, warnings
from pcbench.studies.frame.pages import drawn_pictures

_CAPTIONS = {
    "speed": "Accuracy against wall time: F-score, where higher is better, and Chamfer distance, where lower is better",
    "accuracy_completeness": "Accuracy and completeness against wall time: precision, recall and mean distances",
}


def article(study: Bench, figures: Sequence[str] = ()) -> Article:
    """Return a bench as an article; `figures` are the files of its charts, relative to its folder."""
    scene, reference = Path(study.scene.path), Path(study.reference.path)
    methods = list(dict.fromkeys(row.method for row in study.rows))
    table = DataTable("Time, memory and scores of each configuration", bench_table(study), LABELS)
    ranks = Paragraph("Best in bold, second in italics.")
    charts = drawn_pictures(figures, _CAPTIONS, *_CAPTIONS)
    sections = [ArticleSection("Time against accuracy", [*charts, table, ranks, Bullets(list(legend(study)))])]
    if thresholds := threshold_table(study):
        sections.append(ArticleSection("At each threshold", [DataTable("Scores at each threshold", thresholds, 2)]))
    return Article(
        kind="Reconstructors side by side",
        title=f"{join_words(methods, 4)} on {scene.name or scene}, against {reference.name}",
        answer=list(_answer(study)),
        warnings=warnings(study),
        setup=[],
        sections=sections,
    )


def _answer(study: Bench) -> Iterator[str]:
    """Yield the configuration with the highest F-score, and the faster ones on the Pareto front."""
    groups = configurations(study.rows)
    column = fscore_column(study.rows)
    front = front_configurations(groups, column, higher_is_better=True)
    if not front:
        yield "No configuration was measured with all seeds." if study.scores else "No run could be measured."
        return
    *faster, best = front
    alone = sum(group.is_reliable for group in groups) == 1
    article_word = "an" if alone else "the highest"
    clause = f" at {threshold_text(study)}{' over what the cameras saw' if column == 'fscore_visible' else ''}"
    yield f"{best.name} has {article_word} F-score of {_score(best, column)}{clause}, in {_seconds(best)}."
    if faster:
        others = [f"{c.name} ({_score(c, column)} in {_seconds(c)})" for c in faster]
        yield f"Faster, with the best F-score for their time: {join_words(others)}."


def _score(c: Configuration, column: str) -> str:
    return f"{c.median(column) or 0.0:.4g}"


def _seconds(c: Configuration) -> str:
    return f"{c.median('wall_s') or 0.0:.4g} s"
