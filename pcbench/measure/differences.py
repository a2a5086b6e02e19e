"""Paired differences between candidates, and their intervals."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import combinations

from pcbench.measure import intervals
from pcbench.measure.results import Difference
from pcbench.measure.scores import Measurement


def paired_differences(
    cells: intervals.CorrelationCells, measurements: Mapping[str, Measurement]
) -> Iterator[Difference]:
    """Yield the paired difference a - b of each score, cell by cell: errors common to both candidates cancel.

    Args:
        cells: correlation cells of the intervals, those of all measurements.
        measurements: the measurement of each candidate, by name.
    """
    for (a, of_a), (b, of_b) in combinations(measurements.items(), 2):
        scores = {
            metric: intervals.LinearizedScore(score.value - other.value, score.influence - other.influence)
            for metric, score in of_a.sampled.items()
            if (other := of_b.sampled.get(metric)) is not None
        }
        spreads = intervals.spreads(scores, cells, 0.5 * (of_a.shares + of_b.shares))
        for metric, score in scores.items():
            yield Difference(a, b, metric, score.value, intervals.difference(score.value, spreads[metric]))
