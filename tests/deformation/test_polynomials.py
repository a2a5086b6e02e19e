"""Polynomial fields: their normal equations, and the nested models."""

import numpy as np
import pytest
from wording import check_error

from pcbench.deformation.displacement import Displacement
from pcbench.deformation.polynomials import (
    PARAMETERS,
    Planes,
    form_of_moments,
    model_columns,
    monomials,
    normal_equations,
    normal_matrix,
    value_of_digits,
    whole_normal_equations,
)


def test_moments_contain_the_normal_equations_of_a_cubic_field():
    rng = np.random.default_rng(0)
    positions, normals = rng.uniform(-1, 1, (50, 3)), rng.normal(size=(50, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    weights, residuals = rng.random(50), rng.normal(size=50)
    design = np.einsum("an,nk->nak", monomials(positions), normals).reshape(50, 60)
    starts = np.array([0, 20, 20])  # a group of twenty pairs, an empty one, the rest
    moments, scores = normal_equations(positions, normals, weights, residuals, starts)
    for group, rows in enumerate((slice(0, 20), slice(20, 20), slice(20, 50))):
        matrix = design[rows].T @ (weights[rows, None] * design[rows])
        # Sums of fifty terms of size one.
        np.testing.assert_allclose(normal_matrix(moments[group]), matrix, atol=1e-12)
        np.testing.assert_allclose(scores[group].ravel(), design[rows].T @ (weights * residuals)[rows], atol=1e-12)


def test_a_quadratic_form_follows_from_the_moments():
    rng = np.random.default_rng(1)
    moments, coefficients = rng.normal(size=(84, 6)), rng.normal(size=60)
    form = coefficients @ normal_matrix(moments) @ coefficients
    assert (moments * form_of_moments(coefficients)).sum() == pytest.approx(form, abs=1e-10)  # 3,600 terms of size one


def test_a_weakly_damped_fit_recovers_a_cubic_field():
    rng = np.random.default_rng(2)
    places, normals = rng.uniform(-5, 5, (3_000, 3)), rng.normal(size=(3_000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    zero = Displacement.zero(np.zeros(3), 5.0)
    field = zero._replace(coefficients=rng.normal(size=(20, 3)))
    residuals, frame = np.einsum("ni,ni->n", field(places), normals), zero.frame(places, 0.0)
    fitted = zero.fit(frame, normals, residuals, np.ones(3_000), 1e-9)
    # Damping takes (1e-9 / 0.1)^2 of each part, whose information is at least a tenth; rounding takes more.
    np.testing.assert_allclose(fitted(places), field(places), atol=1e-9)
    np.testing.assert_allclose(fitted.from_monomials(frame.values), fitted(places), atol=1e-12)


def test_whole_numbers_add_up_in_any_order_and_for_any_number_of_pairs():
    rng = np.random.default_rng(3)
    positions, normals, residuals = rng.uniform(-1, 1, (4_001, 3)), rng.normal(size=(4_001, 3)), rng.normal(size=4_001)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    order = rng.permutation(4_001)
    planes = Planes(positions, normals, None, np.zeros(3), 1.0)
    pieces = [whole_normal_equations(planes, residuals, some) for some in np.split(order, [9])]
    together = whole_normal_equations(planes, residuals, order)
    floating = normal_equations(positions, normals, np.ones(4_001), residuals)
    for which in range(2):
        values = value_of_digits(together[which])
        # Sums of 4,001 products of factors that are rounded to 2^-40.
        np.testing.assert_allclose(values, floating[which][0], atol=4_001 * 2.0**-38)
        np.testing.assert_array_equal(value_of_digits(pieces[0][which] + pieces[1][which]), values)
        # As many pairs as a comparison of 1e11 points has, whose sums exceed 63 bits.
        np.testing.assert_array_equal(value_of_digits(together[which] << 25), 2.0**25 * values)


def test_invalid_groups_are_refused():
    values, positions = np.ones(4), np.zeros((4, 3))
    for starts in ([2, 1], [0, 5], [-1]):
        with check_error(ValueError):
            normal_equations(positions, positions, values, values, np.array(starts))


@pytest.mark.parametrize(
    ("smaller", "larger"), [("rigid", "similarity"), ("similarity", "affine"), ("affine", "cubic")]
)
def test_models_are_nested_and_count_their_parameters(smaller, larger):
    smaller_columns, larger_columns = model_columns(smaller), model_columns(larger)
    assert np.linalg.matrix_rank(smaller_columns) == smaller_columns.shape[1] == PARAMETERS[smaller]
    assert np.linalg.matrix_rank(np.hstack([smaller_columns, larger_columns])) == larger_columns.shape[1]


def test_rigid_fields_preserve_distances_and_similarities_preserve_shapes():
    positions = np.random.default_rng(0).uniform(-1, 1, (20, 3))
    for model, column_count in (("rigid", 6), ("similarity", 7)):
        for column in model_columns(model).T:
            displacements = np.einsum("an,ak->nk", monomials(positions), column.reshape(20, 3))
            # The gradient is antisymmetric, but for a scale.
            gradient = np.linalg.lstsq(
                positions - positions.mean(0), displacements - displacements.mean(0), rcond=None
            )[0]
            symmetric_part = gradient + gradient.T
            np.testing.assert_allclose(symmetric_part, symmetric_part[0, 0] * np.eye(3), atol=1e-12)
        assert model_columns(model).shape[1] == column_count
