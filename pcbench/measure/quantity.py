"""One measured quantity, with everything that an output needs to show it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from pcbench.measure.intervals import Interval
from pcbench.measure.results import REFERENCE_TO_CANDIDATE

# Units as powers of the reference's unit of length; other units ("deg", "dB") are written as they are.
LENGTH, SQUARED_LENGTH, RATIO = "length", "length^2", "1"


class Headline(NamedTuple):
    """Presentation of a quantity in the summary.

    Attributes:
        label: label of its line when candidates are shown side by side.
        optional: whether the line is omitted if there are enough others.
        column: heading of its column when each candidate is a row.
        rank: priority of that column: the highest ranks are omitted first, 0 never; None: no such column.
    """

    label: str
    optional: bool = False
    column: str = ""
    rank: int | None = None


@dataclass(frozen=True)
class Quantity:
    """One quantity of a candidate; (metric, variant, threshold, direction) identifies it.

    Attributes:
        metric: what was measured.
        direction: `CANDIDATE_TO_REFERENCE`, `REFERENCE_TO_CANDIDATE`, "symmetric_max", "both", or "" if there is none.
        definition: definition in words.
        value: measured value; None if it does not exist.
        unit: `LENGTH`, `SQUARED_LENGTH`, `RATIO`, another unit, or "" if a quoted tool gives none.
        variant: definition, if there are several.
        threshold: distance threshold, in the reference's unit.
        interval: 95 % confidence interval; None if unknown.
        has_interval: whether comparison.json has a field for the interval even if it is unknown.
        path: keys from the candidate to the value in comparison.json; empty if a larger object is written instead.
        difference: name in `Difference.metric`; empty if candidates are not compared by it.
        section: section of the table; a rule separates sections.
        label: label of its line in the table; empty: not in the table. Two leading blanks attach it to the line above.
        shares_row: name of the line that several metrics share; by default each has its own.
        second: whether it is in the column r→c under another name of that direction.
        headline: presentation in the summary; None: not in the summary.
    """

    metric: str
    direction: str
    definition: str
    value: float | None
    unit: str = LENGTH
    variant: str = ""
    threshold: float | None = None
    interval: Interval | None = None
    has_interval: bool = False
    path: tuple[str | int, ...] = ()
    difference: str = ""
    section: str = "distances"
    label: str = ""
    shares_row: str = ""
    second: bool = False
    headline: Headline | None = None

    @property
    def row(self) -> tuple[str, str, float | None]:
        """Key of its line in tables."""
        return (self.shares_row or self.metric, "" if self.shares_row else self.variant, self.threshold)

    @property
    def column(self) -> int:
        """Column in tables: 1 for r→c, 0 for all others."""
        return int(self.second or self.direction == REFERENCE_TO_CANDIDATE)

    def unit_name(self, length: str) -> str:
        """Return the unit in words; `length` is the unit of lengths."""
        return {LENGTH: length, SQUARED_LENGTH: f"{length}^2"}.get(self.unit, self.unit)
