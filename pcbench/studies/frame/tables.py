"""Tables of studies as text."""

from __future__ import annotations

from collections.abc import Sequence

from pcbench.report.words import columns, pad


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
