"""The Pareto front of configurations."""

from dataclasses import replace

import numpy as np
import pytest
from benches import row

from pcbench.studies.bench.pareto import configurations, front_configurations, fscore_column, pareto_front, with_front


@pytest.mark.parametrize("seed", range(5))
def test_pareto_front_matches_pairwise_domination(seed):
    costs = np.random.default_rng(seed).integers(0, 6, (40, 2)).astype(float)  # with ties and duplicates
    expected = []
    for a in costs:
        dominated = False
        for b in costs:
            if b[0] <= a[0] and b[1] <= a[1] and (b[0] < a[0] or b[1] < a[1]):
                dominated = True
        expected.append(not dominated)
    assert pareto_front(costs).tolist() == expected


def test_front_uses_medians_over_seeds():
    rows = [
        *(row("slow", 10.0, f, seed=k) for k, f in enumerate((0.8, 0.9, 0.1))),  # median 0.8
        *(row("fast", t, 0.5, seed=k) for k, t in enumerate((1.0, 2.0, 90.0))),  # median 2
        row("worse", 3.0, 0.4),
        row("lucky", 11.0, 0.79),
        row("dead", 0.1, None, "crashed"),
    ]
    assert [row.pareto for row in with_front(rows)] == [True] * 6 + [False, False, None]
    results = configurations(rows)
    assert [c.method for c in results] == ["slow", "fast", "worse", "lucky", "dead"]
    assert [c.method for c in front_configurations(results, "chamfer", higher_is_better=False)] == ["fast", "slow"]
    assert front_configurations(results[-1:], "fscore", higher_is_better=True) == []


def test_configuration_with_a_failed_seed_is_not_on_the_front():
    rows = [row("reliable", 2.0, 0.5), row("lucky", 1.0, 0.9), row("lucky", 1.0, None, "failed", seed=1)]
    assert [row.pareto for row in with_front(rows)] == [True, False, None]


def test_invented_surface_where_no_camera_looked_gains_nothing():
    """A filled hull of the scene has more recall of the whole reference, but less precision."""
    rows = []
    for name, wall_s, fscore, seen in (("invents", 2.0, 0.6, 0.7), ("measures", 3.0, 0.3, 0.9)):
        measured = row(name, wall_s, fscore)
        rows.append(replace(measured, score=replace(measured.score, fscore_visible=seen)))
    rows.append(row("invents slowly", 4.0, 0.8))
    assert [row.pareto for row in with_front(rows[:2])] == [True, True]
    assert fscore_column(rows[:2]) == "fscore_visible"
    assert fscore_column(rows) == "fscore"  # it is not known for all
