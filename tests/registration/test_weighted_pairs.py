"""Residuals, weights and normal equations of pairs equal their definitions."""

import numpy as np
import pytest

from pcbench.native import _core


@pytest.mark.parametrize("robust", [False, True])
def test_normal_equations_equal_their_definition(robust):
    rng = np.random.default_rng(6)
    count, max_distance = 3001, 1.2
    closest, moved = rng.normal(size=(2, count, 3)) + [3, -2, 40]
    normals = rng.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    rows = rng.integers(0, count, count)
    distances = np.linalg.norm(moved - closest[rows], axis=1)
    residuals, weights = np.empty(count), np.empty(count)
    pair_count, sigma = _core.weigh(
        moved, distances, closest, rows, normals, max_distance, robust, 0.9, residuals, weights
    )

    expected = ((moved - closest[rows]) * normals[rows]).sum(axis=1)
    in_range = distances <= max_distance
    np.testing.assert_allclose(residuals, expected, rtol=0, atol=1e-14)
    assert pair_count == in_range.sum()
    assert sigma == pytest.approx(1.4826 * np.median(np.abs(expected[in_range])), rel=1e-12)
    if robust:
        expected_weights = np.clip(1 - (expected / (4.685 * sigma)) ** 2, 0, None) ** 2
    else:
        expected_weights = distances <= np.quantile(distances[in_range], 0.9, method="lower")
    np.testing.assert_allclose(weights, np.where(in_range, expected_weights, 0), rtol=0, atol=1e-12)

    hessian, gradient, center = np.empty((7, 7)), np.empty(7), np.empty(3)
    radius = _core.plane_system(moved, normals, rows, residuals, weights, hessian, gradient, center)
    np.testing.assert_allclose(center, np.average(moved, axis=0, weights=weights), rtol=1e-13)
    lever_arms, pair_normals = moved - center, normals[rows]
    assert radius == pytest.approx(np.sqrt(np.average((lever_arms**2).sum(axis=1), weights=weights)), rel=1e-13)
    jacobian = np.hstack(
        [
            np.cross(lever_arms, pair_normals) / radius,
            pair_normals,
            (lever_arms * pair_normals).sum(axis=1)[:, None] / radius,
        ]
    )
    np.testing.assert_allclose(hessian, (jacobian * weights[:, None]).T @ jacobian, rtol=0, atol=1e-9)
    np.testing.assert_allclose(gradient, jacobian.T @ (weights * residuals), rtol=0, atol=1e-9)
