"""Numbers, names and labels as tables and sentences show them."""

from __future__ import annotations

import unicodedata
from collections.abc import Sequence
from itertools import accumulate

from pcbench.measure.intervals import Interval
from pcbench.measure.wording import counted
from pcbench.report.inputs import SourcedComparison

UNKNOWN = "–"
_ROUNDING = 1e-9  # of the scene's extent


def number(value: float | None, ci: Interval | None = None) -> str:
    """Four digits, with its interval; a dash where there is none."""
    if value is None:
        return UNKNOWN
    text = f"{value:.4g}"
    return f"{text} [{ci.low:.4g}, {ci.high:.4g}]" if ci else text


def length(value: float | None, unit: str | None) -> str:
    """A length in a sentence: three digits and the unit, where that is known."""
    if value is None:
        return UNKNOWN
    text = f"{value:,.0f}" if 1000 <= abs(value) < 1e6 else f"{value:.3g}"
    return f"{text} {unit}" if unit else text


def joined(names: Sequence[str], most: int = 8) -> str:
    """a, b and c; of more than `most` the rest as their number."""
    if len(names) > most:
        names = [*names[: most - 1], f"{len(names) - most + 1} others"]
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def shortened(name: str, width: int) -> str:
    """A name in one line of at most `width` columns: its ends, which tell files apart, are kept."""
    name = printable(name)
    if columns(name) <= width:
        return name
    tail = (width - 1) // 2
    return f"{_as_many(name, width - 1 - tail)}…{_as_many(name[::-1], tail)[::-1]}"


def printable(name: str) -> str:
    """A name in one line that moves no cursor."""
    return "".join(letter if letter.isprintable() else "?" for letter in name)


def columns(text: str) -> int:
    """That a text takes on a terminal: two for a wide letter, none for a mark upon one (Unicode annex 11)."""
    return sum(map(_columns, text))


def padded(text: str, width: int, *, right: bool = False) -> str:
    """A text in `width` columns, at their left or at their right."""
    blanks = " " * (width - columns(text))
    return f"{blanks}{text}" if right else f"{text}{blanks}"


def _columns(letter: str) -> int:
    return 0 if unicodedata.combining(letter) else 2 if unicodedata.east_asian_width(letter) in "WF" else 1


def _as_many(text: str, width: int) -> str:
    """The letters at the beginning that `width` columns hold."""
    ends = accumulate(map(_columns, text))
    return text[: sum(end <= width for end in ends)]


def rounding(comparison: SourcedComparison) -> float:
    """Distances up to this are no distances, in the clouds' unit."""
    return _ROUNDING * comparison.reference.extent


def title(comparison: SourcedComparison) -> str:
    """The reference, in one line."""
    reference = comparison.reference
    unit = f" {reference.unit}" if reference.unit else ""
    name = "reference" if comparison.inputs is None else printable(str(comparison.inputs.reference.path))
    return f"{name}: {counted(reference.points, 'point')}, spacing {reference.spacing_median:.3g}{unit}"
