"""The metrics of the page: main rows and all rows, with intervals, floors in grey, and the best values marked."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

from pcbench.measure.quantity import Quantity
from pcbench.report.inputs import FinishedComparison
from pcbench.report.layout import PAGE_RANKS, Headline, Line, LineCell, LineQuantities
from pcbench.report.ranking import leaders
from pcbench.report.summary import headline_lines
from pcbench.report.words import LengthFormatter, length_formatter

MAX_ACROSS = 4  # candidates that have columns; more candidates have a row each
_RANKED = {"d2_rms": 1.0, "mean_distance": 1.0, "fscore": -1.0}  # tested for differences; -1: higher is better


@dataclass(frozen=True)
class MetricColumn:
    """A metric where each candidate has a row.

    Attributes:
        line: the metric.
        floors: sampling floor of each value (c→r, r→c) of each candidate; empty if there is none.
    """

    line: Line
    floors: list[tuple[str, str]] = field(default_factory=list)

    @property
    def has_directions(self) -> bool:
        """Return whether the metric has a value in both directions."""
        return any(second.text for _, second in self.line.cells)


def main_rows(comparison: FinishedComparison) -> list[Line]:
    """Return the metrics of the summary, one row per metric with both directions of each candidate."""

    def facts(label: str, texts: Iterable[str], second: str = "") -> Line:
        return Line.of_texts(label, texts, second=second, rank=PAGE_RANKS[label])

    candidates, best = comparison.candidates, _Best(comparison)
    show, show_bound = length_formatter(comparison), length_formatter(comparison, digits=3)
    reference_points = f"{comparison.reference.points_in_region:,}"
    rows = [
        facts("points measured", (f"{c.points_in_region:,}" for c in candidates), reference_points),
        facts("registration RMSE", (show(c.registration.rmse) for c in candidates)),
        facts("overlap", (f"{c.registration.overlap:.1%}" for c in candidates)),
    ]
    for headline, quantities in headline_lines(comparison):
        winners = best.of(quantities)
        cells = [
            (_cell(pair[0], show, show_bound, (k, 0) in winners), _cell(pair[1], show, show_bound, (k, 1) in winners))
            for k, pair in enumerate(quantities.pairs)
        ]
        level = headline.level if quantities.first.threshold is None else 0
        rows.append(Line(headline.text, cells, level, _rank(headline)))
    return [*rows, facts("deformation", (c.deformation.label for c in candidates))]


def columns_of(rows: Iterable[Line]) -> list[MetricColumn]:
    """Return the columns of main rows if each candidate has a row, by their rank, with their floors."""
    columns: list[MetricColumn] = []
    for row in rows:
        if row.rank is None:
            continue
        if row.level:
            columns[-1] = MetricColumn(columns[-1].line, [(first.text, second.text) for first, second in row.cells])
        else:
            columns.append(MetricColumn(row))
    return sorted(columns, key=lambda column: column.line.rank or 0)


def _rank(headline: Headline) -> int | None:
    """Return the lower rank of both directions; None if the row becomes no column."""
    return min((rank for rank in headline.ranks if rank is not None), default=None)


def _cell(quantity: Quantity | None, show: LengthFormatter, show_bound: LengthFormatter, is_best: bool) -> LineCell:
    """Return the cell of a quantity and the bounds of its interval."""
    if quantity is None:
        return LineCell()
    interval = quantity.interval
    bounds = None if interval is None else (show_bound(interval.low), show_bound(interval.high))
    return LineCell(show(quantity.value), bounds, is_best)


class _Best:
    """Finds the best candidates of a row, and those that do not differ significantly from them."""

    def __init__(self, comparison: FinishedComparison) -> None:
        self.names = [c.name for c in comparison]
        self.eligible = {k for k, c in enumerate(comparison) if c.registration.is_ranked}
        self.tied = {
            (d.metric, frozenset((d.a, d.b))) for d in comparison.differences if d.interval.low <= 0 <= d.interval.high
        }

    def of(self, line: LineQuantities) -> set[tuple[int, int]]:
        """Return the candidate and the direction of each best value."""
        metric = line.first.metric
        is_tested = bool(line.first.tested_difference)  # not the F-score of a preset
        if metric not in _RANKED or not is_tested or len(self.eligible) < 2:
            return set()
        winners: set[tuple[int, int]] = set()
        for direction in (0, 1):
            values = {
                k: _RANKED[metric] * quantity.value
                for k, pair in enumerate(line.pairs)
                if k in self.eligible and (quantity := pair[direction]) is not None and quantity.value is not None
            }
            if len(values) < 2:
                continue
            order = sorted(values, key=lambda k: values[k])
            best = line.pairs[order[0]][direction]
            assert best is not None
            tied = leaders(order, self._test_of(best))
            if len(tied) < len(values):  # without a significant difference none is best
                winners |= {(k, direction) for k in tied}
        return winners

    def _test_of(self, quantity: Quantity) -> Callable[[int, int], bool]:
        """Return the function that says whether two candidates differ significantly in a quantity."""
        metric = quantity.tested_difference
        return lambda a, b: (metric, frozenset((self.names[a], self.names[b]))) not in self.tied
