"""Sampled distances to tangent planes: coverage, rare large errors, closed forms, and comparisons with a tolerance."""

import numpy as np
import plane_samples
import pytest
import shapes
from wording import check_error, check_text

from pcbench import Cloud, Settings, compare
from pcbench.measure import plane_sample, reference
from pcbench.measure.deviation import Spread
from pcbench.measure.plane_sample import sample_planes
from pcbench.measure.results import CANDIDATE_TO_REFERENCE, REFERENCE_TO_CANDIDATE
from pcbench.report import document, print_comparison

pytestmark = pytest.mark.usefixtures("without_deformation", "without_changes")

WAYS = (CANDIDATE_TO_REFERENCE, REFERENCE_TO_CANDIDATE)


@pytest.fixture
def sampled_from_any_size(monkeypatch):
    """Sample references of any size, with 500 points first."""
    monkeypatch.setattr(reference, "_MIN_SAMPLED_POINTS", 0)
    monkeypatch.setattr(plane_sample, "_FIRST_SIZE", 500)


@pytest.fixture(scope="module")
def city():
    """Return the distances of both directions for two clouds of a city."""
    return plane_samples.directions(shapes.city(120_000, seed=1)[0], shapes.city(100_000, noise=0.02, seed=2)[0])


@pytest.fixture(scope="module")
def pair():
    return shapes.city(6_000, seed=1)[0], shapes.city(5_000, noise=0.1, seed=2)[0]


@pytest.mark.parametrize("way", ["c→r", "r→c"])
def test_intervals_contain_the_exact_mean_square(city, way):
    found = plane_samples.coverage(city[way], 0.05, range(400))
    assert found.sampled == 400
    # Of 400 runs with a coverage of 95 %, fewer than 366 are covered once in ten thousand cases.
    assert found.covered >= 366
    assert found.within >= 366
    assert found.points < 0.3 * len(city[way].to_points)


def test_few_points_far_from_the_planes_are_not_missed():
    """Four of 200,000 points have 29 % of the mean square; a uniform sample would miss them in most runs."""
    rng = np.random.default_rng(2)
    to_points = np.abs(rng.normal(0.5, 0.1, 200_000))
    to_planes = 0.02 * rng.normal(size=len(to_points))
    to_planes[:4] = to_points[:4] = np.sqrt(0.29 / 0.71 * np.sum(to_planes[4:] ** 2) / 4)
    direction = plane_samples.Direction(to_points, to_planes)
    for seed in range(100):
        sample = sample_planes(to_points, lambda rows: to_planes[rows], 0.2, seed)
        assert sample is None or np.isin(np.arange(4), sample.rows).all()
        assert sample is None or abs(sample.mean_square / direction.mean_square - 1) < 0.25


def test_equal_ratios_give_the_exact_mean_square():
    """If all squares to planes are the same share of those to points, the ratio estimate has no error."""
    to_points = np.random.default_rng(3).gamma(2.0, size=100_000)
    sample = sample_planes(to_points, lambda rows: 0.5 * to_points[rows], 0.01, seed=4)
    assert sample.mean_square == pytest.approx(0.25 * np.mean(to_points**2), rel=1e-12)
    assert np.mean(sample.squares()) == pytest.approx(sample.mean_square, rel=1e-12)
    assert 0 < sample.half_width <= 0.01 * sample.mean_square


def test_a_larger_sample_contains_the_smaller_one_and_measures_no_point_twice():
    to_points = np.random.default_rng(5).gamma(2.0, size=200_000)
    cosines = np.random.default_rng(6).random(len(to_points))
    measured = []

    def measure(rows):
        measured.append(rows)
        return cosines[rows] * to_points[rows]

    sample = sample_planes(to_points, measure, 0.01, seed=7)
    assert len(measured) > 1
    np.testing.assert_array_equal(np.sort(np.concatenate(measured)), sample.rows)


@pytest.mark.parametrize(
    ("to_points", "ratio"),
    [
        (np.ones(20_000), 0.5),  # the first sample would exceed 30 % of the points
        (np.ones(100_000), 0.0),  # any share of zero needs all points
    ],
)
def test_a_sample_that_would_save_nothing_is_not_taken(to_points, ratio):
    assert sample_planes(to_points, lambda rows: ratio * to_points[rows], 0.05, seed=0) is None


def test_medians_of_a_sample_are_near_those_of_all_points(city):
    direction = city["c→r"]
    sample = sample_planes(direction.to_points, lambda rows: direction.to_planes[rows], 0.05, seed=8)
    every, estimated = Spread.of(direction.to_planes), Spread.of(sample)
    assert estimated.nmad == pytest.approx(every.nmad, rel=0.1)
    assert estimated.median == pytest.approx(every.median, abs=0.1 * every.nmad)
    assert estimated.rms == pytest.approx(every.rms, rel=0.05)
    assert (estimated.std, estimated.bias, estimated.percentiles) == (None, None, None)


