"""Verdicts on scenes without smooth surfaces, with uneven noise, or of which only parts moved."""

from dataclasses import replace

import numpy as np
import pytest
from bent_clouds import add_dome, add_noise, sample_city, verdict, warning_codes
from data_folder import data_folder
from deformation_cases import BENDS, NULLS, PARTS, correlated_noise, turned_city
from scipy.spatial.distance import cdist
from wording import check_text

from pcbench import Cloud, read_cloud
from pcbench.deformation import Side, deform, residual_deformation
from pcbench.deformation.blocks import Blocks, noise_sizes
from pcbench.deformation.field import _largest_group, _null_scale
from pcbench.deformation.sums import kernel_sums
from pcbench.errors import Notice
from pcbench.geometry.neighbors import Index
from pcbench.geometry.normals import Surface, estimate_normals
from pcbench.registration import register
from pcbench.registration.result import FAR_OFF


def deform_pair(make, seed, method="icp", step=1):
    """Return the verdict on a pair, or on every `step`-th point of both clouds."""
    clouds = (cloud.select(np.arange(0, len(cloud), step)) for cloud in make(seed)[:2])
    return deform(*clouds, method)[1]


SLOW = pytest.mark.slow


@pytest.mark.long
@pytest.mark.parametrize("case", ["forest", pytest.param("conifer halves", marks=SLOW), "topography halves"])
def test_halves_of_a_forest_are_not_bent(case):
    """In a cloud that fills a volume, any assumed bend finds closest points that confirm it."""
    result = deform_pair(NULLS[case], 40)
    assert result.verdict == "none"
    # Both kinds of pairs are evaluated for these halves, and each cell is still listed once.
    assert result.field.counts.sum() == result.pairs
    assert len(np.unique(result.field.places, axis=0)) == len(result.field.places)


@pytest.mark.long
@pytest.mark.parametrize("case", ["city uneven, L/50", "city sparse, white", pytest.param("terrain, L/50", marks=SLOW)])
def test_uneven_noise_sparse_edges_and_smooth_ground_are_not_reported_as_a_bend(case):
    assert deform_pair(NULLS[case], 41).verdict == "none"


@pytest.mark.long
def test_bend_of_a_forest_is_detected():
    result = deform_pair(BENDS["conifer bent 0.7"], 42)
    assert result.verdict == "non-affine", result.warnings


@pytest.mark.long
def test_subsidence_is_reported_with_its_size_and_place():
    result = deform_pair(PARTS["subsidence 1"], 43, step=2)
    assert result.verdict == "none"
    largest = result.changes[0]
    assert largest.kind == "moved"
    assert largest.mean == pytest.approx(-1.0, rel=0.4)
    assert largest.shifted(np.array([1000.0, 0, 0])).place[0] == pytest.approx(largest.place[0] + 1000)


def test_groups_of_adjacent_tiles():
    x, y = np.meshgrid(np.arange(6.0), np.arange(6.0))
    places = np.column_stack([x.ravel(), y.ravel(), 0 * x.ravel()])
    assert _largest_group(places, 1.5) == 36
    assert _largest_group(places[::2] * [3.0, 1.0, 1.0], 1.5) == 6  # three columns, far apart
    assert _largest_group(places[:1], 1.5) == 1
    assert _largest_group(places[:0], 1.5) == 0


def test_offset_strips_are_reported():
    rng = np.random.default_rng(44)
    reference, candidate = (add_noise(sample_city(count, rng), rng) for count in (24_000, 10_000))
    candidate[candidate[:, 0] > 20] += [0.25, 0.15, 0.5]
    result = verdict(reference, candidate)
    assert result.verdict == "undecided"
    assert "parts-displaced" in warning_codes(result)
    assert " 90 degrees " in check_text(result.warnings[0])


@pytest.mark.long
def test_clouds_that_are_not_registered_get_no_verdict():
    result = deform_pair(turned_city(3.0), 45, "none", step=4)
    assert result.verdict == "undecided"
    assert warning_codes(result)[0] in ("not-registered", "doubtful-registration")


@pytest.mark.long
def test_both_sizes_of_a_bend_are_correct():
    """The sizes of a dome over the ground and over the whole surface differ, because walls do not show it."""
    rng = np.random.default_rng(46)
    candidate = add_dome(sample_city(20_000, rng), 0.1)
    result = verdict(add_noise(sample_city(60_000, rng), rng), add_noise(candidate, rng))
    surface_points, amplitude = sample_city(100_000, np.random.default_rng(47)), result.amplitude
    lift = (add_dome(surface_points, 0.1) - surface_points)[:, 2]
    # The city's normals: vertical on flat ground and roofs, horizontal on walls.
    normals = estimate_normals(Index(surface_points)).directions
    columns = (
        normals[:, :, None] * np.hstack([np.ones((len(surface_points), 1)), surface_points / 200])[:, None]
    ).reshape(-1, 12)
    normal_displacements = lift * normals[:, 2]
    non_affine_part = normal_displacements - columns @ np.linalg.lstsq(columns, normal_displacements, rcond=None)[0]
    assert amplitude.rms_surface == pytest.approx(float(np.sqrt(np.mean(np.square(non_affine_part)))), rel=0.1)
    assert amplitude.rms_surface < 0.95 * amplitude.rms
    assert amplitude.ci_surface[0] < amplitude.rms_surface < amplitude.ci_surface[1]


