"""Colour ranges and colour maps, checked by published formulas of colour science."""

import numpy as np
import pytest
from wording import check_text

from pcbench.report.colors import DIVERGING, SEQUENTIAL, Range, ranges, robust_maximum

# Machado, Oliveira and Fernandes 2009, severity 1, for linear RGB.
VISION_MATRICES = {
    "protan": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
    "deutan": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]],
    "tritan": [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]],
    "none": np.eye(3),
}


def lightness(colors, vision="none"):
    """Return CIE L* of sRGB colours (N, 3) from 0 to 255."""
    s = np.asarray(colors, float) / 255
    linear = np.where(s <= 0.04045, s / 12.92, ((s + 0.055) / 1.055) ** 2.4)
    linear = np.clip(linear @ np.array(VISION_MATRICES[vision]).T, 0, 1)
    y = linear @ [0.2126, 0.7152, 0.0722]
    return np.where(y > (6 / 29) ** 3, 116 * np.cbrt(y) - 16, y * (29 / 3) ** 3)


@pytest.mark.parametrize("vision", VISION_MATRICES)
def test_distances_are_readable_from_lightness_alone(vision):
    colors = Range(0.0, 1.0).colors(np.linspace(0, 1, 101))
    steps = np.diff(lightness(colors, vision)[::10])
    assert (steps > 2.5).all()  # visible to anybody, and uniform
    assert steps.max() < 3 * steps.min()
    grey = colors @ [0.299, 0.587, 0.114]
    assert (np.diff(grey[::10]) > 0).all()


def test_small_distances_stand_out_from_the_dark_background():
    assert lightness(SEQUENTIAL[:1])[0] > lightness([[0x1A, 0x1C, 0x20]])[0] + 12


def test_the_diverging_map_is_lightest_in_the_middle_and_symmetric():
    lightnesses = lightness(DIVERGING)
    assert int(np.argmax(lightnesses)) == len(DIVERGING) // 2
    np.testing.assert_allclose(lightnesses, lightnesses[::-1], atol=8)
    scale = Range(-1.0, 1.0, signed=True)
    assert scale.colors(np.array([0.0]))[0].tolist() == DIVERGING[len(DIVERGING) // 2].tolist()


def test_values_outside_a_range_have_the_colours_of_its_ends():
    colors = Range(0.0, 1.0).colors(np.array([-1.0, 0.0, 1.0, 5.0]))
    assert (colors[0] == colors[1]).all()
    assert (colors[2] == colors[3]).all()
    assert colors[1].tolist() == SEQUENTIAL[0].tolist()


def test_a_candidate_that_is_far_off_does_not_change_the_others():
    scales_without_far = ranges({"a": 0.02, "b": 0.05, "c": 0.09})
    assert {scale.high for scale in scales_without_far.values()} == {0.09}
    check_text(scales_without_far["a"].note, masked=False)
    scales = ranges({"a": 0.02, "far": 40.0, "b": 0.05, "c": 0.09})
    assert list(scales) == ["a", "far", "b", "c"]
    for name in "abc":
        assert scales[name].high == scales_without_far[name].high
        check_text(scales[name].note, masked=False)
    assert scales["far"].high == 40.0
    check_text(scales["far"].note, masked=False)


@pytest.mark.parametrize("seed", range(20))
def test_ranges_cover_the_distances_of_any_candidates(seed):
    """No range ends below a candidate's 95th percentile, and each candidate uses at least a fifth of its range."""
    rng = np.random.default_rng(seed)
    percentiles = {str(k): float(v) for k, v in enumerate(10.0 ** rng.uniform(-4, 4, rng.integers(1, 12)))}
    scales = ranges(percentiles)
    for name, scale in scales.items():
        assert percentiles[name] <= scale.high <= 5 * percentiles[name]
        scales_with_far = ranges({**percentiles, "far": 1e3 * max(percentiles.values())})
        assert scales_with_far[name].high == scale.high


def test_outliers_do_not_change_the_range():
    values = np.r_[np.linspace(-1, 1, 1000), [1e6] * 20]
    assert robust_maximum(values) < 1.0
    assert robust_maximum(np.zeros(0)) == 0.0


def test_rounding_errors_have_one_colour():
    scales = ranges({"same": 1e-15, "other": 0.1}, spacing=0.5)
    assert scales["same"].high == 0.5
    assert "rounding" in scales["same"].note
    assert scales["other"].high == 0.1
    assert ranges({"same": 0.0})["same"].high > 0


def test_a_given_range_applies_to_all_candidates():
    scales = ranges({"a": 0.02, "b": 40.0}, signed=True, end=0.3)
    assert {(scale.low, scale.high) for scale in scales.values()} == {(-0.3, 0.3)}
