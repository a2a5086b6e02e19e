"""The article of a bench: the best configurations, failures and doubts, charts and tables; and its page."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from pcbench.report.article import Article, ArticleSection, Bullets, DataTable, Figure, Paragraph
from pcbench.report.plot import draw_if_possible
from pcbench.report.words import join_words
from pcbench.studies.bench.charts import CHARTS
from pcbench.studies.bench.pareto import Configuration, choice_text, configurations, front_configurations
from pcbench.studies.bench.table import LABELS, bench_table, legend, run_lines, threshold_table, threshold_text
from pcbench.studies.folder import write_report

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
        warnings=[*run_lines(doc), *doc["notes"]],
        setup=[],
        sections=sections,
    )


def write_bench_report(out: Path, doc: dict[str, Any], *, figures: bool) -> list[str]:
    """Draw the charts of a bench into its folder, and write its page; return what failed, one line each.

    Args:
        out: folder of the bench.
        doc: document of bench.json.
        figures: whether to draw charts.

    Raises:
        OSError: the page cannot be written.
    """
    drawn = draw_if_possible(out, CHARTS) if figures else None
    files = [] if drawn is None else [path.relative_to(out).as_posix() for path in drawn.files]
    inputs = [(role, doc[role]["path"], doc[role]["sha256"]) for role in ("scene", "reference")]
    if (mesh := doc["reference"]["mesh"]) is not None:
        inputs.append(("true surface", mesh["path"], mesh["sha256"]))
    without_page = write_report(out, article(doc, files), doc["provenance"], inputs)
    return [*filter(None, (without_page, None if drawn is None else drawn.problem))]


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
