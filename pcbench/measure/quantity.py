"""One measured number, with everything that an output needs to show it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from pcbench.measure.intervals import Interval
from pcbench.measure.results import BACK

# Units as powers of the reference's unit of length; other units ("deg", "dB") are written as they are.
LENGTH, SQUARED_LENGTH, RATIO = "length", "length^2", "1"


class Headline(NamedTuple):
    """How a quantity stands in the summary.

    Attributes:
        label: of its line where candidates stand side by side.
        optional: whether the line is left out where there are enough others.
        column: heading of its column where each candidate is a row.
        rank: of that column: the highest ranks are left out first, 0 never; None where there is no such column.
    """

    label: str
    optional: bool = False
    column: str = ""
    rank: int | None = None


@dataclass(frozen=True)
class Quantity:
    """One number of a candidate. (metric, variant, threshold, direction) tells it from all others of the candidate.

    Attributes:
        metric, variant, threshold, direction: what was measured, under which definition of several, at which distance
            (in the reference's unit), and which way: `FORTH`, `BACK`, "symmetric_max", "both", or "" where there is
            no direction.
        definition: in words.
        value: None where it does not exist.
        unit: `LENGTH`, `SQUARED_LENGTH`, `RATIO`, another unit, or "" as a tool that is quoted leaves it.
        interval: 95 %; None where it is not known.
        has_interval: whether comparison.json has a place for the interval even where it is not known.
        path: of keys from the candidate to the number in comparison.json. Empty where a larger object that holds it is
            written as a whole.
        difference: its name in `Difference.metric`; empty where candidates are not compared by it.
        section: of the table; a rule separates sections.
        label: of its line in the table; empty where it has none. Two leading blanks: it belongs to the line above.
        shares_row: names the line where several metrics stand in one; by default each has its own.
        second: whether it stands in the second column of its line, as r→c does in any case.
        headline: how it stands in the summary; None where it does not.
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
        """Which line of tables it stands in."""
        return (self.shares_row or self.metric, "" if self.shares_row else self.variant, self.threshold)

    @property
    def column(self) -> int:
        """0 for c→r and for what has no direction, 1 for r→c and what stands beside another number."""
        return int(self.second or self.direction == BACK)

    def unit_name(self, length: str) -> str:
        """The unit in words, where `length` is that of lengths."""
        return {LENGTH: length, SQUARED_LENGTH: f"{length}^2"}.get(self.unit, self.unit)
