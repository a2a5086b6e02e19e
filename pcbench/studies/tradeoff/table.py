"""Tables of the trade-off study: errors by group of metrics, and each error with its interval."""

from __future__ import annotations

from collections.abc import Iterator

from pcbench.report.markup import csv_text
from pcbench.report.words import UNKNOWN, number
from pcbench.studies.frame.tables import mebibytes, text_table
from pcbench.studies.tradeoff.errors import group_front
from pcbench.studies.tradeoff.metrics import GROUPS, MEANS, NAMES
from pcbench.studies.tradeoff.results import ErrorEstimate, Tradeoff, TradeoffRow

LEGEND = (
    "errors in %: the largest of a group of metrics, each of which one run exceeds in 5 % of cases (corrected: mean"
    " distances corrected by their floors; –: no relative error); *: on the Pareto front of CPU time and error;"
    " verdict: runs with the exact one; CPU: relative to the exact comparison; MiB: largest peak beyond the loaded"
    " clouds"
)
_LEAST_SHOWN = 1e-4


def tradeoff_table(study: Tradeoff) -> str:
    """Return the table that the command prints."""
    exact = study.exact
    unit = f" {exact.unit}" if exact.unit else ""
    threshold = "" if exact.threshold is None else f"; F-score: at a threshold of {exact.threshold:.4g}{unit}"
    return f"{text_table(table_rows(study))}\n\n{LEGEND}{threshold}"


def table_rows(study: Tradeoff) -> list[list[str]]:
    """Return header and rows of the errors by group, the exact comparison first."""
    header = ["", "CPU s", "CPU", "MiB", "means", "corrected", *GROUPS[1:], "verdict"]
    exact = study.exact
    first = ["exact", f"{exact.cpu_s:.3g}", "1", mebibytes(exact.memory_bytes), *["0"] * 2, *["0"] * 4, exact.verdict]
    fronts = {group: {row.name for row in group_front(study.rows, group)} for group in GROUPS}
    return [header, first, *(_line(row, fronts) for row in study.rows)]


def _line(row: TradeoffRow, fronts: dict[str, set[str]]) -> list[str]:
    if row.message:
        return [row.name, *[UNKNOWN] * 9, "failed"]
    cells = [_percent(row.group_bound(group)) + "*" * (row.name in fronts[group]) for group in GROUPS]
    corrected = _percent(row.group_bound(MEANS, corrected=True)) if row.corrected else ""
    share = row.same_verdict
    costs = [row.name, f"{row.cpu_s:.3g}", f"{row.cpu_ratio:.2f}", mebibytes(row.memory_bytes)]
    return [*costs, cells[0], corrected, *cells[1:], f"{share.kept}/{share.total}"]


def _percent(share: float | None) -> str:
    if share is None:
        return UNKNOWN
    if 0 < share < _LEAST_SHOWN:
        return f"<{100 * _LEAST_SHOWN:g}"
    return f"{100 * share:.0f}" if share >= 0.1 else f"{100 * share:.2g}"


def error_rows(study: Tradeoff) -> list[list[str]]:
    """Return header and rows of all errors in percent with their intervals, the exact values first."""
    names = [name for name in NAMES if study.exact.values.get(name) is not None]
    exact = ["exact", *(number(study.exact.values[name]) for name in names)]
    return [["", *names], exact, *([row.name, *(_error(row.errors.get(name)) for name in names)] for row in study.rows)]


def _error(error: ErrorEstimate | None) -> str:
    if error is None:
        return UNKNOWN
    mean, low, high = (f"{100 * value:+.3g}" for value in error)
    return mean if error.low == error.high else f"{mean} [{low}, {high}]"


def tradeoff_csv(study: Tradeoff) -> str:
    """Return all errors as CSV, one line for each approximation and metric, corrected ones apart."""
    header = [
        *("approximation", "family", "side", "level", "metric", "corrected", "exact", "error", "low", "high"),
        *("same_verdict", "runs", "cpu_s", "cpu_ratio", "wall_s", "memory_bytes", "reference_points"),
        *("candidate_points", "message"),
    ]
    return csv_text(header, _csv_rows(study))


def _csv_rows(study: Tradeoff) -> Iterator[list[object]]:
    for row in study.rows:
        costs = [*row.same_verdict, row.cpu_s, row.cpu_ratio, row.wall_s, row.memory_bytes, *row.points, row.message]
        for corrected, errors in ((0, row.errors), (1, row.corrected)):
            for name, error in errors.items():
                start = [row.name, row.family, row.side, row.level, name, corrected, study.exact.values[name]]
                yield [*start, *(error or (None,) * 3), *costs]