def test_kernel_sums_approximate_sums_over_all_pairs():
    """Sums over a few partners approximate those over all pairs."""
    rng = np.random.default_rng(48)
    counts = np.array([200, 1, 90, 2])
    starts = np.concatenate([[0], np.cumsum(counts)[:-1]])
    positions, normals = rng.random((293, 3)), rng.normal(size=(293, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    weights, lengths = rng.random(293), np.array([0.05, 0.3, 2.0])
    sums = np.add.reduceat(kernel_sums(positions, normals, weights, starts, lengths, partners=60), starts)
    for start, count, approximate_sums in zip(starts, counts, sums, strict=True):
        x, n, w = positions[start : start + count], normals[start : start + count], weights[start : start + count]
        products = np.outer(w, w) * np.square(n @ n.T)
        exact_sums = [float((products * np.exp(-0.5 * np.square(cdist(x, x) / length))).sum()) for length in lengths]
        np.testing.assert_allclose(approximate_sums, exact_sums, rtol=0.1)


def test_sizes_of_uneven_noise_are_recovered():
    rng = np.random.default_rng(49)
    positions = rng.uniform(-100, 100, (20_000, 3)) * [1, 1, 0]
    true_sizes = 0.05 * 2 ** (positions[:, 0] / 100)
    residuals = true_sizes * rng.normal(size=20_000)
    weights = np.ones(20_000)
    estimated_sizes = np.sqrt(Blocks.of(positions).smooth(np.square(residuals), weights))
    assert np.max(np.abs(estimated_sizes / true_sizes - 1)) < 0.25
    in_moved_part = np.hypot(*(positions[:, :2] - 30).T) < 25  # a twentieth of the scene
    residuals[in_moved_part] += 10.0
    assert (
        np.max(noise_sizes(positions, residuals, weights)[in_moved_part]) < 0.15
    )  # and the motion is not counted as noise


def test_simulated_noise_has_the_expected_correlation():
    rng = np.random.default_rng(50)
    positions = rng.uniform(0, 100, (3000, 3)) * [1, 1, 0.1]
    fields = np.concatenate([correlated_noise(positions, 5.0, rng) for _ in range(10)], axis=1)
    distances = cdist(positions[:1500], positions[1500:])
    for low, high in ((0, 2), (4, 6), (9, 11), (25, 40)):
        i, j = np.nonzero((distances >= low) & (distances < high))
        expected = np.mean(np.exp(-0.5 * np.square(distances[i, j] / 5.0)))
        assert np.mean(fields[i] * fields[1500 + j]) == pytest.approx(expected, abs=0.08)


def test_doubtful_registration_gives_no_verdict():
    rng = np.random.default_rng(51)
    clouds = [Cloud(add_noise(sample_city(count, rng), rng), unit="m") for count in (10_000, 4_000)]
    registration = register(*clouds, "none")
    sides = [Side(Surface(Index(c.points)), np.ones(len(c), dtype=bool), c) for c in clouds]
    assert residual_deformation(*sides, registration, np.zeros(3)).verdict == "none"
    doubtful_registration = replace(registration, warnings=(Notice(FAR_OFF, "far off"),))
    result = residual_deformation(*sides, doubtful_registration, np.zeros(3))
    assert (result.verdict, warning_codes(result)) == ("undecided", ["doubtful-registration"])


def test_null_distribution_follows_heavy_tails_but_not_moved_cells():
    rng = np.random.default_rng(48)
    freedom = rng.integers(1, 4, 400)
    plain = rng.chisquare(freedom)
    assert _null_scale(plain, freedom) == pytest.approx(1.0, abs=0.2)
    moved = np.where(np.arange(400) < 40, 1e6, plain)
    assert _null_scale(moved, freedom) < 2.0
    heavy = plain * np.where(rng.random(400) < 0.3, 10.0, 1.0)  # uneven noise
    assert _null_scale(heavy, freedom) > 2.0


@pytest.mark.long
def test_few_tiles_of_an_undeformed_street_scan_change():
    """Tiles of a scan have heavy tails: density, incidence and curvature vary from tile to tile."""
    scan = read_cloud(data_folder("small_gicp") / "target.ply", on_warning=lambda _: None)
    changed, tested = 0, 0
    for seed in (100, 101):
        order = np.random.default_rng(seed).permutation(len(scan))
        local = deform(scan.select(order[::2]), scan.select(order[1::2]), "icp")[1].local
        changed, tested = changed + local.tiles_changed, tested + local.tiles_tested
        assert local.largest_group < 5  # more would be reported as a changed part
    assert changed <= 0.06 * tested  # 4.4 %; 12 % if the median alone gives the scale of the noise
