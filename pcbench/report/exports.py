"""A comparison as a table for other programs: LaTeX, Markdown, CSV, and a pandas data frame."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from pcbench.extras import require
from pcbench.measure.results import ARROWS
from pcbench.report.inputs import FinishedComparison
from pcbench.report.markup import csv_text, latex, latex_row, latex_tabular
from pcbench.report.summary import main_lines
from pcbench.report.table import Row, markdown, rows


def data_frame(comparison: FinishedComparison) -> Any:
    """Return the rows of metrics.csv as a `pandas.DataFrame`.

    Raises:
        MissingExtra: pandas is not installed.
    """
    return require("pandas").DataFrame(list(rows(comparison)), columns=list(Row._fields))


def latex_table(comparison: FinishedComparison) -> str:
    """Return the main metrics as a LaTeX table with two columns per candidate and intervals; it needs booktabs."""
    names = [rf"\multicolumn{{2}}{{c}}{{{latex(candidate.name)}}}" for candidate in comparison]
    unit = f"lengths in {comparison.reference.unit}" if comparison.reference.unit else ""
    arrows = [arrow for _ in comparison for arrow in ARROWS.values()]
    header = latex_row(["", *names]), latex_row(map(latex, [unit, *arrows]))
    body = (
        latex_row([r"\quad " * line.level + latex(line.label), *map(latex, line.with_intervals.texts)])
        for line in main_lines(comparison)
    )
    return latex_tabular(f"l{'rr' * len(comparison)}", header, body)


TABLES: dict[str, Callable[[FinishedComparison], str]] = {
    "latex": latex_table,
    "markdown": markdown,
    "csv": lambda comparison: csv_text(Row._fields, rows(comparison)),
}
"""Functions that return the table of a comparison in a format, by its name."""
