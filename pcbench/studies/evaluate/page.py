"""The articles of an evaluation: the answer and all tables, and a short one for each pair."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import partial

from pcbench.report.article import (
    Article,
    ArticleSection,
    Block,
    Bullets,
    DataTable,
    Heading,
    Link,
    Links,
    Paragraph,
    TableCell,
)
from pcbench.report.html import PAGE
from pcbench.report.words import UNKNOWN, join_words, number
from pcbench.studies.evaluate.charts import TIME
from pcbench.studies.evaluate.results import OK, MethodComparison, PairEvaluation, PairRecord, ScoreColumn
from pcbench.studies.evaluate.table import difference_rows, heading, scene_rows, shown_mean_rows, summary_rows
from pcbench.studies.evaluate.words import scenes_text
from pcbench.studies.frame.pages import drawn_pictures
from pcbench.studies.frame.rates import percent

_CAPTIONS = {TIME: "Mean scores against the mean time of each method"}
_MAX_SHOWN_COLUMNS = 3  # scores whose scenes are visible at once
_MAX_NAMES = 6
_MARKS = "Best in bold, second in italics; "
_ARROWS = "↓ lower is better, ↑ higher is better."


def article(study: MethodComparison, figures: Sequence[str] = ()) -> Article:
    """Return an evaluation as an article; `figures` are the files of its chart, relative to its folder."""
    pictures = partial(drawn_pictures, figures, _CAPTIONS)
    means = DataTable("Means over scenes", shown_mean_rows(study), sortable=True)
    legend = Paragraph((_MARKS if len(study.methods) > 1 else "") + _ARROWS)
    average = "Means over scenes" if len(study.scenes) > 1 else f"Scores on {study.scenes[0]}"
    sections = [ArticleSection(average, [means, legend])]
    sections += [ArticleSection("Accuracy against time", [picture]) for picture in pictures(TIME)]
    if len(study.scenes) > 1:
        if len(study.methods) > 1:
            summary = "all differences" if len(study.chosen_columns) > _MAX_SHOWN_COLUMNS else ""
            sections.append(ArticleSection("Differences to the best method", list(_differences(study)), summary))
        shown = study.chosen_columns[:_MAX_SHOWN_COLUMNS]
        sections.append(ArticleSection("Scores of each scene", list(_scenes(study, shown))))
        if rest := study.chosen_columns[_MAX_SHOWN_COLUMNS:]:
            sections.append(ArticleSection("Further scores of each scene", list(_scenes(study, rest)), "all scores"))
    sections.append(
        ArticleSection("All pairs", [DataTable("All pairs", _pair_rows(study), 3, sortable=True)], "all pairs")
    )
    return Article(
        kind=f"Evaluation by the protocol {study.protocol.title}",
        title=f"{join_words(study.methods, _MAX_NAMES)} on {_subject(study)}",
        answer=study.sentences,
        warnings=study.warnings,
        setup=[protocol_text(study)],
        sections=sections,
    )


def _subject(study: MethodComparison) -> str:
    return study.scenes[0] if len(study.scenes) == 1 else scenes_text(len(study.scenes))


def protocol_text(study: MethodComparison) -> str:
    """Return a sentence about the protocol, its source and its settings."""
    protocol = study.protocol
    settings = ", ".join(f"{name} {value}" for name, value in protocol.settings.items() if value)
    return (
        f"Protocol {protocol.text} ({protocol.citation}), as computed by {protocol.version}."
        + (f" Settings: {settings}." if settings else "")
        + f" Seed {study.settings.seed}."
    )


def _differences(study: MethodComparison) -> Iterator[Block]:
    yield DataTable("Differences to the best method", difference_rows(study))
    yield Paragraph(
        "Differences are means over the scenes, in which methods are compared pair by pair. The intervals are from a"
        " studentized bootstrap over scenes; those of all pairs of methods hold together with a probability of"
        f" {percent(study.level)}, because the best method is chosen afterwards. If an interval contains zero, these"
        " scenes do not tell the method from the best one. Mean rank: mean of the ranks in the scenes."
    )


def _scenes(study: MethodComparison, columns: Sequence[ScoreColumn]) -> Iterator[Block]:
    for column in columns:
        rows = scene_rows(study, column)
        title = [TableCell("over all scenes"), *[TableCell("")] * (len(rows[0]) - 1)]
        yield Heading(heading(column))
        yield DataTable(f"{column.name} of each scene", [*rows, title, *summary_rows(study, column)], sortable=True)
    yield Paragraph("Each number links to the page of its pair.")


def _pair_rows(study: MethodComparison) -> list[list[TableCell]]:
    header = ["scene", "method", "status", "seconds", "evaluation s", "register", "crop", "candidate", "message"]
    rows = [list(map(TableCell, header))]
    for pair in study.pairs:
        link = f"{pair.folder}/{PAGE}" if pair.folder else ""
        times = (UNKNOWN if value is None else f"{value:.3g}" for value in (pair.seconds, pair.evaluation_s))
        texts = [pair.method, pair.status, *times, pair.register, pair.crop, pair.candidate, pair.message]
        rows.append([TableCell(pair.scene, "", link), *map(TableCell, texts)])
    return rows


def pair_article(record: PairRecord, title: str, to_all: str) -> Article:
    """Return the evaluation of one pair as an article.

    Args:
        record: the evaluation.
        title: name of the protocol for people.
        to_all: path of the page of all pairs, relative to the folder of this one; empty if there is none.
    """
    pair = record.pair
    sections = []
    if pair.status == OK:
        sections.append(ArticleSection("Scores", [DataTable("Scores", _values(record.columns, pair.scores))]))
    if pair.counts:
        counts = DataTable("Counts", _values(record.count_columns, pair.counts))
        sections.append(ArticleSection("Counts", [counts]))
    if pair.notes:
        sections.append(ArticleSection("Notes", [Bullets(pair.notes)]))
    if to_all:
        sections.append(ArticleSection("More", [Links([Link("All scenes and methods", to_all)])]))
    return Article(
        kind=f"Evaluation by the protocol {title}",
        title=f"{pair.method} on {pair.scene}",
        answer=[pair_answer(record)],
        warnings=[],
        setup=list(_pair_setup(record)),
        sections=sections,
    )


def pair_answer(record: PairRecord) -> str:
    """Return the scores of a pair in one sentence, or why there are none."""
    pair = record.pair
    if pair.status != OK:
        return f"{pair.method} on {pair.scene} has no scores: {pair.message}"
    parts = (f"{c.name} {number(pair.scores[c.name])} {c.unit}".rstrip() for c in record.columns[:_MAX_NAMES])
    rest = f" and {len(record.columns) - _MAX_NAMES} further scores" if len(record.columns) > _MAX_NAMES else ""
    return f"{', '.join(parts)}{rest}."


def score_text(value: float | None, unit: str) -> str:
    """Return a score with its unit; a dash for None."""
    return UNKNOWN if value is None else f"{value:.8g} {unit}".rstrip()


def _pair_setup(record: PairRecord) -> Iterator[str]:
    pair = record.pair
    yield f"Reference: {pair.reference or 'none'}. Candidate: {pair.candidate}."
    region = "" if pair.crop == "none" else f"; region: {pair.crop}"
    yield f"Protocol {record.protocol}; pose: {_pose(pair)}{region}."


def _pose(pair: PairEvaluation) -> str:
    return "as given" if pair.register == "none" else pair.register


def _values(columns: Sequence[ScoreColumn], values: Mapping[str, float | None]) -> list[list[str]]:
    """Return header and rows of the values of a pair, without columns that are empty."""
    rows = [["", "value", "unit", "better"]]
    for column in columns:
        rows.append([column.name, _value_text(values[column.name]), column.unit, column.better or ""])
    has_text = [column < 2 or any(row[column] for row in rows[1:]) for column in range(len(rows[0]))]
    return [[text for text, is_kept in zip(row, has_text, strict=True) if is_kept] for row in rows]


def _value_text(value: float | None) -> str:
    if value is None:
        return UNKNOWN
    return f"{value:,.0f}" if value.is_integer() and abs(value) >= 1000 else f"{value:.7g}"
