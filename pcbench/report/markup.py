"""Tables as CSV, as Markdown and as LaTeX."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from typing import Any

_FORMULA_STARTS = ("=", "+", "-", "@", "\t", "\r")
_LATEX = {
    **{letter: f"\\{letter}" for letter in "&%$#_{}"},
    **{"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"},
    **{"→": r"$\to$", "↓": r"$\downarrow$", "↑": r"$\uparrow$", "–": "--", "−": "$-$", "²": r"$^2$", "±": r"$\pm$"},
}


def csv_text(header: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """Return a table as CSV; None is an empty cell.

    A text that a spreadsheet would run as a formula, such as a candidate called `=1+1`, has an apostrophe before it.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(map(_csv_cell, row) for row in rows)
    return text.getvalue()


def _csv_cell(value: Any) -> Any:
    if value is None:
        return ""
    return f"'{value}" if isinstance(value, str) and _is_formula(value) else value


def _is_formula(text: str) -> bool:
    if not text.startswith(_FORMULA_STARTS):
        return False
    try:
        float(text)
    except ValueError:
        return True
    return False


def markdown_table(rows: Iterable[Sequence[str]], labels: int) -> str:
    """Return a table as Markdown.

    Args:
        rows: the header and the other rows.
        labels: number of leading columns that are aligned to the left; the others are aligned to the right.
    """
    header, *rest = rows
    rule = ["---"] * labels + ["---:"] * (len(header) - labels)
    return "\n".join(markdown_row(row) for row in (header, rule, *rest))


def markdown_row(cells: Iterable[str]) -> str:
    """Return a line of a Markdown table."""
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def latex_tabular(columns: str, header: Iterable[str], body: Iterable[str]) -> str:
    r"""Return a LaTeX table with the rules of booktabs.

    Args:
        columns: alignment of the columns, such as `lrr`.
        header: lines of its head, each with `\\` at its end.
        body: the other lines.
    """
    lines = [rf"\begin{{tabular}}{{{columns}}}", r"\toprule", *header, r"\midrule", *body]
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}", ""])


def latex_row(cells: Iterable[str]) -> str:
    """Return a line of a LaTeX table, of cells that are LaTeX."""
    return " & ".join(cells) + r" \\"


def latex(text: str) -> str:
    """Return a text with LaTeX's special characters escaped; arrows, dashes and minus signs become commands."""
    return "".join(_LATEX.get(letter, letter) for letter in text)
