"""Bars for the budgets of D2 of each candidate and direction, and a table of the changes, on the page."""

from __future__ import annotations

from typing import NamedTuple

from pcbench.measure.budget import PARTS, D2Budget
from pcbench.measure.results import ARROWS, CANDIDATE_TO_REFERENCE
from pcbench.report.budget import changes_of, kind_words
from pcbench.report.colors import BLUE, GREEN, PURPLE, SKY, VERMILION
from pcbench.report.inputs import FinishedComparison
from pcbench.report.words import UNKNOWN, area, length, percentage, printable, rounding_limit

_LABELS = {  # of the parts in the legend, with their colours: greys for what has no shape
    "unmatched": ("no counterpart", PURPLE),
    "changed": ("changes", VERMILION),
    "motion": ("motion", BLUE),
    "affine": ("stretch, shear", SKY),
    "smooth": ("smooth beyond affine", GREEN),
    "noise": ("noise", "#c9ccd2"),
    "unexplained": ("unexplained", "#82868e"),
}
_DARK = ("motion", "smooth", "unexplained")  # colours on which text is white
_MIN_TEXT_SHARE = 0.06  # of the bar, for a percentage inside a segment
_MAX_CHANGES = 30  # in the table; comparison.json has all


class BudgetSegment(NamedTuple):
    """A part of a bar: its width in %, colours of the ground and the text, the text inside and the one on hovering."""

    width: float
    color: str
    ink: str
    text: str
    title: str


class BudgetBar(NamedTuple):
    """The budget of one direction: the candidate (empty below its first bar), direction, RMS and segments."""

    name: str
    arrow: str
    rms: str
    segments: list[BudgetSegment]

    @property
    def description(self) -> str:
        """All parts in words, for readers that see no bar."""
        return ", ".join(segment.title for segment in self.segments)


class LegendPart(NamedTuple):
    """A part in the legend."""

    label: str
    color: str


class ChangeRow(NamedTuple):
    """A change in the table, in words."""

    candidate: str
    kind: str
    place: tuple[float, float, float]
    area: str
    volume: str
    mean: str
    peak: str


def bars(comparison: FinishedComparison, *, is_wide: bool) -> list[BudgetBar]:
    """Return the bars of all candidates with a budget, c→r above r→c; of many candidates only c→r.

    Directions whose distances are within rounding have none.
    """
    unit, drawn = comparison.reference.unit, []
    for candidate in comparison:
        if candidate.budget is None:
            continue
        for way, arrow in ARROWS.items():
            budget, is_first = candidate.budget[way], way == CANDIDATE_TO_REFERENCE
            if budget.mean_square**0.5 > rounding_limit(comparison) and (is_first or not is_wide):
                name = printable(candidate.name) if is_first else ""
                drawn.append(BudgetBar(name, arrow, length(budget.mean_square**0.5, unit), _segments(budget, unit)))
    return drawn


def legend() -> list[LegendPart]:
    """Return the parts with their colours, in the order of the bars."""
    return [LegendPart(*_LABELS[name]) for name in PARTS]


def change_rows(comparison: FinishedComparison) -> list[ChangeRow]:
    """Return the most important changes of all candidates."""
    unit, rows = comparison.reference.unit, []
    for candidate in comparison:
        for change in changes_of(candidate):
            volume = UNKNOWN if change.volume is None else length(change.volume, f"{unit}³" if unit else None)
            words = area(change.area, unit), volume, length(change.mean, unit), length(change.peak, unit)
            rows.append(ChangeRow(printable(candidate.name), kind_words(change, unit), change.place, *words))
    return rows[:_MAX_CHANGES]


def _segments(budget: D2Budget, unit: str | None) -> list[BudgetSegment]:
    segments = []
    for name, part in budget.parts.items():
        if not (share := budget.share(name)):
            continue
        label, color = _LABELS[name]
        text = percentage(share) if share >= _MIN_TEXT_SHARE else ""
        title = (
            f"{label}: {percentage(share)}, {length(part.rms, unit)} RMS of {percentage(part.point_share)} of points"
        )
        ink = "#fff" if name in _DARK else "#1c1e22"
        segments.append(BudgetSegment(round(100 * share, 2), color, ink, text, title))
    return segments
