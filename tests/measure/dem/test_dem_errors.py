"""Errors from stable terrain, and the uncertainty of sums, against known errors and brute force."""

import numpy as np
import pytest
from volume_cases import correlated_field

from pcbench.measure.dem.covariance import SumWeights
from pcbench.measure.dem.reml import fit_errors


def _form(weights: np.ndarray, length: float) -> float:
    places = np.argwhere(weights != 0)
    values = weights[weights != 0]
    distances = np.linalg.norm(places[:, None] - places, axis=2)
    return float(values @ np.exp(-distances / length) @ values)


@pytest.mark.parametrize("length", [0.8, 4.0, 30.0])
def test_form_is_the_double_sum(length: float) -> None:
    weights = np.zeros((40, 50))
    weights[5:25, 10:40] = np.random.default_rng(0).uniform(0.5, 1.5, (20, 30))
    # Distances are gathered in 96 bins, which are exact only for the shortest.
    assert SumWeights.of(weights, np.ones_like(weights)).form(0, length) == pytest.approx(
        _form(weights, length), rel=0.02
    )


@pytest.mark.parametrize("length", [6.0, 40.0])
def test_form_of_a_large_area_is_summed_over_blocks(length: float) -> None:
    weights = np.zeros((12, 600))
    weights[2:10, 5:590:2] = 1.0
    sums = SumWeights.of(weights, np.ones_like(weights))
    assert sums.step > 1
    assert sums.form(0, length) == pytest.approx(_form(weights, length), rel=0.05)  # the blocks' inside is smoothed


def test_white_variance_of_a_sum() -> None:
    weights, white = np.array([[0, 2.0], [1.0, 0]]), np.array([[np.nan, 3.0], [5.0, np.nan]])
    assert SumWeights.of(weights, white).white == 17


def test_errors_are_recovered() -> None:
    rng = np.random.default_rng(1)
    white = rng.uniform(0.5, 2.0, (70, 70))
    noise = 0.05 * np.sqrt(white) * rng.standard_normal(white.shape)
    stable = np.ones(white.shape, dtype=bool)
    alone = fit_errors(noise, white, stable)
    assert alone is not None and alone.white_scale**0.5 == pytest.approx(0.05, rel=0.1)
    assert alone.correlated_sigma < 0.02
    model = fit_errors(noise + 0.06 * correlated_field(rng, 70, 6.0, is_gaussian=True), white, stable)
    assert model is not None and model.white_scale**0.5 == pytest.approx(0.05, rel=0.15)
    assert 0.04 < np.hypot(model.long.sigma, model.short.sigma) < 0.12  # some ten independent bumps along each side


def test_half_width_is_the_quantile_of_the_mixture() -> None:
    rng = np.random.default_rng(2)
    white = np.ones((40, 40))
    errors = 0.05 * rng.standard_normal(white.shape) + 0.03 * correlated_field(rng, 40, 4.0, is_gaussian=True)
    model = fit_errors(errors, white, np.ones(white.shape, dtype=bool))
    assert model is not None
    sums = SumWeights.of(white, white)
    variances, weights = model.variances_of(sums)
    chosen = rng.choice(len(weights), 200_000, p=weights)
    draws = np.sqrt(variances[chosen]) * rng.standard_t(model.dof, len(chosen))
    # The 95 % quantile of 200,000 draws has a standard error of some 0.5 %.
    assert model.half_width(sums) == pytest.approx(np.quantile(np.abs(draws), 0.95), rel=0.03)


def test_too_little_stable_terrain_has_no_errors() -> None:
    assert fit_errors(np.zeros((9, 9)), np.ones((9, 9)), np.eye(9, dtype=bool)) is None
