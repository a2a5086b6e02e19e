"""Formatting of numbers, lengths and names for tables and sentences."""

from __future__ import annotations

import unicodedata
from collections.abc import Callable, Iterable, Sequence
from itertools import accumulate

from pcbench.measure.deviation import DeviationMap
from pcbench.measure.wording import pluralize, with_unit
from pcbench.report.inputs import FinishedComparison

LengthFormatter = Callable[[float | None], str]
UNKNOWN = "–"
_ROUNDING_SHARE = 1e-9  # of the scene's extent


def number(value: float | None) -> str:
    """Return a number with four significant digits; a dash for None."""
    return UNKNOWN if value is None else f"{value:.4g}"


def length(value: float | None, unit: str | None) -> str:
    """Return a length with its unit, if known; a dash for None."""
    return UNKNOWN if value is None else with_unit(length_number(value), unit)


def length_number(value: float) -> str:
    """Return a length without its unit: three significant digits, or whole from 1,000 to a million."""
    return f"{value:,.0f}" if 1000 <= abs(value) < 1e6 else f"{value:.3g}"


def area(value: float, unit: str | None) -> str:
    """Return an area with its unit, or in square units if it is unknown."""
    return length(value, f"{unit}²" if unit else "square units")


def interval_text(interval: Iterable[float]) -> str:
    """Return the ends of an interval in brackets, with three significant digits."""
    return f"[{', '.join(f'{end:.3g}' for end in interval)}]"


def position_text(point: Iterable[float]) -> str:
    """Return coordinates in parentheses, with one decimal."""
    return f"({', '.join(f'{x:.1f}' for x in point)})"


def percentage(share: float) -> str:
    """Return a share of 0 to 1 as a percentage: two digits below 10 %, else whole."""
    return f"{100 * share:.2g} %" if share < 0.0995 else f"{100 * share:.0f} %"


def sample_count(map_: DeviationMap) -> str:
    """Return the number of points of a map, such as "1,500 points", or "1,000,000 of 1,200,000,000 points"."""
    return point_count(len(map_.points), map_.sampled_from)


def point_count(count: int, sampled_from: int | None = None, noun: str = "point") -> str:
    """Return a number of points in words, with the number of all points if they are a sample of them."""
    return pluralize(count, noun) if sampled_from is None else f"{count:,} of {pluralize(sampled_from, noun)}"


def memory_text(size: int) -> str:
    """Return an amount of memory in bytes as text, such as "12.3 GiB"."""
    value, unit = (size / 2**30, "GiB") if size >= 2**30 else (size / 2**20, "MiB")
    return f"{value:.3g} {unit}" if value < 1000 else f"{value:,.0f} {unit}"


def join_words(names: Sequence[str], most: int = 8) -> str:
    """Return "a, b and c"; beyond `most` names the rest is counted, as in "a, b and 3 others"."""
    if len(names) > most:
        names = [*names[: most - 1], f"{len(names) - most + 1} others"]
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def shorten_name(name: str, width: int) -> str:
    """Return a name in at most `width` columns; a long name keeps its two ends."""
    name = printable(name)
    if columns(name) <= width:
        return name
    tail = (width - 1) // 2
    return f"{_prefix(name, width - 1 - tail)}…{_prefix(name[::-1], tail)[::-1]}"


def printable(name: str) -> str:
    """Return a name with a question mark for each unprintable character."""
    return "".join(letter if letter.isprintable() else "?" for letter in name)


def one_line(text: str) -> str:
    """Return a text on one line, with a question mark for each unprintable character."""
    return printable(" ".join(text.split()))


def columns(text: str) -> int:
    """Return the terminal columns of a text: 2 for a wide letter, 0 for a combining mark (Unicode annex 11)."""
    return sum(map(_columns, text))


def pad(text: str, width: int, *, right: bool = False) -> str:
    """Pad a text with blanks to `width` columns, aligned to the left or to the right."""
    blanks = " " * (width - columns(text))
    return f"{blanks}{text}" if right else f"{text}{blanks}"


def _columns(letter: str) -> int:
    return 0 if unicodedata.combining(letter) else 2 if unicodedata.east_asian_width(letter) in "WF" else 1


def _prefix(text: str, width: int) -> str:
    """Return the longest prefix that fits into `width` columns."""
    ends = accumulate(map(_columns, text))
    return text[: sum(end <= width for end in ends)]


def rounding_limit(comparison: FinishedComparison) -> float:
    """Return the largest distance that counts as rounding, in the clouds' unit."""
    return _ROUNDING_SHARE * comparison.reference.extent


def length_formatter(comparison: FinishedComparison, digits: int = 4) -> LengthFormatter:
    """Return a function that formats lengths; values within rounding are 0."""
    least = rounding_limit(comparison)

    def show(value: float | None) -> str:
        return UNKNOWN if value is None else "0" if abs(value) <= least else f"{value:.{digits}g}"

    return show


def title(comparison: FinishedComparison) -> str:
    """Return one line about the reference: its path, number of points or samples, and spacing."""
    reference = comparison.reference
    spacing = with_unit(f"{reference.spacing_median:.3g}", reference.unit)
    name = "reference" if comparison.inputs is None else printable(str(comparison.inputs.reference.path))
    points = pluralize(reference.points, "point")
    if reference.faces is not None:
        points += f" sampled on {pluralize(reference.faces, 'face')} by area (seed {comparison.settings.seed})"
    return f"{name}: {points}, spacing {spacing}"
