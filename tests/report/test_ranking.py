"""The candidates that count as best: the tied ones in order of value, and none beyond a significant difference."""

from dataclasses import replace

import numpy as np
import pytest
import shapes
from wording import check_text

from pcbench import Settings, compare
from pcbench.measure.intervals import Interval
from pcbench.report.answer import answer
from pcbench.report.html.metrics_table import main_rows
from pcbench.report.ranking import leaders


@pytest.mark.parametrize(
    ("different", "expected"),
    [("", "abcd"), ("b", "a"), ("c", "ab"), ("d", "abc"), ("bd", "a"), ("bcd", "a")],
)
def test_leaders_end_at_the_first_significant_difference(different, expected):
    assert leaders("abcd", lambda first, other: first == "a" and other in different) == list(expected)


def test_a_wide_interval_makes_no_candidate_a_best_one():
    """The worst by value has so wide an interval that it does not differ from the best, while the second does."""
    points = shapes.terrain(2000, seed=1)[0]
    up = np.array([0.0, 0.0, 1.0])
    clouds = {name: points + offset * up for name, offset in (("good", 0.01), ("fair", 0.02), ("vague", 0.05))}
    comparison = compare(points, clouds, Settings(register="none"))
    comparison = replace(
        comparison,
        differences=tuple(
            d._replace(interval=Interval(-1.0, 1.0) if {d.a, d.b} == {"good", "vague"} else Interval(-2.0, -1.0))
            for d in comparison.differences
        ),
    )
    check_text("\n".join(answer(comparison)[:2]))
    rows = {row.label: row for row in main_rows(comparison)}
    marks = [cell.is_best for cell, _ in rows["RMS off the surface (D2)"].cells]
    assert marks == [True, False, False]


def test_a_preset_has_a_row_but_no_best_value():
    """Its differences are not tested."""
    points = shapes.terrain(600, seed=1)[0]
    clouds = {"near": points + [0, 0, 0.01], "far": points + [0, 0, 3.0]}
    comparison = compare(points, clouds, Settings(register="none", presets=("tnt",), thresholds=(0.5,)))
    rows = {row.label: row for row in main_rows(comparison)}
    assert [cell.is_best for cell, _ in rows["F-score at 0.5"].cells] == [True, False]
    assert [cell.is_best for cell, _ in rows["tnt: F-score at 0.5"].cells] == [False, False]