@pytest.mark.parametrize("crop", ["none", "quantile:0.8"])
def test_tolerance_changes_only_distances_to_planes(sampled_from_any_size, pair, crop):
    cloud, other = pair
    settings = Settings(register="none", crop=crop, seed=3)
    exact = compare(cloud, other, settings)["candidate_1"].metrics
    estimated = compare(cloud, other, settings, tolerance=0.2)["candidate_1"].metrics
    assert set(estimated.d2_samples) == set(WAYS)
    for way in WAYS:
        floors = [metrics.d1_mse[way].floor for metrics in (estimated, exact)]
        assert estimated.d1_mse[way] == exact.d1_mse[way]._replace(floor=floors[0])
        assert floors[0] == pytest.approx(floors[1], rel=0.01)  # the share of errors that it excludes comes from D2
        assert estimated.hausdorff[way].largest == exact.hausdorff[way].largest
        assert estimated.spreads["distance"][way] == exact.spreads["distance"][way]
        error = abs(estimated.d2_mse[way].value - exact.d2_mse[way].value)
        assert 0 < error <= 2 * estimated.d2_samples[way].half_width
        assert estimated.d2_samples[way].half_width <= 0.2 * estimated.d2_mse[way].value
        assert estimated.d2_mse[way].floor == pytest.approx(exact.d2_mse[way].floor, rel=0.1)
        low, high = estimated.d2_mse[way].interval
        assert low < exact.d2_mse[way].value < high
        assert estimated.d2_mse[way].area_weighted is None  # a sample does not represent each voxel
    assert estimated.fscores == exact.fscores
    assert estimated.presets["mpeg"].d1_mse == exact.presets["mpeg"].d1_mse
    assert estimated.presets["mpeg"].d2_mse.symmetric is None


def test_a_sample_depends_on_the_seed_only(sampled_from_any_size, pair):
    cloud, other = pair
    values = [
        compare(cloud, other, register="none", tolerance=0.2, seed=seed)["candidate_1"].metrics.d2_mse.accuracy.value
        for seed in (1, 1, 2)
    ]
    assert values[0] == values[1] != values[2]


def test_a_candidate_on_the_reference_is_exact(sampled_from_any_size, pair, capsys):
    same = compare(pair[0], pair[0], register="none", tolerance=0.2)
    found = same["candidate_1"].metrics.d2_mse
    assert (found.accuracy.value, found.completeness.value) == (0, 0)
    print_comparison(same)
    assert "nan" not in capsys.readouterr().out


def test_presets_are_complete_if_all_points_were_measured(sampled_from_any_size, pair, monkeypatch):
    monkeypatch.setattr(plane_sample, "_MAX_SHARE", 0.0)
    exact = compare(*pair, register="none")["candidate_1"].metrics
    found = compare(*pair, register="none", tolerance=0.2)["candidate_1"].metrics
    assert not found.d2_samples
    assert found.presets == exact.presets


@pytest.mark.parametrize("has_normals", [False, True])
def test_small_references_and_those_with_normals_are_measured_completely(monkeypatch, pair, has_normals, capsys):
    cloud, other = pair
    given = Cloud(cloud)
    if has_normals:
        monkeypatch.setattr(reference, "_MIN_SAMPLED_POINTS", 0)
        given = Cloud(cloud, normals=np.tile([0.0, 0.0, 1.0], (len(cloud), 1)))
    found = compare(given, other, register="none", tolerance=0.2)
    exact = compare(given, other, register="none")
    assert not found["candidate_1"].metrics.d2_samples
    for way in WAYS:
        assert found["candidate_1"].metrics.d2_mse[way] == exact["candidate_1"].metrics.d2_mse[way]
    assert found["candidate_1"].metrics.presets == exact["candidate_1"].metrics.presets
    print_comparison(found)
    assert "all distances are exact" in capsys.readouterr().out


def test_the_report_says_what_was_estimated(sampled_from_any_size, pair, tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    cloud, other = pair
    found = compare(cloud, other, register="none", tolerance=0.2)
    print_comparison(found)
    check_text(capsys.readouterr().out)
    values = document(found)
    assert values["settings"]["tolerance"] == 0.2
    sample = values["candidates"][0]["metrics"]["d2_mse"]["sample"]
    assert sample[CANDIDATE_TO_REFERENCE]["points"] == found["candidate_1"].metrics.d2_samples[WAYS[0]].points
    found.save(tmp_path / "report", figures=False)
    assert "is estimated from" in (tmp_path / "report" / "table.md").read_text()


def test_tolerances_of_another_type_are_refused():
    for value in (True, "1%", [0.1]):
        with check_error():
            Settings(tolerance=value)
