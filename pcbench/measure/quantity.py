"""One measured quantity, with everything that identifies it; `pcbench.report.layout` says how tables show it."""

from __future__ import annotations

from dataclasses import dataclass

from pcbench.measure.intervals import Interval

# Units as powers of the reference's unit of length; other units ("deg", "dB") are written as they are.
LENGTH, SQUARED_LENGTH, RATIO = "length", "length^2", "1"


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
        square: the mean square whose root this is.
        group: what it belongs to: "distances", "budget", "maps", "scores", "preset NAME", "deformation" or "survey".
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
    square: Quantity | None = None
    group: str = "distances"

    @property
    def tested_difference(self) -> str:
        """Name of the difference by which candidates are ranked: a root has the order of its mean square."""
        return self.difference if self.square is None else self.square.difference

    def unit_name(self, length: str) -> str:
        """Return the unit in words; `length` is the unit of lengths."""
        return unit_name(self.unit, length)


def unit_name(unit: str, length: str) -> str:
    """Return a unit in words; `length` is the unit of lengths, empty if it is unknown."""
    if unit not in (LENGTH, SQUARED_LENGTH) or not length:
        return "" if unit in (LENGTH, SQUARED_LENGTH) else unit
    return length if unit == LENGTH else f"{length}^2"
