"""The table of a bench: one row per configuration, medians over seeds, with the best and second-best values marked."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from pcbench.report.article import Mark, TableCell
from pcbench.report.terminal import print_table
from pcbench.studies.bench.pareto import Configuration, choice_text, configurations

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
    _Column("MiB", "peak_rss_bytes", -1, 2**20),
    _Column("GPU MiB", "gpu_bytes", -1, 2**20, in_terminal=False),
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


def _table_rows(doc: dict[str, Any], columns: Sequence[_Column]) -> Iterator[_TableRow]:
    found = configurations(doc["rows"])
    medians = [[c.median(column.key) for column in columns] for c in found]
    ranked = [[value if c.is_reliable else None for value in row] for c, row in zip(found, medians, strict=True)]
    places = [_ranks([row[number] for row in ranked], column.direction) for number, column in enumerate(columns)]
    for row, (c, values) in enumerate(zip(found, medians, strict=True)):
        cells = [
            (_cell_text(value, column, c), places[number][row])
            for number, (value, column) in enumerate(zip(values, columns, strict=True))
        ]
        registration = ", ".join(dict.fromkeys(r["registration"] for r in c.measured_rows))
        failed = [r["status"] for r in c.rows if r["status"] != "ok"]
        runs = f"{len(c.measured_rows)} of {len(c.rows)} ok" + "".join(
            f", {status}" for status in dict.fromkeys(failed)
        )
        yield _TableRow((c.method, choice_text(c.choices), runs, registration), cells, any(r["pareto"] for r in c.rows))


def _ranks(values: Sequence[float | None], direction: int) -> list[int]:
    """Rank values: 1 for the best, 2 for the second, else 0; all 0 if fewer than two values differ."""
    known = sorted({value for value in values if value is not None}, reverse=direction > 0)
    if direction == 0 or len(known) < 2:
        return [0] * len(values)
    return [0 if value is None else (1 if value == known[0] else 2 if value == known[1] else 0) for value in values]


def _cell_text(value: float | None, column: _Column, c: Configuration) -> str:
    if value is None:
        return "–"
    floor = None if column.floor is None else c.median(column.floor)
    is_perfect = floor is not None and column.direction > 0 and floor > 0.995  # a floor of 1 is no information
    floor_text = "" if floor is None or is_perfect else f" ({floor / column.divisor:.2g})"
    return (f"{value:,.0f}" if column.key == "points" else f"{value / column.divisor:.4g}") + floor_text


def print_bench(doc: dict[str, Any]) -> None:
    """Print the table, followed by failures and notes."""
    from rich.text import Text

    columns = [column for column in _COLUMNS if column.in_terminal]
    header = [*_HEAD, *(column.header for column in columns), "Pareto"]
    styles = {0: "", 1: "bold green", 2: "underline"}
    marks = {0: " ", 1: _BEST_MARK, 2: _SECOND_MARK}
    rows = []
    for line in _table_rows(doc, columns):
        cells = [Text(f"{text}{marks[place]}", styles[place]) for text, place in line.cells]
        rows.append([*map(Text, line.head), *cells, Text("*" if line.on_front else "")])
    print_table(header, rows, left={*range(len(_HEAD)), len(header) - 1})
    lines = (*legend(doc), *(f"note: {note}" for note in notes(doc)), *_run_lines(doc))
    print(f"\n{_BEST_MARK} best, {_SECOND_MARK} second", *lines, sep="\n")


def bench_table(doc: dict[str, Any]) -> list[list[str | TableCell]]:
    """Return the table with all columns, the header first; the first `LABELS` columns are text."""
    rows: list[list[str | TableCell]] = [[*_HEAD, *(column.header for column in _COLUMNS), "Pareto"]]
    marks: dict[int, Mark] = {0: "", 1: "best", 2: "second"}
    for line in _table_rows(doc, _COLUMNS):
        rows.append([*line.head, *(TableCell(text, marks[place]) for text, place in line.cells), "*" * line.on_front])
    return rows


def threshold_table(doc: dict[str, Any]) -> list[list[str]]:
    """Return precision, recall and F-score at each threshold, also over what the cameras saw; empty if unknown."""
    found = [c for c in configurations(doc["rows"]) if any(row.get("thresholds") for row in c.measured_rows)]
    if not found:  # written by a version with a single threshold
        return []
    rows = [
        ["method", "settings", f"threshold [{_unit(doc)}]", "pixels", "precision", "recall", "of seen", "F of seen"]
    ]
    keys = ("threshold", "pixels", "precision", "recall", "recall_visible", "fscore_visible")
    for c in found:
        for number in range(len(c.measured_rows[0]["thresholds"])):
            at = Configuration(c.method, c.choices, [{**row, **row["thresholds"][number]} for row in c.measured_rows])
            texts = ("–" if (value := at.median(key)) is None else f"{value:.4g}" for key in keys)
            rows.append([c.method, choice_text(c.choices), *texts])
    return rows


def threshold_text(doc: dict[str, Any]) -> str | None:
    """Return the threshold of the F-score with its unit, and in pixels if known; None if nothing was measured."""
    threshold = next((row["threshold"] for row in doc["rows"] if row.get("threshold") is not None), None)
    pixels = next((f", {row['pixels']:g} pixels" for row in doc["rows"] if row.get("pixels") is not None), "")
    return None if threshold is None else f"{threshold:.4g} {_unit(doc)}{pixels}"


def legend(doc: dict[str, Any]) -> Iterator[str]:
    """Yield what the columns mean."""
    if (threshold := threshold_text(doc)) is None:
        return
    yield "medians over the measured seeds; only configurations with all seeds measured are marked"
    yield "*: on the Pareto front of wall time and F-score"
    yield f"precision, recall and F-score at {threshold}; lengths in {_unit(doc)}, D1 in {_unit(doc)}²"
    yield "in brackets: score of an error-free cloud of the same density"
    if measured := [row["accuracy_to"] for row in doc["rows"] if row.get("accuracy_to") is not None]:
        to = "the true surface" if measured[0] == "surface" else "the reference's points"
        yield f"accuracy (c→r, precision) is measured against {to}"
    if doc["reference"]["visible_share"] is not None:
        share, how = doc["reference"]["visible_share"], doc["reference"]["visibility"]
        yield f"of seen: recall over the {share:.1%} of the reference that the cameras saw ({how})"


def warnings(doc: dict[str, Any]) -> list[str]:
    """Return what not to trust: failures and doubtful registrations of runs, and notes on the whole bench."""
    return [*_run_lines(doc), *notes(doc)]


def notes(doc: dict[str, Any]) -> list[str]:
    """Return notes on the whole bench."""
    beside = sum(bool(row.get("beside_others")) for row in doc["rows"])
    if beside == 0:
        return list(doc["notes"])
    timed = (
        f"{beside} of {len(doc['rows'])} runs had one thread, and other runs beside them (--workers): do not compare"
        " their times with those of runs alone"
    )
    return [*doc["notes"], timed]


def _run_lines(doc: dict[str, Any]) -> Iterator[str]:
    """Yield why runs failed, and doubts about their registrations; one line for all seeds with the same text."""
    seeds_by_note: dict[tuple[str, str], list[str]] = {}
    for row in doc["rows"]:
        run = " ".join(filter(None, (row["method"], choice_text(row["choices"]))))
        texts = [] if row["status"] == "ok" else [f"{row['status']}: {row['message']}"]
        for text in (*texts, *(f"note: {note}" for note in row.get("notes") or ())):
            seeds_by_note.setdefault((run, text), []).append(str(row["seed"]))
    for (run, text), seeds in seeds_by_note.items():
        yield f"{run}: {text}" if seeds == ["None"] else f"{run}, seed {', '.join(seeds)}: {text}"


def _unit(doc: dict[str, Any]) -> str:
    unit: str = doc["reference"].get("unit") or "the files' unit"
    return unit


def row_title(row: Mapping[str, Any]) -> str:
    """Return method, settings and seed of a row as text."""
    seed = () if row["seed"] is None else (f"seed {row['seed']}",)
    return " ".join(filter(None, (row["method"], choice_text(row["choices"]), *seed)))
