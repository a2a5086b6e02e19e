"""Tables of studies as text, and their cells."""

from __future__ import annotations

from collections.abc import Sequence

from pcbench.report.words import UNKNOWN, columns, pad

MIB = 2**20  # bytes


def cell(value: float | None, form: str = ".3g") -> str:
    """Return a number in a format; a dash for None."""
    return UNKNOWN if value is None else format(value, form)


def mebibytes(size: int | None) -> str:
    """Return an amount of memory in MiB, without the unit; a dash for None."""
    return cell(None if size is None else size / MIB, ",.0f")


def text_table(rows: Sequence[Sequence[str]]) -> str:
    """Return a table as aligned text: the first column to the left, the others to the right."""
    widths = [max(map(columns, cells)) for cells in zip(*rows, strict=True)]
    lines = (
        "  ".join(
            pad(cell, width, right=number > 0) for number, (cell, width) in enumerate(zip(row, widths, strict=True))
        )
        for row in rows
    )
    return "\n".join(line.rstrip() for line in lines)
