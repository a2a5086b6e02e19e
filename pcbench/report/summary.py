"""The main metrics of a comparison: at most 16 rows for one or two candidates, one row per candidate for more."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

from pcbench.measure.quantities import quantities
from pcbench.measure.quantity import LENGTH, RATIO, Quantity
from pcbench.measure.results import ARROWS, Candidate
from pcbench.report.inputs import SourcedComparison
from pcbench.report.table import Line, across
from pcbench.report.words import UNKNOWN, columns, number, rounding_limit, shorten_name

MAX_SIDE_BY_SIDE = 2  # candidates in one table with a column each
_MAX_ROWS = 16
_GAP = 2  # blanks between columns
_MIN_NAME_COLUMNS = 16


class Column(NamedTuple):
    """A column of the table with one row per candidate: two lines of header, and the cells."""

    head: tuple[str, str]
    cells: list[str]

    @property
    def width(self) -> int:
        """Width of the widest cell, in terminal columns."""
        return max(map(columns, (*self.head, *self.cells)))


def main_lines(comparison: SourcedComparison) -> list[Line]:
    """Return the rows for candidates side by side: a line per metric with both directions, and its floor below it."""
    candidates = list(comparison)
    show, thresholds = _length_formatter(comparison), main_thresholds(comparison)

    def is_shown(quantity: Quantity) -> bool:
        if quantity.headline is None or quantity.threshold not in (None, *thresholds):
            return False
        is_detail = quantity.threshold is not None and quantity.headline.label.startswith("  ")
        return not is_detail or len(thresholds) == 1

    def text(quantity: Quantity) -> str:
        return show(quantity.value) if quantity.unit == LENGTH else number(quantity.value)

    always: list[Line] = []
    optional: list[Line] = []
    for row in across(candidates, is_shown):
        headline = row.first.headline
        assert headline is not None
        (optional if headline.optional else always).append(Line(headline.label, row.cells(text)))
    methods = {c.registration.method.partition(":")[0] for c in candidates}
    how = "registration" if len(methods) > 1 else methods.pop()
    rows = [
        Line(
            "points measured",
            [(f"{c.points_in_region:,}", f"{_reference_point_count(comparison):,}") for c in candidates],
        ),
        Line(f"{how}: rmse", [(show(c.registration.rmse), "") for c in candidates]),
        Line(f"{how}: overlap", [(f"{c.registration.overlap:.1%}", "") for c in candidates]),
        *always,
        Line("deformation", [(c.deformation.label, "") for c in candidates]),
    ]
    limits = [c.deformation.size_limit for c in candidates]
    if any(limit is not None for limit in limits):
        results = [c.deformation.assuming_pose() for c in candidates]
        amplitudes = [None if result.verdict == "undecided" else result.amplitude for result in results]
        sizes = [None if amplitude is None else amplitude.rms for amplitude in amplitudes]
        rows.append(Line("  RMS", [(show(size), "") for size in sizes]))
        rows.append(Line("  detectable RMS", [(show(limit), "") for limit in limits]))
    return rows + optional[: _MAX_ROWS - len(rows)]


def main_columns(comparison: SourcedComparison, width: int) -> list[Column]:
    """Return the columns for one row per candidate: the most important ones that fit into `width` terminal columns."""
    candidates = list(comparison)
    pose = ["doubtful" if c.registration.doubtful else "" for c in candidates]
    ranked = [  # in the order of the table; rank 0 is always shown, None never
        (8, Column(("", "points"), [f"{c.points_in_region:,}" for c in candidates])),
        (0 if any(pose) else None, Column(("", "pose"), pose)),
        (4, Column(("", "overlap"), [f"{c.registration.overlap:.0%}" for c in candidates])),
        *_quantity_columns(comparison),
        (2, Column(("", "deformation"), [c.deformation.label for c in candidates])),
        (
            7,
            Column(
                ("deformed", "RMS"), [_deformation_size(c, _length_formatter(comparison, digits=3)) for c in candidates]
            ),
        ),
    ]
    room = width - min(max(columns(c.name) for c in candidates), _MIN_NAME_COLUMNS)
    kept: set[int] = set()
    ranks = sorted({rank for rank, _ in ranked if rank is not None})
    for rank in ranks:
        group = {k for k, (of, _) in enumerate(ranked) if of == rank}
        needed = sum(ranked[k][1].width + _GAP for k in group)
        if rank > 0 and needed > room:
            break
        kept |= group
        room -= needed
    chosen = [column for k, (_, column) in enumerate(ranked) if k in kept]
    left = max(width - sum(column.width + _GAP for column in chosen), _MIN_NAME_COLUMNS // 2)
    return [Column(("", ""), _names(candidates, left)), *chosen]


def _names(candidates: list[Candidate], width: int) -> list[str]:
    """Return the names shortened to `width` columns, numbered if two would become equal."""
    names = [shorten_name(c.name, width) for c in candidates]
    if len(set(names)) < len(names):
        names = [f"{k} {shorten_name(c.name, width - len(str(k)) - 1)}" for k, c in enumerate(candidates, 1)]
    return names


def _reference_point_count(comparison: SourcedComparison) -> int:
    return comparison.reference.points_in_region


def _quantity_columns(comparison: SourcedComparison) -> Iterator[tuple[int, Column]]:
    """Yield the rank and the column of each quantity with a headline, for only the first of several thresholds."""
    show, thresholds = _length_formatter(comparison, digits=3), main_thresholds(comparison)[:1]

    def text(quantity: Quantity | None) -> str:
        if quantity is None or quantity.value is None:
            return UNKNOWN
        return {LENGTH: show(quantity.value), RATIO: f"{quantity.value:.3f}"}.get(quantity.unit, number(quantity.value))

    found = [{(q.row, q.column): q for q in quantities(candidate) if q.headline} for candidate in comparison]
    for place, first in found[0].items():
        headline = first.headline
        if headline is None or headline.rank is None or first.threshold not in (None, *thresholds):
            continue
        below = ARROWS.get(first.direction, "") if first.threshold is None else f"{first.threshold:.3g}"
        yield headline.rank, Column((headline.column, below), [text(of.get(place)) for of in found])


def main_thresholds(comparison: SourcedComparison) -> list[float]:
    """Return the thresholds that the user set, or the middle one of the default three."""
    found = [score.threshold for score in comparison.candidates[0].metrics.fscores]
    return found if comparison.settings.thresholds is not None else found[len(found) // 2 :][:1]


def _deformation_size(candidate: Candidate, show: Callable[[float | None], str]) -> str:
    result = candidate.deformation.assuming_pose()
    return show(result.amplitude.rms) if result.amplitude is not None and result.verdict == "non-affine" else ""


def _length_formatter(comparison: SourcedComparison, digits: int = 4) -> Callable[[float | None], str]:
    """Return a function that formats lengths; values within rounding are 0."""
    least = rounding_limit(comparison)

    def show(value: float | None) -> str:
        return UNKNOWN if value is None else "0" if abs(value) <= least else f"{value:.{digits}g}"

    return show
