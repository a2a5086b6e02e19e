"""The main metrics of a comparison: at most 16 rows for one or two candidates, one row per candidate for more."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

from pcbench.measure.quantities import quantities
from pcbench.measure.quantity import LENGTH, RATIO, Quantity
from pcbench.measure.results import ARROWS, Candidate
from pcbench.report.inputs import FinishedComparison
from pcbench.report.layout import (
    TERMINAL_RANKS,
    Headline,
    Line,
    LineCell,
    LineQuantities,
    arrange,
    asked_headline_of,
    column_of,
    headline_of,
    line_key,
)
from pcbench.report.words import UNKNOWN, LengthFormatter, columns, length_formatter, number, shorten_name

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


def main_lines(comparison: FinishedComparison) -> list[Line]:
    """Return the rows for candidates side by side: a line per metric with both directions, and its floor below it."""
    candidates, show = list(comparison), length_formatter(comparison)
    has_details = len(main_thresholds(comparison)) == 1  # of F-scores

    def cell(quantity: Quantity) -> LineCell:
        text = show if quantity.unit == LENGTH else number
        interval = None if quantity.interval is None else (text(quantity.interval.low), text(quantity.interval.high))
        return LineCell(text(quantity.value), interval)

    always: list[Line] = []
    optional: list[Line] = []
    asked: list[Line] = []
    asked_groups = _asked_groups(comparison)
    for headline, line in headline_lines(comparison):
        if has_details or not headline.level or line.first.threshold is None:
            group = optional if headline.is_optional else always
            group = asked if line.first.group in asked_groups else group
            group.append(Line(headline.text, line.cells(cell), headline.level))
    methods = {c.registration.method.partition(":")[0] for c in candidates}
    method = "registration" if len(methods) > 1 else methods.pop()
    reference_points = f"{comparison.reference.points_in_region:,}"
    lines = [
        Line.of_texts("points measured", (f"{c.points_in_region:,}" for c in candidates), second=reference_points),
        Line.of_texts(f"{method}: rmse", (show(c.registration.rmse) for c in candidates)),
        Line.of_texts(f"{method}: overlap", (f"{c.registration.overlap:.1%}" for c in candidates)),
        *always,
        Line.of_texts("deformation", (c.deformation.label for c in candidates)),
    ]
    # Beside `undecided`, a size or a limit would read as a statement.
    stated = [None if c.deformation.label == "undecided" else c.deformation.assuming_pose() for c in candidates]
    limits = [None if result is None else result.size_limit for result in stated]
    if any(limit is not None for limit in limits):
        sizes = [None if result is None or result.amplitude is None else result.amplitude.rms for result in stated]
        lines.append(Line.of_texts("RMS", map(show, sizes), 1))
        lines.append(Line.of_texts("detectable RMS", map(show, limits), 1))
    return [*lines, *optional[: _MAX_ROWS - len(lines)], *asked]


def headline_lines(comparison: FinishedComparison) -> list[tuple[Headline, LineQuantities]]:
    """Return the lines of the quantities in the summary, for the main ones of several thresholds."""
    thresholds, headline = (None, *main_thresholds(comparison)), _headlines(comparison)
    lines = arrange(comparison.candidates, lambda q: q.threshold in thresholds and headline(q) is not None)
    return [(shown, line) for line in lines if (shown := headline(line.first)) is not None]


def _headlines(comparison: FinishedComparison) -> Callable[[Quantity], Headline | None]:
    """Return the function that gives the presentation of a quantity in the summary, if it is in it."""
    asked = _asked_groups(comparison)
    return lambda quantity: asked_headline_of(quantity) if quantity.group in asked else headline_of(quantity)


def _asked_groups(comparison: FinishedComparison) -> set[str]:
    """Return the groups of quantities that the user asked for."""
    return {"own", *(f"preset {name}" for name in comparison.settings.presets)}


def main_columns(comparison: FinishedComparison, width: int) -> list[Column]:
    """Return the columns for one row per candidate: the most important ones that fit into `width` terminal columns."""
    candidates, show = list(comparison), length_formatter(comparison, digits=3)
    pose = ["" if c.registration.is_ranked else "doubtful" for c in candidates]
    facts = {
        "points": Column(("", "points"), [f"{c.points_in_region:,}" for c in candidates]),
        "pose": Column(("", "pose"), pose),
        "overlap": Column(("", "overlap"), [f"{c.registration.overlap:.0%}" for c in candidates]),
        "deformation": Column(("", "deformation"), [c.deformation.label for c in candidates]),
        "deformed RMS": Column(("deformed", "RMS"), [_deformation_size(c, show) for c in candidates]),
    }
    before = ("points", "pose", "overlap") if any(pose) else ("points", "overlap")
    ranked = [  # in the order of the table
        *((TERMINAL_RANKS[name], facts[name]) for name in before),
        *_quantity_columns(comparison, show),
        *((TERMINAL_RANKS[name], facts[name]) for name in ("deformation", "deformed RMS")),
    ]
    room = width - min(max(columns(c.name) for c in candidates), _MIN_NAME_COLUMNS)
    kept_ranks: set[int] = set()
    for rank in sorted({rank for rank, _ in ranked}):
        needed = sum(column.width + _GAP for other, column in ranked if other == rank)
        if rank > 0 and needed > room:
            break
        kept_ranks.add(rank)
        room -= needed
    kept = [column for rank, column in ranked if rank in kept_ranks]
    name_width = max(width - sum(column.width + _GAP for column in kept), _MIN_NAME_COLUMNS // 2)
    return [Column(("", ""), _names(candidates, name_width)), *kept]


def _names(candidates: list[Candidate], width: int) -> list[str]:
    """Return the names shortened to `width` columns, numbered if two would become equal."""
    names = [shorten_name(c.name, width) for c in candidates]
    if len(set(names)) < len(names):
        names = [f"{k} {shorten_name(c.name, width - len(str(k)) - 1)}" for k, c in enumerate(candidates, 1)]
    return names


def _quantity_columns(comparison: FinishedComparison, show: LengthFormatter) -> Iterator[tuple[int, Column]]:
    """Yield the rank and the column of each quantity with a headline, for only the first of several thresholds."""
    first_threshold, headline_in = (None, *main_thresholds(comparison)[:1]), _headlines(comparison)

    def text(quantity: Quantity) -> str:
        if quantity.value is None:
            return UNKNOWN
        return {LENGTH: show(quantity.value), RATIO: f"{quantity.value:.3f}"}.get(quantity.unit, number(quantity.value))

    by_place = [
        {(line_key(q), column_of(q)): (headline, q) for q in quantities(candidate) if (headline := headline_in(q))}
        for candidate in comparison
    ]
    for place, (headline, quantity) in by_place[0].items():  # a floor is beside its value
        rank = headline.ranks[column_of(quantity)]
        if rank is not None and quantity.threshold in first_threshold:
            below = ARROWS.get(quantity.direction, "") if quantity.threshold is None else f"{quantity.threshold:.3g}"
            below = headline.below or below
            cells = [text(shown[place][1]) if place in shown else UNKNOWN for shown in by_place]
            yield rank, Column((headline.column, below), cells)


def main_thresholds(comparison: FinishedComparison) -> list[float]:
    """Return the thresholds that the user set, or the middle one of the default three."""
    thresholds = [score.threshold for score in comparison.candidates[0].metrics.fscores]
    return thresholds if comparison.settings.thresholds is not None else thresholds[len(thresholds) // 2 :][:1]


def _deformation_size(candidate: Candidate, show: LengthFormatter) -> str:
    result = candidate.deformation.assuming_pose()
    return show(result.amplitude.rms) if result.amplitude is not None and result.verdict == "non-affine" else ""
