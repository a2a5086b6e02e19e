"""Verdicts on scenes without smooth surfaces, with uneven noise, or of which only parts moved."""

from dataclasses import replace

import numpy as np
import pytest
from bent_clouds import add_dome, add_noise, sample_city, verdict, warning_codes
from deformation_cases import BENDS, NULLS, PARTS, correlated_noise, turned_city
from scipy.spatial.distance import cdist
from wording import check_text

from pcbench import Cloud
from pcbench.deformation import Side, deform, residual_deformation
from pcbench.deformation.blocks import noise_sizes, smooth
from pcbench.deformation.sums import kernel_sums
from pcbench.errors import Notice
from pcbench.geometry.neighbors import Index
from pcbench.geometry.normals import Surface, estimate_normals
from pcbench.registration import register
from pcbench.registration.result import FAR_OFF


def found(make, seed, method="icp"):
    pair = make(seed)
    return deform(pair.reference, pair.candidate, method)[1]


SLOW = pytest.mark.slow


@pytest.mark.parametrize("case", ["forest", pytest.param("conifer halves", marks=SLOW), "topography halves"])
def test_halves_of_a_forest_are_not_bent(case):
    """In a cloud that fills a volume, any assumed bend finds closest points that confirm it."""
    assert found(NULLS[case], 40).verdict == "none"


@pytest.mark.parametrize("case", ["city uneven, L/50", "city sparse, white", pytest.param("terrain, L/50", marks=SLOW)])
def test_uneven_noise_bridged_edges_and_smooth_ground_are_no_bend(case):
    assert found(NULLS[case], 41).verdict == "none"


def test_a_bend_is_found_in_a_forest():
    answer = found(BENDS["conifer bent 0.7"], 42)
    assert answer.verdict == "non-affine", answer.warnings


def test_subsidence_is_reported_with_its_size_and_place():
    answer = found(PARTS["subsidence 1"], 43)
    assert answer.verdict == "none"
    assert answer.local.largest == pytest.approx(1.0, rel=0.4)  # a tile beside walls contains more than ground
    assert f" {answer.local.largest:.3g} m at (" in check_text(answer.sentence("b.ply", "m"))
    shifted = answer.shifted(np.array([1000.0, 0, 0]))
    assert shifted.local.at[0] == pytest.approx(answer.local.at[0] + 1000)


def test_offset_strips_are_reported():
    answer = found(PARTS["strips 0.5"], 44)
    assert answer.verdict == "undecided"
    assert "parts-displaced" in warning_codes(answer)
    assert " 90 degrees " in check_text(answer.warnings[0])


def test_clouds_that_are_not_registered_get_no_verdict():
    answer = found(turned_city(3.0), 45, "none")
    assert answer.verdict == "undecided"
    assert warning_codes(answer)[0] in ("not-registered", "doubtful-registration")


def test_both_sizes_of_a_bend_are_correct():
    """The sizes of a dome over the ground and over the whole surface differ, because walls do not show it."""
    rng = np.random.default_rng(46)
    candidate = add_dome(sample_city(40_000, rng), 0.1)
    answer = verdict(add_noise(sample_city(120_000, rng), rng), add_noise(candidate, rng))
    surface, size = sample_city(200_000, np.random.default_rng(47)), answer.amplitude
    lift = (add_dome(surface, 0.1) - surface)[:, 2]
    # The city's normals: vertical on flat ground and roofs, horizontal on walls.
    normals = estimate_normals(Index(surface)).directions
    columns = (normals[:, :, None] * np.hstack([np.ones((len(surface), 1)), surface / 200])[:, None]).reshape(-1, 12)
    seen = lift * normals[:, 2]
    truth = seen - columns @ np.linalg.lstsq(columns, seen, rcond=None)[0]
    assert size.rms_surface == pytest.approx(float(np.sqrt(np.mean(np.square(truth)))), rel=0.1)
    assert size.rms_surface < 0.95 * size.rms
    assert size.ci_surface[0] < size.rms_surface < size.ci_surface[1]


def test_sums_over_the_pairs_of_a_cell():
    """Sums over a few partners approximate those over all pairs."""
    rng = np.random.default_rng(48)
    counts = np.array([200, 1, 90, 2])
    starts = np.concatenate([[0], np.cumsum(counts)[:-1]])
    places, normals = rng.random((293, 3)), rng.normal(size=(293, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    loads, lengths = rng.random(293), np.array([0.05, 0.3, 2.0])
    sums = np.add.reduceat(kernel_sums(places, normals, loads, starts, lengths, partners=60), starts)
    for start, count, ours in zip(starts, counts, sums, strict=True):
        x, n, w = places[start : start + count], normals[start : start + count], loads[start : start + count]
        products = np.outer(w, w) * np.square(n @ n.T)
        all_pairs = [float((products * np.exp(-0.5 * np.square(cdist(x, x) / length))).sum()) for length in lengths]
        np.testing.assert_allclose(ours, all_pairs, rtol=0.1)


def test_sizes_of_uneven_noise_are_recovered():
    rng = np.random.default_rng(49)
    places = rng.uniform(-100, 100, (20_000, 3)) * [1, 1, 0]
    true = 0.05 * 2 ** (places[:, 0] / 100)
    residuals = true * rng.normal(size=20_000)
    weights = np.ones(20_000)
    local = np.sqrt(smooth(places, np.square(residuals), weights))
    assert np.max(np.abs(local / true - 1)) < 0.25
    moved = np.hypot(*(places[:, :2] - 30).T) < 25  # a twentieth of the scene
    residuals[moved] += 10.0
    assert np.max(noise_sizes(places, residuals, weights)[moved]) < 0.15  # and the motion is not counted as noise


def test_simulated_noise_has_its_correlation():
    rng = np.random.default_rng(50)
    places = rng.uniform(0, 100, (3000, 3)) * [1, 1, 0.1]
    fields = np.concatenate([correlated_noise(places, 5.0, rng) for _ in range(10)], axis=1)
    apart = cdist(places[:1500], places[1500:])
    for low, high in ((0, 2), (4, 6), (9, 11), (25, 40)):
        i, j = np.nonzero((apart >= low) & (apart < high))
        expected = np.mean(np.exp(-0.5 * np.square(apart[i, j] / 5.0)))
        assert np.mean(fields[i] * fields[1500 + j]) == pytest.approx(expected, abs=0.08)


def test_a_doubtful_registration_withholds_the_verdict():
    rng = np.random.default_rng(51)
    clouds = [Cloud(add_noise(sample_city(count, rng), rng), unit="m") for count in (30_000, 10_000)]
    registration = register(*clouds, "none")
    sides = [Side(Surface(Index(c.points)), np.ones(len(c), dtype=bool), c) for c in clouds]
    assert residual_deformation(*sides, registration, np.zeros(3)).verdict == "none"
    doubted = replace(registration, warnings=(Notice(FAR_OFF, "far off"),))
    answer = residual_deformation(*sides, doubted, np.zeros(3))
    assert (answer.verdict, warning_codes(answer)) == ("undecided", ["doubtful-registration"])


def test_cells_are_listed_once():
    """Both kinds of pairs are evaluated for these halves, and each cell is still listed once."""
    answer = found(NULLS["topography halves"], 40)
    assert answer.field.counts.sum() == answer.pairs
    assert len(np.unique(answer.field.places, axis=0)) == len(answer.field.places)
