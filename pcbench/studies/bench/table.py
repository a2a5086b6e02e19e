"""The table of a bench: one row per configuration, medians over seeds, with the best and second-best values marked."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from statistics import median
from typing import NamedTuple

from pcbench.report.article import Mark, TableCell
from pcbench.report.terminal import print_table
from pcbench.report.words import UNKNOWN
from pcbench.studies.bench.pareto import Configuration, configurations, fscore_column
from pcbench.studies.bench.results import Bench, choice_text
from pcbench.studies.frame.tables import MIB, cell

_BEST_MARK, _SECOND_MARK = "¹", "²"


class _Column(NamedTuple):
    header: str
    key: str
    direction: int  # 1: higher is better, -1: lower is better, 0: neither
    divisor: float = 1.0
    in_terminal: bool = True
    floor: str | None = None  # key of the value that a cloud without errors would have, printed in brackets


_COLUMNS = (
    _Column("wall s", "wall_s", -1),
    _Column("CPU s", "cpu_s", -1),
    _Column("F-score", "fscore", 1),
    _Column("F of seen", "fscore_visible", 1),
    _Column("MiB", "peak_rss_bytes", -1, MIB),
    _Column("GPU MiB", "gpu_bytes", -1, MIB, in_terminal=False),
    _Column("points", "points", 0),
    _Column("precision", "precision", 1, floor="precision_floor"),
    _Column("recall", "recall", 1, floor="recall_floor"),
    _Column("of seen", "recall_visible", 1),
    _Column("mean c→r", "mean_c2r", -1, floor="mean_c2r_floor"),
    _Column("mean r→c", "mean_r2c", -1, floor="mean_r2c_floor"),
    _Column("D1 c→r", "d1_c2r", -1, in_terminal=False),
    _Column("D1 r→c", "d1_r2c", -1, in_terminal=False),
    _Column("Chamfer", "chamfer", -1, in_terminal=False),
    _Column("Hausdorff", "hausdorff", -1, in_terminal=False),
)


class _TableRow(NamedTuple):
    head: tuple[str, str, str, str]  # method, settings, runs, registration
    cells: list[tuple[str, int]]  # text, and rank: 1 for the best, 2 for the second, else 0
    on_front: bool


_HEAD = ("method", "settings", "runs", "registration")
LABELS = len(_HEAD)


def _table_rows(study: Bench, columns: Sequence[_Column]) -> Iterator[_TableRow]:
    groups = configurations(study.rows)
    medians = [[group.median(column.key) for column in columns] for group in groups]
    ranked = [[value if c.is_reliable else None for value in row] for c, row in zip(groups, medians, strict=True)]
    places = [_ranks([row[number] for row in ranked], column.direction) for number, column in enumerate(columns)]
    for index, (c, values) in enumerate(zip(groups, medians, strict=True)):
        cells = [
            (_cell_text(value, column, c), places[number][index])
            for number, (value, column) in enumerate(zip(values, columns, strict=True))
        ]
        registration = ", ".join(dict.fromkeys(row.score.registration for row in c.rows if row.score is not None))
        statuses = dict.fromkeys(row.run.status for row in c.rows if row.score is None)
        runs = ", ".join([f"{len(c.measured_rows)} of {len(c.rows)} ok", *statuses])
        head = (c.method, choice_text(c.choices), runs, registration)
        yield _TableRow(head, cells, any(row.pareto for row in c.rows))


def _ranks(values: Sequence[float | None], direction: int) -> list[int]:
    """Rank values: 1 for the best, 2 for the second, else 0; all 0 if fewer than two values differ."""
    ordered = sorted({value for value in values if value is not None}, reverse=direction > 0)
    if direction == 0 or len(ordered) < 2:
        return [0] * len(values)
    return [0 if value is None else (1 if value == ordered[0] else 2 if value == ordered[1] else 0) for value in values]


def _cell_text(value: float | None, column: _Column, c: Configuration) -> str:
    if value is None:
        return UNKNOWN
    floor = None if column.floor is None else c.median(column.floor)
    is_perfect = floor is not None and column.direction > 0 and floor > 0.995  # a floor of 1 is no information
    floor_text = "" if floor is None or is_perfect else f" ({floor / column.divisor:.2g})"
    return (f"{value:,.0f}" if column.key == "points" else f"{value / column.divisor:.4g}") + floor_text


def print_bench(study: Bench) -> None:
    """Print the table, followed by failures and notes."""
    from rich.text import Text

    columns = [column for column in _COLUMNS if column.in_terminal]
    header = [*_HEAD, *(column.header for column in columns), "Pareto"]
    styles = {0: "", 1: "bold green", 2: "underline"}
    marks = {0: " ", 1: _BEST_MARK, 2: _SECOND_MARK}
    rows = []
    for line in _table_rows(study, columns):
        cells = [Text(f"{text}{marks[place]}", styles[place]) for text, place in line.cells]
        rows.append([*map(Text, line.head), *cells, Text("*" if line.on_front else "")])
    print_table(header, rows, left={*range(len(_HEAD)), len(header) - 1})
    lines = (*legend(study), *(f"note: {note}" for note in notes(study)), *_run_lines(study))
    print(f"\n{_BEST_MARK} best, {_SECOND_MARK} second", *lines, sep="\n")


def bench_table(study: Bench) -> list[list[str | TableCell]]:
    """Return the table with all columns, the header first; the first `LABELS` columns are text."""
    rows: list[list[str | TableCell]] = [[*_HEAD, *(column.header for column in _COLUMNS), "Pareto"]]
    marks: dict[int, Mark] = {0: "", 1: "best", 2: "second"}
    for line in _table_rows(study, _COLUMNS):
        rows.append([*line.head, *(TableCell(text, marks[place]) for text, place in line.cells), "*" * line.on_front])
    return rows


def threshold_table(study: Bench) -> list[list[str]]:
    """Return precision, recall and F-score at each threshold, also over what the cameras saw; empty if unknown."""
    measured = [group for group in configurations(study.rows) if group.measured_rows]
    if not measured:
        return []
    rows = [
        ["method", "settings", f"threshold [{study.unit}]", "pixels", "precision", "recall", "of seen", "F of seen"]
    ]
    keys = ("threshold", "pixels", "precision", "recall", "recall_visible", "fscore_visible")
    for group in measured:
        scores = [row.score for row in group.rows if row.score is not None]
        for at_threshold in zip(*(score.thresholds for score in scores), strict=True):
            columns = (
                [value for scored in at_threshold if (value := getattr(scored, key)) is not None] for key in keys
            )
            texts = (cell(median(values) if values else None, ".4g") for values in columns)
            rows.append([group.method, choice_text(group.choices), *texts])
    return rows


def threshold_text(study: Bench) -> str | None:
    """Return the threshold of the F-score with its unit, and in pixels if known; None if nothing was measured."""
    if not study.scores:
        return None
    score = study.scores[0]
    pixels = "" if score.pixels is None else f", {score.pixels:g} pixels"
    return f"{score.threshold:.4g} {study.unit}{pixels}"


def legend(study: Bench) -> Iterator[str]:
    """Yield what the columns mean."""
    if (threshold := threshold_text(study)) is None:
        return
    yield "medians over the measured seeds; only configurations with all seeds measured are marked"
    seen = fscore_column(study.rows) == "fscore_visible"
    yield f"*: on the Pareto front of wall time and {'F of seen' if seen else 'F-score'}"
    yield f"precision, recall and F-score at {threshold}; lengths in {study.unit}, D1 in {study.unit}²"
    yield "in brackets: score of an error-free cloud of the same density"
    to = "the true surface" if study.scores[0].accuracy_to == "surface" else "the reference's points"
    yield f"accuracy (c→r, precision) is measured against {to}"
    if (share := study.reference.visible_share) is not None:
        how = study.reference.visibility
        yield f"of seen: recall and F-score over the {share:.1%} of the reference that the cameras saw ({how})"


def warnings(study: Bench) -> list[str]:
    """Return what not to trust: failures and doubtful registrations of runs, and notes on the whole bench."""
    return [*_run_lines(study), *notes(study)]


def notes(study: Bench) -> list[str]:
    """Return notes on the whole bench."""
    beside = sum(row.run.beside_others for row in study.rows)
    if beside == 0:
        return list(study.notes)
    timed = (
        f"{beside} of {len(study.rows)} runs had one thread, and other runs beside them (--workers): do not compare"
        " their times with those of runs alone"
    )
    return [*study.notes, timed]


def _run_lines(study: Bench) -> Iterator[str]:
    """Yield why runs failed, and doubts about their registrations; one line for all seeds with the same text."""
    seeds_by_note: dict[tuple[str, str], list[str]] = {}
    for row in study.rows:
        failure = [f"{row.run.status}: {row.run.message}"] if row.score is None else []
        for text in (*failure, *(f"note: {note}" for note in (row.score.notes if row.score else ()))):
            seeds_by_note.setdefault((row.name, text), []).append(str(row.seed))
    for (run, text), seeds in seeds_by_note.items():
        yield f"{run}: {text}" if seeds == ["None"] else f"{run}, seed {', '.join(seeds)}: {text}"
