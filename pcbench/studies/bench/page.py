"""The article of a bench: the best configurations, failures and doubts, charts and tables."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from pcbench.report.article import Article, ArticleSection, Bullets, DataTable, Figure, Paragraph
from pcbench.report.words import join_words
from pcbench.studies.bench.pareto import Configuration, choice_text, configurations, front_configurations
from pcbench.studies.bench.table import LABELS, bench_table, legend, threshold_table, threshold_text, warnings

_CAPTIONS = {
    "speed": "Accuracy against wall time: F-score, where higher is better, and Chamfer distance, where lower is better",
    "accuracy_completeness": "Accuracy and completeness against wall time: precision, recall and mean distances",
}


def article(doc: dict[str, Any], figures: Sequence[str] = ()) -> Article:
    """Return a bench as an article.

    Args:
        doc: document of bench.json.
        figures: files of the charts, relative to the folder of the bench.
    """
    scene, reference = (Path(doc[key]["path"]) for key in ("scene", "reference"))
    methods = list(dict.fromkeys(row["method"] for row in doc["rows"]))
    charts = [Figure(file, _CAPTIONS[Path(file).stem]) for file in figures]
    table = DataTable("Time, memory and scores of each configuration", bench_table(doc), LABELS)
    sections = [ArticleSection("Time against accuracy", [*charts, table, Paragraph("Best in bold, second in italics."),
                                                  Bullets(list(legend(doc)))])]  # fmt: skip
    if thresholds := threshold_table(doc):
        sections.append(ArticleSection("At each threshold", [DataTable("Scores at each threshold", thresholds, 2)]))
    return Article(
        kind="Reconstructors side by side",
        title=f"{join_words(methods, 4)} on {scene.name or scene}, against {reference.name}",
        answer=list(_answer(doc)),
        warnings=warnings(doc),
        setup=[],
        sections=sections,
    )


def _answer(doc: dict[str, Any]) -> Iterator[str]:
    """Yield the configuration with the highest F-score, and the faster ones on the Pareto front."""
    found = configurations(doc["rows"])
    front = front_configurations(found, "fscore", higher_is_better=True)
    if not front:
        measured = any(c.measured_rows for c in found)
        yield "No configuration was measured with all seeds." if measured else "No run could be measured."
        return
    *faster, best = front
    alone = sum(c.is_reliable and c.median("fscore") is not None for c in found) == 1
    threshold = threshold_text(doc)
    at = "" if threshold is None else f" at {threshold}"
    yield f"{_name(best)} has {'an' if alone else 'the highest'} F-score of {_score(best)}{at}, in {_seconds(best)}."
    if faster:
        others = [f"{_name(c)} ({_score(c)} in {_seconds(c)})" for c in faster]
        yield f"Faster, with the best F-score for their time: {join_words(others)}."


def _name(c: Configuration) -> str:
    return " ".join(filter(None, (c.method, choice_text(c.choices))))


def _score(c: Configuration) -> str:
    return f"{c.median('fscore') or 0.0:.4g}"


def _seconds(c: Configuration) -> str:
    return f"{c.median('wall_s') or 0.0:.4g} s"
