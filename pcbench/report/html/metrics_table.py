"""The metrics of the page: main rows and all rows, with intervals, floors in grey, and the best values marked."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

from pcbench.measure.intervals import Interval
from pcbench.measure.quantities import quantities
from pcbench.measure.quantity import Quantity
from pcbench.measure.results import CANDIDATE_TO_REFERENCE, REFERENCE_TO_CANDIDATE, Candidate
from pcbench.report.inputs import SourcedComparison
from pcbench.report.ranking import leaders
from pcbench.report.summary import main_thresholds
from pcbench.report.table import Across, across, lines
from pcbench.report.words import UNKNOWN, number, rounding_limit

MAX_ACROSS = 4  # candidates that have columns; more candidates have a row each
_RANKED = {"d2_rms": 1.0, "mean_distance": 1.0, "fscore": -1.0}  # tested for differences; -1: higher is better


@dataclass(frozen=True)
class ValueCell:
    """A cell of the table: its text, its 95 % interval if known, and whether its value is among the best."""

    text: str = ""
    interval: str = ""
    is_best: bool = False


@dataclass(frozen=True)
class MetricRow:
    """A row of the table.

    Attributes:
        label: name of the metric.
        cells: (c→r, r→c) for each candidate.
        is_detail: whether it belongs to the row above and is grey, such as a floor.
        rank: place among the columns if each candidate has a row; None: no column.
    """

    label: str
    cells: list[tuple[ValueCell, ValueCell]]
    is_detail: bool = False
    rank: int | None = None


@dataclass(frozen=True)
class MetricColumn:
    """A metric where each candidate has a row.

    Attributes:
        row: the metric.
        floors: sampling floor of each value (c→r, r→c) of each candidate; empty if there is none.
    """

    row: MetricRow
    floors: list[tuple[str, str]] = field(default_factory=list)

    @property
    def has_directions(self) -> bool:
        """Return whether the metric has a value in both directions."""
        return any(second.text for _, second in self.row.cells)


def main_rows(comparison: SourcedComparison) -> list[MetricRow]:
    """Return the metrics of the summary, one row per metric with both directions of each candidate."""
    candidates, thresholds = comparison.candidates, main_thresholds(comparison)
    reference_points = f"{comparison.reference.points_in_region:,}"
    rows = [
        _plain_row("points measured", [(f"{c.points_in_region:,}", reference_points) for c in candidates], rank=20),
        _plain_row("registration RMSE", [(number(c.registration.rmse), "") for c in candidates], rank=21),
        _plain_row("overlap", [(f"{c.registration.overlap:.1%}", "") for c in candidates], rank=22),
    ]
    best, intervals = _Best(comparison), [_intervals(candidate) for candidate in candidates]
    least = rounding_limit(comparison)
    for row in across(candidates, lambda q: q.headline is not None and q.threshold in (None, *thresholds)):
        headline = row.first.headline
        assert headline is not None
        winners = best.of(row)

        def cell(k: int, direction: int, row: Across = row, winners: set[tuple[int, int]] = winners) -> ValueCell:
            quantity = row.pairs[k][direction]
            if quantity is None:
                return ValueCell()
            key = (quantity.metric, quantity.direction, quantity.threshold)
            return ValueCell(_text(quantity, least), _interval_text(intervals[k].get(key)), (k, direction) in winners)

        cells = [(cell(k, 0), cell(k, 1)) for k in range(len(candidates))]
        is_detail = headline.label.startswith("  ") and row.first.threshold is None
        rows.append(MetricRow(headline.label.strip(), cells, is_detail, _rank(row)))
    return [*rows, _plain_row("deformation", [(c.deformation.label, "") for c in candidates], rank=3)]


def all_rows(comparison: SourcedComparison) -> list[MetricRow | None]:
    """Return all metrics as in table.md; None separates sections."""
    return [
        None
        if line is None
        else MetricRow(
            line.label.strip(),
            [(_split(first), _split(second)) for first, second in line.cells],
            is_detail=line.label.startswith("  "),
        )
        for line in lines(comparison, intervals=True)
    ]


def _split(text: str) -> ValueCell:
    """Return the cell of a text such as "1.9 [1.7, 2.1]", a value with its interval."""
    value, _, interval = text.partition(" [")
    return ValueCell(value, interval.removesuffix("]").replace(", ", " – "))


def columns_of(rows: Iterable[MetricRow]) -> list[MetricColumn]:
    """Return the columns of main rows if each candidate has a row, by their rank, with their floors."""
    columns: list[MetricColumn] = []
    for row in rows:
        if row.rank is None:
            continue
        if row.is_detail:
            columns[-1] = MetricColumn(columns[-1].row, [(first.text, second.text) for first, second in row.cells])
        else:
            columns.append(MetricColumn(row))
    return sorted(columns, key=lambda column: column.row.rank or 0)


def _rank(row: Across) -> int | None:
    """Return the lower rank of both directions; None if the row becomes no column."""
    headlines = [q.headline for pair in row.pairs for q in pair if q is not None and q.headline is not None]
    return min((headline.rank for headline in headlines if headline.rank is not None), default=None)


def _plain_row(label: str, cells: Iterable[tuple[str, str]], rank: int) -> MetricRow:
    return MetricRow(label, [(ValueCell(first), ValueCell(second)) for first, second in cells], rank=rank)


class _Best:
    """Finds the best candidates of a row, and those that do not differ significantly from them."""

    def __init__(self, comparison: SourcedComparison) -> None:
        self.names = [c.name for c in comparison]
        self.eligible = {k for k, c in enumerate(comparison) if not c.registration.doubtful}
        self.tied = {
            (d.metric, frozenset((d.a, d.b))) for d in comparison.differences if d.interval.low <= 0 <= d.interval.high
        }

    def of(self, row: Across) -> set[tuple[int, int]]:
        """Return the candidate and the direction of each best value."""
        metric = row.first.metric
        if metric not in _RANKED or len(self.eligible) < 2:
            return set()
        winners: set[tuple[int, int]] = set()
        sign = _RANKED[metric]
        for direction in (0, 1):
            values = {
                k: sign * q.value
                for k, pair in enumerate(row.pairs)
                if k in self.eligible and (q := pair[direction]) is not None and q.value is not None
            }
            if len(values) < 2:
                continue
            order = sorted(values, key=lambda k: values[k])
            quantity = row.pairs[order[0]][direction]
            assert quantity is not None
            tied = leaders(order, self._test_of(quantity))
            if len(tied) < len(values):  # without a significant difference none is best
                winners |= {(k, direction) for k in tied}
        return winners

    def _test_of(self, quantity: Quantity) -> Callable[[int, int], bool]:
        """Return the function that says whether two candidates differ significantly in a quantity."""
        # Differences are tested between mean squares; their roots have the same order.
        metric = quantity.difference or f"{quantity.metric.replace('_rms', '_mse')}/{quantity.direction}"
        return lambda a, b: (metric, frozenset((self.names[a], self.names[b]))) not in self.tied


def _intervals(candidate: Candidate) -> dict[tuple[str, str, float | None], Interval]:
    """Return the intervals of a candidate's quantities; the root of a mean square has the roots of its ends."""
    found = {}
    for q in quantities(candidate):
        if q.interval is None:
            continue
        found[q.metric, q.direction, q.threshold] = q.interval
        if q.metric.endswith("_mse") and q.direction in (CANDIDATE_TO_REFERENCE, REFERENCE_TO_CANDIDATE):
            root = Interval(*(math.sqrt(max(end, 0.0)) for end in q.interval))
            found[q.metric.replace("_mse", "_rms"), q.direction, q.threshold] = root
    return found


def _text(quantity: Quantity | None, least: float) -> str:
    if quantity is None:
        return ""
    if quantity.value is None:
        return UNKNOWN
    return "0" if abs(quantity.value) <= least else number(quantity.value)


def _interval_text(interval: Interval | None) -> str:
    return "" if interval is None else f"{interval.low:.3g} – {interval.high:.3g}"
