"""A comparison on the terminal: the answer first, then what has to be known before it is trusted, then numbers."""

from __future__ import annotations

import os
import textwrap
from collections.abc import Collection, Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from pcbench.report.answer import answer
from pcbench.report.inputs import SourcedComparison
from pcbench.report.notes import details, survey_sentences, warnings
from pcbench.report.summary import MOST_ACROSS, main_columns, main_lines
from pcbench.report.table import Line, lines
from pcbench.report.words import columns, padded, shortened, title

if TYPE_CHECKING:
    from rich.console import Console
    from rich.text import Text

_GAP = "  "
_USUAL_WIDTH = 80  # columns
_UNBOUNDED = 100_000  # columns of a pipe or a file, which have no width
_ARROWS = ("c→r", "r→c")


def print_comparison(comparison: SourcedComparison, *, full: bool = False, folder: Path | None = None) -> None:
    """The answer, the warnings, the main numbers (`full`: all of them, and every sentence), and where the rest lies.

    Sentences are broken between words where the width is known: on a terminal, or by COLUMNS; in a file or a pipe each
    is a line, and the table has every column.
    """
    console = _console()
    wraps = console.is_terminal or "COLUMNS" in os.environ
    if not wraps:
        console.width = _UNBOUNDED

    def say(text: str, style: str = "") -> None:
        if wraps:  # paths and names stay whole
            text = textwrap.fill(text, console.width, break_long_words=False, break_on_hyphens=False)
        console.print(text, style=style, soft_wrap=True)

    say(title(comparison), "bold")
    for sentence in answer(comparison):
        say(sentence)
    for sentence in survey_sentences(comparison):
        say(sentence)
    for warning in warnings(comparison):
        say(f"warning: {warning}", "yellow")
    console.print()
    width = console.width
    if full or len(comparison) <= MOST_ACROSS:
        rows = lines(comparison) if full else main_lines(comparison)
        _print_lines(console, [c.name for c in comparison], list(rows))
    else:
        names, *others = main_columns(comparison, width)
        left = max(map(columns, names.cells))
        for head in (0, 1):
            cells = [column.head[head].rjust(column.width) for column in others]
            _print_row(console, ["".ljust(left), *cells], "bold")
        for row, name in enumerate(names.cells):
            _print_row(console, [padded(name, left), *(column.cells[row].rjust(column.width) for column in others)])
    console.print()
    if full:
        for sentence in details(comparison):
            say(sentence)
        console.print()
    for text in _elsewhere(folder, full=full):
        say(text, "dim")


def print_columns(rows: Iterable[Sequence[str]]) -> None:
    """A table on the terminal: the first row is its header, the first column its labels."""
    from rich.text import Text

    header, *rest = ([*row] for row in rows)
    print_table(header, [[*map(Text, line)] for line in rest], left={0})


def print_table(header: Sequence[str], rows: Sequence[Sequence[Text]], left: Collection[int]) -> None:
    """A table as wide as its cells: no number or word is broken, on a narrow terminal, in a pipe or in a file.

    Args:
        left: the numbers of the columns that are aligned to the left.
    """
    from rich.measure import Measurement
    from rich.table import Table

    table = Table(box=None, padding=(0, 1), pad_edge=False)
    for number, column in enumerate(header):
        table.add_column(column, no_wrap=True, justify="left" if number in left else "right")
    for row in rows:
        table.add_row(*row)
    console = _console()
    console.width = _UNBOUNDED
    console.width = Measurement.get(console, console.options, table).maximum
    console.print(table)


def _console() -> Console:
    """Names are data, not markup."""
    from rich.console import Console

    console = Console(markup=False, emoji=False, highlight=False)
    if console.width < 1:  # some shells say COLUMNS=0 where they know no width
        console.width = _USUAL_WIDTH
    return console


def _print_lines(console: Console, names: Sequence[str], table: Sequence[Line | None]) -> None:
    """Metrics down, candidates across; wider than a narrow terminal rather than cut."""
    kept = [line for line in table if line is not None]
    label = max(len(line.label) for line in kept)
    widths = [
        [max(len(_ARROWS[way]), *(len(line.cells[k][way]) for line in kept)) for way in (0, 1)]
        for k in range(len(names))
    ]
    needed = label + sum(sum(pair) + 2 * len(_GAP) for pair in widths)
    spare = max(console.width - needed, 0) // len(names)
    heads = []
    for name, pair in zip(names, widths, strict=True):  # a long name takes what room there is
        room = sum(pair) + len(_GAP)
        shown = shortened(name, room + spare)
        pair[0] += max(columns(shown) - room, 0)
        heads.append(padded(shown, sum(pair) + len(_GAP), right=True))
    _print_row(console, ["".ljust(label), *heads], "bold")
    _print_row(console, ["".ljust(label), *(a.rjust(w) for pair in widths for a, w in zip(_ARROWS, pair, strict=True))])
    for line in table:
        if line is None:
            console.print()
            continue
        cells = [
            text.rjust(w) for pair, of in zip(line.cells, widths, strict=True) for text, w in zip(pair, of, strict=True)
        ]
        _print_row(console, [line.label.ljust(label), *cells], "dim" if line.label.startswith("  ") else "")


def _print_row(console: Console, cells: Sequence[str], style: str = "") -> None:
    console.print(_GAP.join(cells).rstrip(), style=style, soft_wrap=True)


def _elsewhere(folder: Path | None, *, full: bool) -> Iterator[str]:
    """Where everything that is not printed lies."""
    more = "" if full else "; --full prints every metric"
    if folder is None:
        yield f"--out FOLDER keeps all metrics with their intervals, maps and pictures{more}"
        return
    held = {
        "table.md": "all metrics with their intervals",
        "comparison.json": "everything",
        "metrics.csv": "",
        "*_deviation.ply": "distances at every point",
        "*_m3c2.ply": "",
        "*_deformation.ply": "displacements",
        "*_T.txt": "matrices",
        "figures/*": "pictures",
    }
    there = [(name, what) for name, what in held.items() if any(folder.glob(name))]
    parts = [f"{name.removesuffix('*')} ({what})" if what else name for name, what in there]
    yield f"report: {folder}/ holds {', '.join(parts)}{more}"
