"""Recommendations, their sentences, and tables, for studies that are given."""

from dataclasses import replace

import pytest
from wording import check_text

from pcbench.studies.tradeoff.errors import front, group_front
from pcbench.studies.tradeoff.metrics import DEFORMATION, EXTREMES, MEANS, NAMES
from pcbench.studies.tradeoff.recommend import recommend, recommendations
from pcbench.studies.tradeoff.results import ErrorEstimate, Exact, Share, Tradeoff, TradeoffRow, TradeoffSettings
from pcbench.studies.tradeoff.table import tradeoff_table
from pcbench.studies.tradeoff.words import answer, warnings


def row(name, cpu, error, *, extremes=None, corrected=None, same=5, family="random", worst=None):
    errors = dict.fromkeys(NAMES, ErrorEstimate(error, error, error))
    if extremes is not None:
        errors |= dict.fromkeys(("largest c→r", "largest r→c"), ErrorEstimate(extremes, extremes, extremes))
    repaired = {} if corrected is None else {name: ErrorEstimate(corrected, corrected, corrected) for name in NAMES[:5]}
    side = "candidate" if family == "random" else ""
    return TradeoffRow(
        name, family, side, 0.5, f"use {name}", errors, repaired, Share(same, 5), cpu, cpu, cpu, worst or cpu,
        1 << 20, (100, 100),
    )  # fmt: skip


def study(*rows, tolerance=0.01, **changes):
    exact = Exact(dict.fromkeys(NAMES, 1.0), {}, "none", 1.0, 1.0, 1 << 21, (200, 200), 0.1, "m")
    return Tradeoff(TradeoffSettings(tolerance=tolerance), exact, tuple(rows), **changes)


def test_the_cheapest_within_the_tolerance_is_recommended():
    rows = row("a", 0.2, 0.5), row("b", 0.4, 0.005), row("c", 0.6, 0.001), row("failed", 0.1, 0.0)
    found = recommend(study(*rows[:3], replace(rows[3], message="no overlap")), [MEANS])
    assert found.row.name == "b" and not found.corrected
    assert recommend(study(*rows[:3], tolerance=0.6), [MEANS]).row.name == "a"
    assert recommend(study(*rows[:3], tolerance=1e-4), [MEANS]).row is None


def test_what_saves_no_time_is_not_recommended():
    slower = row("as slow", 0.97, 0.0), row("slower in one round", 0.9, 0.0, worst=1.1)
    some = study(*slower, row("float32", 0.5, 0.0, family="float32"), row("less than exact runs differ", 0.8, 0.0))
    assert recommend(replace(some, exact=replace(some.exact, cpu_spread=0.3)), [MEANS]).row is None
    assert recommend(replace(some, exact=replace(some.exact, cpu_spread=0.2)), [MEANS]).row is not None


def test_the_correction_by_the_floor_counts_only_where_it_is_needed():
    found = recommend(study(row("a", 0.2, 0.5, corrected=0.004), row("b", 0.4, 0.005)), [MEANS])
    assert found.row.name == "a" and found.corrected
    found = recommend(study(row("a", 0.2, 0.005, corrected=0.5)), [MEANS])
    assert found.row.name == "a" and not found.corrected


def test_the_verdict_is_kept_if_all_runs_agree():
    some = study(row("a", 0.2, 0.5, same=4), row("b", 0.4, 0.5))
    assert recommend(some, [DEFORMATION]).row.name == "b"
    assert recommend(some, [DEFORMATION, EXTREMES]).row is None


def test_sentences_and_table():
    some = study(
        row("a", 0.2, 0.5, corrected=0.004, same=4),
        row("b", 0.4, 0.005, extremes=0.3),
        replace(row("c", 0.9, 0.1), message="the clouds do not overlap"),
        skipped=("decimation: the reference is no mesh",),
    )
    assert recommendations(some)[0].groups == (MEANS,)
    check_text("\n".join((*answer(some), *warnings(some), tradeoff_table(some))), masked=False)
    check_text("\n".join(answer(study(row("c", 0.9, 0.1)))), masked=False)
    check_text("\n".join(answer(study(row("c", 0.9, 0.0)))), masked=False)


def test_unequal_times_are_reported():
    some = study(row("a", 0.2, 0.5))
    assert not list(warnings(some))
    check_text("\n".join(warnings(replace(some, exact=replace(some.exact, cpu_spread=0.5)))), masked=False)


def test_pareto_fronts():
    some = study(row("a", 0.2, 0.5), row("b", 0.4, 0.005), row("c", 0.6, 0.01))
    assert [r.name for r in front(some.rows, "mean c→r")] == ["a", "b"]
    assert [r.name for r in group_front(some.rows, MEANS)] == ["a", "b"]
    assert group_front([], MEANS) == []


def test_an_unknown_row_lists_the_known_ones():
    with pytest.raises(KeyError, match="there are a"):
        study(row("a", 0.2, 0.5)).row("x")
