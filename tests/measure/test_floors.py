"""Sampling floors: closed forms on a plane, and the scores of independent error-free samples of other surfaces."""

import numpy as np
import pytest
from floor_cases import Case, mean_floors, mean_rounded_ratios

from pcbench import Cloud, Settings, compare
from pcbench.measure.results import CANDIDATE_TO_REFERENCE, REFERENCE_TO_CANDIDATE

pytestmark = pytest.mark.usefixtures("without_deformation", "without_changes")


@pytest.mark.parametrize(
    ("reference", "candidate"),
    [(10_000, 1_250), *(pytest.param(*counts, marks=pytest.mark.long) for counts in ((5_000, 5_000), (1_250, 10_000)))],
)
def test_floors_of_a_poisson_plane_equal_the_closed_form(reference, candidate):
    """To a Poisson process of density d, E r^2 = 1 / (pi d) and E r = 1 / (2 sqrt d); edges are excluded."""
    rng = np.random.default_rng(reference)
    runs = []
    for _ in range(4):
        clouds = [np.column_stack([rng.random((n, 2)), np.zeros(n)]) for n in (reference, candidate)]
        settings = Settings(register="none", crop="box:0.1,0.1,-1,0.9,0.9,1")
        runs.append(compare(*clouds, settings).candidates[0].metrics)
    for direction, density in ((CANDIDATE_TO_REFERENCE, reference), (REFERENCE_TO_CANDIDATE, candidate)):
        d1 = np.mean([metrics.d1_mse[direction].floor for metrics in runs])
        assert d1 == pytest.approx(1 / (np.pi * density), rel=0.08)
        assert np.mean([m.mean_distance[direction].floor for m in runs]) == pytest.approx(0.5 * density**-0.5, rel=0.04)
        assert runs[0].d2_mse[direction].floor == pytest.approx(0, abs=1e-20)
    sums = runs[0].d1_mse[CANDIDATE_TO_REFERENCE].floor + runs[0].d1_mse[REFERENCE_TO_CANDIDATE].floor
    assert runs[0].chamfer.sum_squared.floor == pytest.approx(sums, rel=1e-12)


@pytest.mark.parametrize(
    "case",
    [
        Case("torus", 1_000, 1_000),
        Case("torus", 4_000, 250),
        Case("boxes", 250, 4_000),
        Case("city", 200, 200),
        Case("cylinder", 2_000, 2_000, falling=16),
    ],
    ids=lambda case: f"{case.surface}-{case.reference}-{case.candidate}",
)
def test_scores_of_error_free_samples_equal_their_floors(case):
    ratios = mean_floors(case, 6).ratios
    np.testing.assert_allclose(ratios[:, [0, 2]], 1, atol=0.1)  # D1 and the mean distance
    np.testing.assert_allclose(ratios[:, 1], 1, atol=0.25)  # D2: a few points at edges dominate


def test_floor_excludes_noise_of_the_candidate():
    clean, noisy = mean_floors(Case("torus", 3_000, 3_000), 3), mean_floors(Case("torus", 3_000, 3_000, noise=0.5), 3)
    np.testing.assert_allclose(noisy.floors / clean.floors, 1, atol=0.07)
    assert (noisy.ratios[:, 0] > 1.15).all()
    assert (noisy.ratios[:, 1] > 20).all()


def test_duplicates_do_not_change_the_floor():
    rng = np.random.default_rng(3)
    clouds = [np.column_stack([rng.random((2_000, 2)), np.zeros(2_000)]) for _ in range(2)]
    single, doubled = (
        compare(*(Cloud(np.tile(cloud, (times, 1))) for cloud in clouds), Settings(register="none"))[
            "candidate_1"
        ].metrics
        for times in (1, 2)
    )
    for direction in (CANDIDATE_TO_REFERENCE, REFERENCE_TO_CANDIDATE):
        assert doubled.d1_mse[direction].floor == pytest.approx(single.d1_mse[direction].floor, rel=0.08)


def test_floor_excludes_holes_of_the_candidate():
    """Completeness measures the hole; the floor is that of the points around it."""
    rng = np.random.default_rng(4)
    reference, candidate = (np.column_stack([rng.random((n, 2)), np.zeros(n)]) for n in (4_000, 4_000))
    candidate = candidate[np.linalg.norm(candidate[:, :2] - 0.5, axis=1) > 0.3]
    d1 = compare(reference, candidate, Settings(register="none"))["candidate_1"].metrics.d1_mse
    assert d1[REFERENCE_TO_CANDIDATE].floor == pytest.approx(1 / (np.pi * 4_000), rel=0.15)
    assert d1[REFERENCE_TO_CANDIDATE].value > 30 * d1[REFERENCE_TO_CANDIDATE].floor


def test_floors_of_coincident_points_are_zero_and_finite():
    rng = np.random.default_rng(5)
    reference = np.column_stack([rng.random((50, 2)), np.zeros(50)])
    for clouds in ((reference, np.tile([0.5, 0.5, 0], (20, 1))), (np.tile(reference[:1], (9, 1)), reference)):
        metrics = compare(*clouds, Settings(register="none"))["candidate_1"].metrics
        assert 0 in (metrics.d1_mse[CANDIDATE_TO_REFERENCE].floor, metrics.d1_mse[REFERENCE_TO_CANDIDATE].floor)
        assert all(
            np.isfinite(metrics.directed[name][direction].floor or 0)
            for name in metrics.directed
            for direction in (CANDIDATE_TO_REFERENCE, REFERENCE_TO_CANDIDATE)
        )


@pytest.mark.parametrize(
    ("name", "counts", "steps"),
    [
        ("city", (3_000, 3_000), (0.01, 0.0)),
        pytest.param("city", (3_000, 3_000), (0.0, 0.01), marks=pytest.mark.long),
        ("torus", (3_000, 3_000), (0.01, 0.01)),
    ],
)
def test_scores_of_rounded_error_free_samples_equal_their_floors(name, counts, steps):
    """Spacings are 0.01 to 0.03. Without rounding, the floor of D2 would be up to 40 times smaller."""
    ratios = mean_rounded_ratios(name, counts, steps, runs=2)
    np.testing.assert_allclose(ratios[:, [0, 2]], 1, atol=0.12)
    np.testing.assert_allclose(ratios[:, 1], 1, atol=0.25)  # D2: a few points at edges dominate


def test_floors_of_a_tilted_rounded_plane_equal_the_closed_form():
    """Along the normal, each cloud has the variance step^2 / 12 if the rounding of neighbours is independent."""
    rng = np.random.default_rng(6)
    clouds = []
    for count, step in ((8_000, 0.003), (4_000, 0.006)):
        xy = rng.random((count, 2))
        clouds.append(np.round(np.column_stack([xy, xy @ [0.37, 0.53]]) / step) * step)
    d2 = compare(*clouds, Settings(register="none"))["candidate_1"].metrics.d2_mse
    expected = (0.003**2 + 0.006**2) / 12
    for direction in (CANDIDATE_TO_REFERENCE, REFERENCE_TO_CANDIDATE):
        assert d2[direction].value == pytest.approx(expected, rel=0.1)
        assert d2[direction].floor == pytest.approx(expected, rel=0.15)
