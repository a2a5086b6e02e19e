"""Shares of runs with their intervals, and shares as text."""

from __future__ import annotations

import math
from dataclasses import dataclass
from statistics import NormalDist

from pcbench.report.words import UNKNOWN

_Z = NormalDist().inv_cdf(0.975)


@dataclass(frozen=True)
class Rate:
    """A share of runs with its 95 % Wilson interval.

    Attributes:
        count: number of runs that are counted.
        total: number of all runs.
    """

    count: int
    total: int

    @property
    def share(self) -> float:
        """Count over total; NaN without runs."""
        return self.count / self.total if self.total else math.nan

    @property
    def interval(self) -> tuple[float, float]:
        """95 % Wilson score interval of the share; 0 to 1 without runs."""
        if not self.total:
            return 0.0, 1.0
        n, p = self.total, self.share
        centre, spread = p + _Z**2 / (2 * n), _Z * math.sqrt(p * (1 - p) / n + _Z**2 / (4 * n**2))
        low, high = (centre - spread) / (1 + _Z**2 / n), (centre + spread) / (1 + _Z**2 / n)
        return (0.0 if self.count == 0 else low, 1.0 if self.count == n else high)

    @property
    def text(self) -> str:
        """The share with its interval, such as `0.4 % [0.1, 1.2]`; a dash without runs."""
        if not self.total:
            return UNKNOWN
        low, high = self.interval
        return f"{percent(self.share)} [{_percent_number(low)}, {_percent_number(high)}]"


def percent(share: float) -> str:
    """Return a share as a percentage: two digits below 10 %, and no rounding of less than all to 100 %."""
    return f"{_percent_number(share)} %"


def _percent_number(share: float) -> str:
    value = 100 * share
    if 99 < value < 100:
        return f"{min(value, 99.9):.1f}"
    return f"{value:.2g}" if value < 9.95 else f"{value:.0f}"
