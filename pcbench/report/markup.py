"""Tables as CSV and as Markdown."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from typing import Any


def csv_text(header: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """A table as CSV; None is an empty cell."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(["" if value is None else value for value in row] for row in rows)
    return text.getvalue()


def markdown_table(rows: Iterable[Sequence[str]], labels: int) -> str:
    """A table as Markdown, its header first.

    Args:
        labels: columns of words, which come first and are aligned to the left; numbers are to the right.
    """
    header, *rest = rows
    rule = ["---"] * labels + ["---:"] * (len(header) - labels)
    return "\n".join(markdown_row(row) for row in (header, rule, *rest))


def markdown_row(cells: Iterable[str]) -> str:
    """A line of a Markdown table."""
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"
