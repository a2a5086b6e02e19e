"""Means over scenes: common scenes, ranks, intervals of differences and their coverage."""

import numpy as np
import pytest

from pcbench.studies.evaluate.means import difference_interval, means_over_scenes
from pcbench.studies.evaluate.results import PairEvaluation, ScoreColumn

LOWER, HIGHER = ScoreColumn("error", "m", "lower"), ScoreColumn("share", "", "higher")


def means(values, column=LOWER):
    """Means by method of values by method, one for each scene; None: the pair has no scores."""
    pairs = [
        PairEvaluation(f"s{k}", method, "failed" if v is None else "ok", scores={} if v is None else {column.name: v})
        for method, row in values.items()
        for k, v in enumerate(row)
    ]
    return {mean.method: mean for mean in means_over_scenes([column], list(values), pairs, 0)}


def test_means_and_ranks_are_over_the_scenes_of_all_methods():
    result = means({"a": [1.0, 2.0, 9.0], "b": [2.0, 1.0, None], "c": [4.0, 4.0, 1.0], "d": [None, None, None]})
    assert [(mean.mean, mean.scenes, mean.rank, mean.mean_rank) for mean in result.values()] == [
        (1.5, 2, 1, 1.5),
        (1.5, 2, 1, 1.5),
        (4.0, 2, 3, 3.0),
        (None, 0, None, None),
    ]
    assert result["c"].difference == 2.5 and result["c"].low is None and result["c"].differs is None


def test_higher_values_can_be_better():
    result = means({"a": [0.5, 0.7], "b": [0.6, 0.9]}, HIGHER)
    assert (result["a"].rank, result["b"].rank) == (2, 1)
    assert result["a"].difference == pytest.approx(-0.15) and result["b"].difference is None


def test_counts_are_not_ranked():
    result = means({"a": [1.0], "b": [2.0]}, ScoreColumn("points", "", None))
    assert [(mean.mean, mean.rank, mean.difference) for mean in result.values()] == [
        (1.0, None, None),
        (2.0, None, None),
    ]


def test_without_a_common_scene_there_is_no_mean():
    assert {mean.mean for mean in means({"a": [1.0, None], "b": [None, 2.0]}).values()} == {None}


def test_a_difference_in_all_scenes_is_told_from_chance():
    generator = np.random.default_rng(0)
    scenes = generator.uniform(1, 5, 15)  # scenes differ more than methods
    result = means(
        {"a": scenes, "b": scenes + 0.1 + generator.normal(0, 0.05, 15), "c": scenes + generator.normal(0, 0.05, 15)}
    )
    best = min(result.values(), key=lambda mean: mean.mean)
    assert best.method in ("a", "c")
    assert result["b"].differs and result["b"].low > 0
    (other,) = (mean for mean in result.values() if mean.method not in ("b", best.method))
    assert not other.differs


def test_equal_differences_need_no_interval():
    result = means({"a": [1.0] * 6, "b": [1.0] * 6, "c": [2.0] * 6})
    assert (result["b"].low, result["b"].high, result["b"].differs) == (0.0, 0.0, False)
    assert (result["c"].low, result["c"].high, result["c"].differs) == (1.0, 1.0, True)


def test_intervals_of_few_scenes_hold_as_often_as_stated():
    generator = np.random.default_rng(1)
    differences = generator.normal(0.3, 1.0, (250, 6))
    ends = [difference_interval(row, 0.95, seed=0) for row in differences]
    hits = np.mean([low <= 0.3 <= high for low, high in ends])
    assert hits > 0.95 - 3 * (0.95 * 0.05 / 250) ** 0.5  # three standard errors; percentiles hold in 85 %


def test_intervals_are_shifted_and_scaled_with_the_differences():
    differences = np.random.default_rng(2).lognormal(size=9)
    low, high = difference_interval(differences, 0.95, 3)
    assert low < differences.mean() < high
    # Rounding of the moved values.
    assert difference_interval(10 * differences + 4, 0.95, 3) == pytest.approx((10 * low + 4, 10 * high + 4), rel=1e-9)
    assert difference_interval(-differences, 0.95, 3) == pytest.approx((-high, -low), rel=1e-9)
    wider = difference_interval(differences, 0.99, 3)
    assert wider[0] < low and wider[1] > high
