"""Print a comparison on the terminal: the answer, the warnings, the metrics."""

from __future__ import annotations

import os
import textwrap
from collections.abc import Collection, Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from pcbench.measure.results import ARROWS
from pcbench.report.answer import answer
from pcbench.report.inputs import FinishedComparison
from pcbench.report.layout import Line
from pcbench.report.notes import details, remarks, warnings
from pcbench.report.summary import MAX_SIDE_BY_SIDE, main_columns, main_lines
from pcbench.report.table import lines
from pcbench.report.words import columns, pad, shorten_name, title

if TYPE_CHECKING:
    from rich.console import Console
    from rich.text import Text

_GAP = "  "
_DEFAULT_WIDTH = 80  # terminal columns
_UNBOUNDED_WIDTH = 100_000  # terminal columns for pipes and files


def print_comparison(comparison: FinishedComparison, *, full: bool = False, folder: Path | None = None) -> None:
    """Print the result of a comparison, then the location of all other outputs; see `print_result`.

    Args:
        comparison: the comparison.
        full: whether to print all metrics and all sentences.
        folder: the report folder, if there is one.
    """
    print_result(comparison, full=full)
    print_outputs(comparison, full=full, folder=folder)


def print_result(comparison: FinishedComparison, *, full: bool = False) -> None:
    """Print the answer, the warnings and the main metrics.

    Sentences are wrapped between words on a terminal, or if COLUMNS sets a width. In a file or a pipe each is one line,
    and the table has all columns.

    Args:
        comparison: the comparison.
        full: whether to print all metrics and all sentences; with intervals if the table then fits into the width.
    """
    console = _wrapping_console()

    def say(text: str, style: str = "") -> None:
        _say(console, text, style)

    say(title(comparison), "bold")
    for sentence in (*answer(comparison), *remarks(comparison)):
        say(sentence)
    for warning in warnings(comparison):
        say(f"warning: {warning}", "yellow")
    console.print()
    unit = f"lengths in {comparison.reference.unit}" if comparison.reference.unit else ""
    if unit and full:
        unit += f", mean squares in {comparison.reference.unit}²"
    if full or len(comparison) <= MAX_SIDE_BY_SIDE:
        rows = list(lines(comparison)) if full else main_lines(comparison)
        with_intervals = [line and line.with_intervals for line in rows]
        if full and _table_width(unit, with_intervals) <= console.width:
            rows = with_intervals
        _print_lines(console, [c.name for c in comparison], unit, rows)
    else:
        names, *others = main_columns(comparison, console.width)
        label_width = max(map(columns, [unit, *names.cells]))
        for head in (0, 1):
            cells = [column.head[head].rjust(column.width) for column in others]
            _print_row(console, [(unit if head else "").ljust(label_width), *cells], "bold")
        for row, name in enumerate(names.cells):
            _print_row(console, [pad(name, label_width), *(column.cells[row].rjust(column.width) for column in others)])
    console.print()
    if full:
        for sentence in details(comparison):
            say(sentence)
        console.print()


def print_outputs(comparison: FinishedComparison, *, full: bool = False, folder: Path | None = None) -> None:
    """Print where all metrics are, or how to get them; arguments as for `print_comparison`."""
    is_sample = any(candidate.deviation.sampled_from is not None for candidate in comparison)
    for text in _other_outputs(folder, full=full, is_sample=is_sample):
        _say(_wrapping_console(), text, "dim")


def print_columns(rows: Iterable[Sequence[str]]) -> None:
    """Print a table: the first row is its header, the first column its labels."""
    from rich.text import Text

    header, *rest = ([*row] for row in rows)
    print_table(header, [[*map(Text, line)] for line in rest], left={0})


def print_table(header: Sequence[str], rows: Sequence[Sequence[Text]], left: Collection[int]) -> None:
    """Print a table as wide as its content, so that no number or word is broken.

    Args:
        header: the text of each column's header.
        rows: the cells of each row.
        left: indices of the columns that are aligned to the left.
    """
    from rich.measure import Measurement
    from rich.table import Table

    table = Table(box=None, padding=(0, 1), pad_edge=False)
    for index, column in enumerate(header):
        table.add_column(column, no_wrap=True, justify="left" if index in left else "right")
    for row in rows:
        table.add_row(*row)
    console = _console()
    console.width = _UNBOUNDED_WIDTH
    console.width = Measurement.get(console, console.options, table).maximum
    console.print(table)


