"""Tables of an evaluation: means over scenes, and the scores of each scene; as text, LaTeX and CSV."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from statistics import median

from pcbench.report.article import Mark, TableCell
from pcbench.report.html import PAGE
from pcbench.report.markup import csv_text, latex, latex_row, latex_tabular
from pcbench.report.words import UNKNOWN, interval_text
from pcbench.studies.evaluate.results import FAILED, MISSING, OK, MethodComparison, MethodMean, ScoreColumn, ScoreRow

MAX_PRINTED_COLUMNS = 3  # scores whose scenes are printed; files have all
_MAX_COLUMNS = 5  # scores beside each other in the table of means
_SIGNIFICANT_DIGITS = 3
_FIXED_EXPONENTS = range(-5, 6)  # of typical values that are written without exponent
_ARROWS = {"lower": "↓", "higher": "↑", None: ""}
_LATEX_MARKS: dict[Mark, str] = {"": "{}", "best": r"\textbf{{{}}}", "second": r"\underline{{{}}}"}
_NO_SCORE = {MISSING: "missing", FAILED: "failed"}


def number_format(values: Sequence[float | None]) -> str:
    """Return a format with the same decimals for all numbers of a score: three digits of a typical one."""
    sizes = [abs(value) for value in values if value]
    exponent = math.floor(math.log10(median(sizes))) if sizes else 0
    if exponent not in _FIXED_EXPONENTS:
        return f".{_SIGNIFICANT_DIGITS}g"
    return f",.{max(0, _SIGNIFICANT_DIGITS - 1 - exponent)}f"


def score_format(study: MethodComparison, column: ScoreColumn) -> str:
    """Return the format of all numbers of a score."""
    return number_format([pair.scores.get(column.name) for pair in study.pairs])


def heading(column: ScoreColumn) -> str:
    """Return the name of a score with its unit, and an arrow towards better values."""
    return f"{column.title} {_ARROWS[column.better]}".rstrip()


def marks(values: Mapping[str, float | None], column: ScoreColumn) -> dict[str, Mark]:
    """Return which methods have the best and the second-best value; none if fewer than two values differ."""
    ordered = sorted({value for value in values.values() if value is not None}, reverse=column.better == "higher")
    if column.better is None or len(ordered) < 2:
        return dict.fromkeys(values, "")
    places: dict[float | None, Mark] = {ordered[0]: "best", ordered[1]: "second"}
    return {method: places.get(value, "") for method, value in values.items()}


def mean_rows(study: MethodComparison) -> list[list[TableCell]]:
    """Return header and rows of the means over scenes: methods by chosen scores."""
    header = [TableCell("method"), *(TableCell(heading(column)) for column in study.chosen_columns)]
    cells: list[dict[str, TableCell]] = []
    for column in study.chosen_columns:
        form = score_format(study, column)
        values = {mean.method: mean.mean for mean in study.means_of(column.name)}
        marked = marks(values, column)
        cells.append({m: TableCell(_text(value, form), marked[m]) for m, value in values.items()})
    return [header, *([TableCell(method), *(column[method] for column in cells)] for method in study.methods)]


def shown_mean_rows(study: MethodComparison) -> list[list[TableCell]]:
    """Return the rows of the means as they fit into a window: many scores of fewer methods are rows."""
    rows = mean_rows(study)
    if len(study.chosen_columns) <= max(_MAX_COLUMNS, len(study.methods)):
        return rows
    return [list(row) for row in zip([TableCell("score"), *rows[0][1:]], *rows[1:], strict=True)]


def scene_rows(study: MethodComparison, column: ScoreColumn) -> list[list[TableCell]]:
    """Return header and rows of a score: scenes by methods, with links to the pages of the pairs."""
    form = score_format(study, column)
    rows = [[TableCell("scene"), *(TableCell(method) for method in study.methods)]]
    for scene in study.scenes:
        pairs = {method: study.pair(scene, method) for method in study.methods}
        values = {m: None if pair is None else pair.scores.get(column.name) for m, pair in pairs.items()}
        marked = marks(values, column)
        row = [TableCell(scene)]
        for method, pair in pairs.items():
            is_measured = pair is None or pair.status == OK
            text = _text(values[method], form) if pair is None or is_measured else _NO_SCORE[pair.status]
            page = "" if pair is None or not pair.folder else f"{pair.folder}/{PAGE}"
            row.append(TableCell(text, marked[method], page))
        rows.append(row)
    return rows


def summary_rows(study: MethodComparison, column: ScoreColumn) -> list[list[TableCell]]:
    """Return the rows below the scenes of a score: mean, rank, mean rank and difference to the best of each method."""
    form, means = score_format(study, column), {mean.method: mean for mean in study.means_of(column.name)}
    marked = marks({method: mean.mean for method, mean in means.items()}, column)
    rows = [[TableCell("mean"), *(TableCell(_text(m.mean, form), marked[k]) for k, m in means.items())]]
    if column.better is not None and len(study.methods) > 1:
        rows += [
            [TableCell("rank"), *(TableCell(_text(m.rank, "d")) for m in means.values())],
            [TableCell("mean rank"), *(TableCell(_text(m.mean_rank, ".2f")) for m in means.values())],
            [TableCell("difference to the best"), *(TableCell(_text(m.difference, "+.3g")) for m in means.values())],
            [TableCell("lower bound"), *(TableCell(_text(m.low, "+.3g")) for m in means.values())],
            [TableCell("upper bound"), *(TableCell(_text(m.high, "+.3g")) for m in means.values())],
        ]
    return rows


def difference_rows(study: MethodComparison) -> list[list[TableCell]]:
    """Return header and rows of all means with ranks and differences to the best, by score."""
    header = ["method", "mean", "scenes", "rank", "mean rank", "difference to the best", "interval", "excludes zero"]
    rows = [[TableCell(text) for text in header]]
    for column in study.chosen_columns:
        form, means = score_format(study, column), study.means_of(column.name)
        marked = marks({mean.method: mean.mean for mean in means}, column)
        rows.append([TableCell(heading(column)), *[TableCell("")] * (len(header) - 1)])
        for mean in sorted(means, key=lambda mean: mean.rank or len(means) + 1):
            verdict = "" if mean.rank == 1 else {True: "yes", False: "no", None: UNKNOWN}[mean.differs]
            texts = [f"{mean.scenes}", _text(mean.rank, "d"), _text(mean.mean_rank, ".2f")]
            texts += [_text(mean.difference, "+.3g"), _interval(mean), verdict]
            value = TableCell(_text(mean.mean, form), marked[mean.method])
            rows.append([TableCell(mean.method), value, *map(TableCell, texts)])
    return rows


def _interval(mean: MethodMean) -> str:
    return "" if mean.low is None or mean.high is None else interval_text((mean.low, mean.high))


def _text(value: float | None, form: str) -> str:
    return UNKNOWN if value is None else format(value, form)


def evaluate_csv(study: MethodComparison) -> str:
    """Return each score of each pair as CSV."""
    return csv_text(ScoreRow._fields, study.rows())


def means_csv(study: MethodComparison) -> str:
    """Return the means over scenes with ranks and intervals of differences as CSV."""
    return csv_text(list(MethodMean.__dataclass_fields__), (list(vars(mean).values()) for mean in study.means))


def evaluate_latex(study: MethodComparison) -> str:
    """Return the tables for a paper, which need the package booktabs: means of the chosen scores, then their scenes."""
    parts = [_latex_table(mean_rows(study), "mean over scenes")]
    if len(study.scenes) > 1:
        parts += [_latex_table(list(_paper_rows(study, column)), heading(column)) for column in study.chosen_columns]
    return "\n".join(parts)


def _paper_rows(study: MethodComparison, column: ScoreColumn) -> Iterator[list[TableCell]]:
    """Yield header and rows of a score as papers have it: methods by scenes, and the mean."""
    by_scene = scene_rows(study, column)
    mean, *_ = summary_rows(study, column)
    for number, cells in enumerate(zip(*by_scene, strict=True)):
        last = TableCell("mean") if number == 0 else mean[number]
        yield [TableCell("method") if number == 0 else cells[0], *cells[1:], last]


def _latex_table(rows: Sequence[Sequence[TableCell]], title: str) -> str:
    header, *body = (latex_row(map(_latex_cell, row)) for row in rows)
    table = latex_tabular(f"l{'r' * (len(rows[0]) - 1)}", [header], body)
    return f"% {title}\n{table}"


def _latex_cell(cell: TableCell) -> str:
    return _LATEX_MARKS[cell.mark].format(latex(cell.text))