def _console() -> Console:
    """Return a console that interprets no markup, because names are data."""
    from rich.console import Console

    console = Console(markup=False, emoji=False, highlight=False)
    if console.width < 1:  # some shells set COLUMNS=0 if they do not know the width
        console.width = _DEFAULT_WIDTH
    return console


def _wrapping_console() -> Console:
    """Return a console with the width of the terminal or of COLUMNS; otherwise lines have no end."""
    console = _console()
    if not (console.is_terminal or "COLUMNS" in os.environ):
        console.width = _UNBOUNDED_WIDTH
    return console


def _say(console: Console, text: str, style: str = "") -> None:
    """Print a sentence, wrapped between words: paths and names are not broken."""
    text = textwrap.fill(text, console.width, break_long_words=False, break_on_hyphens=False)
    console.print(text, style=style, soft_wrap=True)


def _print_lines(console: Console, names: Sequence[str], unit: str, table: Sequence[Line | None]) -> None:
    """Print a line per metric with two columns per candidate; the table may be wider than a narrow terminal."""
    label, *widths = _column_widths(unit, table)
    spare = max(console.width - _table_width(unit, table), 0) // len(names)
    heads = []
    for k, name in enumerate(names):  # a long name uses the spare width
        room = widths[2 * k] + len(_GAP) + widths[2 * k + 1]
        shortened = shorten_name(name, room + spare)
        widths[2 * k] += max(columns(shortened) - room, 0)
        heads.append(pad(shortened, widths[2 * k] + len(_GAP) + widths[2 * k + 1], right=True))

    def print_row(first: str, cells: Sequence[str], style: str = "") -> None:
        padded = (text.rjust(width) for text, width in zip(cells, widths, strict=True))
        _print_row(console, [first.ljust(label), *padded], style)

    _print_row(console, ["".ljust(label), *heads], "bold")
    print_row(unit, list(ARROWS.values()) * len(names))
    for line in table:
        if line is None:
            console.print()
        else:
            print_row(_indented(line), line.texts, "dim" if line.level else "")


def _column_widths(unit: str, table: Sequence[Line | None]) -> list[int]:
    """Return the widths of the labels and of all columns."""
    metrics = [line for line in table if line is not None]
    arrows = list(ARROWS.values()) * len(metrics[0].cells)
    label = max(len(unit), *(len(_indented(line)) for line in metrics))
    return [label, *(max(map(len, column)) for column in zip(arrows, *(line.texts for line in metrics), strict=True))]


def _table_width(unit: str, table: Sequence[Line | None]) -> int:
    widths = _column_widths(unit, table)
    return sum(widths) + (len(widths) - 1) * len(_GAP)


def _indented(line: Line) -> str:
    return f"{_GAP * line.level}{line.label}"


def _print_row(console: Console, cells: Sequence[str], style: str = "") -> None:
    console.print(_GAP.join(cells).rstrip(), style=style, soft_wrap=True)


def _other_outputs(folder: Path | None, *, full: bool, is_sample: bool) -> Iterator[str]:
    """Yield a sentence on the files that have all metrics; clouds with distances may be samples of the points."""
    more = "" if full else "; --full prints all metrics"
    if folder is None:
        yield f"--out FOLDER writes all metrics with their intervals, maps and pictures{more}"
        return
    contents = {
        "report.html": "a page to read or mail",
        "table.md": "all metrics with their intervals",
        "comparison.json": "everything",
        "metrics.csv": "",
        "*_deviation.ply": "distances at a sample of the points" if is_sample else "distances at each point",
        "*_m3c2.ply": "",
        "*_deformation.ply": "displacements",
        "*_T.txt": "matrices",
        "figures/*": "pictures",
        "maps/*.tif": "signed distances for a GIS",
        "maps/*/": "distances of all points as LAZ tiles",
    }
    present = [(name, what) for name, what in contents.items() if any(folder.glob(name))]
    parts = [f"{name.removesuffix('*')} ({what})" if what else name for name, what in present]
    yield f"report: {folder}/ has {', '.join(parts)}{more}"
