"""Polynomial displacement fields: monomials, their products, and the five nested models.

A field is u(x) = sum_a c_a phi_a(x), with one coefficient vector (3,) for each of the 20 monomials phi of degree up to
three. Coefficients are stored as (60,), the three components of a monomial together, monomials by degree: the first
12 span the affine fields, the first 30 the quadratic ones.
"""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.native import _core

MODELS = ("rigid", "similarity", "affine", "quadratic", "cubic")
PARAMETERS = {"rigid": 6, "similarity": 7, "affine": 12, "quadratic": 30, "cubic": 60}
DEGREE = 3


def _exponents(degree: int) -> IntArray:
    """Return the exponents (M, 3) of all monomials up to a degree, sorted by degree: 1, z, y, x, zz, yz, ..."""
    powers = [p for p in product(range(degree + 1), repeat=3) if sum(p) <= degree]
    return np.array(sorted(powers, key=lambda p: (sum(p), p)), dtype=np.int64)


EXPONENTS = _exponents(DEGREE)  # (20, 3)
_PRODUCTS = _exponents(2 * DEGREE)  # (84, 3): all products of two monomials
_MONOMIAL_INDEX = {tuple(powers): place for place, powers in enumerate(_PRODUCTS.tolist())}
# Each monomial is an earlier one times a coordinate: (index of the earlier one, axis).
_RECURRENCE = [
    (_MONOMIAL_INDEX[tuple(p - (k == axis) for k, p in enumerate(powers))], axis)
    for powers in _PRODUCTS[1:].tolist()
    for axis in [next(k for k in range(3) if powers[k])]
]
# (20, 20) -> 84: the product of two monomials
_PRODUCT_INDEX = np.array([[_MONOMIAL_INDEX[tuple((a + b).tolist())] for b in EXPONENTS] for a in EXPONENTS])
# (20, 3): the monomial whose multiple is the derivative along each axis; any one where the derivative is zero
_DERIVATIVES = np.array(
    [
        [_MONOMIAL_INDEX[tuple(max(p - (k == axis), 0) for k, p in enumerate(powers))] for axis in range(3)]
        for powers in EXPONENTS.tolist()
    ]
)
_SYMMETRIC_INDEX = np.array([[0, 3, 4], [3, 1, 5], [4, 5, 2]])  # (3, 3) -> 6: xx, yy, zz, xy, xz, yz
_DIGIT_BITS = 20  # of whole numbers
_ONE_GROUP = np.zeros(1, dtype=np.int64)  # start of a single group


def monomials(places: FloatArray, number: int = len(EXPONENTS)) -> FloatArray:
    """Evaluate the first monomials, by default those up to degree three, at positions (N, 3); return (`number`, N)."""
    values = np.empty((number, len(places)))
    values[0] = 1.0
    coordinates = np.ascontiguousarray(places.T)
    for row, (earlier, axis) in enumerate(_RECURRENCE[: number - 1], 1):
        np.multiply(values[earlier], coordinates[axis], out=values[row])
    return values


def normal_equations(
    places: FloatArray, normals: FloatArray, weights: FloatArray, residuals: FloatArray, starts: IntArray = _ONE_GROUP
) -> tuple[FloatArray, FloatArray]:
    """Accumulate the normal equations of a cubic field for each group of pairs.

    The gradient of the residual with respect to the coefficients is phi(x) n. Each entry of the (60, 60) normal matrix
    is thus the sum of a monomial of degree up to six times an entry of n n': 504 values instead of 1830.

    Args:
        places: (N, 3) positions, scaled to about -1 to 1.
        normals: (N, 3) unit normals.
        weights: (N,) weights.
        residuals: (N,) residuals along the normals.
        starts: (G,) first row of each group.

    Returns:
        Moments (G, 84, 6), sums of w phi_a phi_b n n', and scores (G, 20, 3), sums of w phi n r, the right-hand side.
    """
    moments = np.empty((len(starts), len(_PRODUCTS), 6))
    scores = np.empty((len(starts), len(EXPONENTS), 3))
    places, normals, weights, residuals = map(np.ascontiguousarray, (places, normals, weights, residuals))
    _core.normal_equations(places, normals, weights, residuals, starts, np.array(_RECURRENCE), moments, scores)
    return moments, scores


def equal_normal_equations(
    places: FloatArray, normals: FloatArray, residuals: FloatArray
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Accumulate normal equations of pairs of equal weight: moments (84, 6) and scores (20, 3)."""
    moments, scores = normal_equations(places, normals, np.ones(len(places)), residuals)
    return moments[0], scores[0]


def whole_normal_equations(
    places: FloatArray, normals: FloatArray, residuals: FloatArray
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Accumulate normal equations of pairs of equal weight, in whole numbers: in any order, they add up to the same.

    Monomials, products of normals and loads are rounded to multiples of 2^-40.

    Args:
        places: (N, 3) positions from -1 to 1, N at most 2^20.
        normals: (N, 3) unit normals.
        residuals: (N,) residuals along the normals, in the unit of the positions.

    Returns:
        Moments (4, 84, 6) and scores (5, 20, 3) as from `normal_equations`, as digits, see `value_of_digits`.
    """
    moments = np.zeros((3, len(_PRODUCTS), 6), np.int64)
    scores = np.zeros((4, len(EXPONENTS), 3), np.int64)
    places, normals, residuals = map(np.ascontiguousarray, (places, normals, residuals))
    _core.whole_normal_equations(places, normals, residuals, np.array(_RECURRENCE), moments, scores)
    return _carried(moments), _carried(scores)


def _carried(sums: IntArray) -> IntArray:
    """Return sums (D, ...) with one digit more; all but the last lie below the base, so that billions can be added."""
    digits = np.concatenate([sums, np.zeros_like(sums[:1])])
    for k in range(len(sums)):
        digits[k + 1] += digits[k] >> _DIGIT_BITS
        digits[k] &= (1 << _DIGIT_BITS) - 1
    return digits


def value_of_digits(digits: IntArray) -> FloatArray:
    """Return the values (...) of sums in units of 2^-80, or of sums of these, from their digits (D, ...) of base 2^20.

    The lowest digit is the first one.
    """
    total = sum(digit.astype(object) << _DIGIT_BITS * power for power, digit in enumerate(digits))
    values: FloatArray = np.asarray(total / (1 << 4 * _DIGIT_BITS)).astype(np.float64)
    return values


def normal_matrix(moments: FloatArray) -> FloatArray:
    """Assemble the normal matrix (..., 60, 60) from moments (..., 84, 6)."""
    blocks = moments[..., _PRODUCT_INDEX[:, :, None, None], _SYMMETRIC_INDEX[None, None]]  # (..., 20, 20, 3, 3)
    size = 3 * len(EXPONENTS)
    matrix: FloatArray = np.swapaxes(blocks, -3, -2).reshape(*moments.shape[:-2], size, size)
    return matrix


def translation_columns(moments: FloatArray) -> FloatArray:
    """Return the columns (..., 60, 3) of `normal_matrix` for a common translation."""
    blocks = moments[..., _PRODUCT_INDEX[:, 0, None, None], _SYMMETRIC_INDEX[None]]  # (..., 20, 3, 3)
    columns: FloatArray = blocks.reshape(*moments.shape[:-2], 3 * len(EXPONENTS), 3)
    return columns


def form_of_moments(coefficients: FloatArray) -> FloatArray:
    """Return (84, 6) factors of moments whose sum of products is the quadratic form of `normal_matrix` at (60,)."""
    field = coefficients.reshape(len(EXPONENTS), 3)
    factors = np.zeros((len(_PRODUCTS), 6))
    where = _PRODUCT_INDEX[:, :, None, None], _SYMMETRIC_INDEX[None, None]
    np.add.at(factors, where, field[:, None, :, None] * field[None, :, None, :])
    return factors


def gram_matrix(moments: FloatArray) -> FloatArray:
    """Return the Gram matrix (20, 20) of the monomials, sums of w phi_a phi_b, using that n n' has trace one."""
    sums: FloatArray = moments[:, :3].sum(axis=1)[_PRODUCT_INDEX]
    return sums


def mean_squared_gradients(squares: FloatArray) -> FloatArray:
    """Return (20,) mean squared gradients of the monomials, from their (20, 20) mean products."""
    gradients: FloatArray = (np.square(EXPONENTS) * np.diag(squares)[_DERIVATIVES]).sum(axis=1)
    return gradients


def model_columns(model: str) -> FloatArray:
    """Return (60, P) coefficients of the fields that span a model.

    Rotations are linearised (e x x), which suffices for a pair that is nearly registered.
    """
    size = 3 * len(EXPONENTS)
    if model not in ("rigid", "similarity"):
        return np.eye(size)[:, : PARAMETERS[model]]
    linear = {axis: 3 * EXPONENTS.tolist().index(np.eye(3, dtype=int)[axis].tolist()) for axis in range(3)}
    columns = [*np.eye(size)[:3]]
    for i, j in ((1, 2), (2, 0), (0, 1)):
        turn = np.zeros(size)
        turn[linear[i] + j], turn[linear[j] + i] = 1.0, -1.0
        columns.append(turn)
    if model == "similarity":
        grow = np.zeros(size)
        for axis in range(3):
            grow[linear[axis] + axis] = 1.0
        columns.append(grow)
    return np.stack(columns, axis=1)


def mean_and_spread(moments: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mean position (..., 3) and mean squared distance from it (...,) of the pairs in moments (..., 84, 6)."""
    sums = moments[..., :3].sum(axis=-1)
    weight = np.maximum(sums[..., 0], 1e-300)
    axes = np.eye(3, dtype=int)
    mean = np.stack([sums[..., _MONOMIAL_INDEX[tuple(axis.tolist())]] / weight for axis in axes], axis=-1)
    squares = sum(sums[..., _MONOMIAL_INDEX[tuple((2 * axis).tolist())]] for axis in axes) / weight
    return mean, np.maximum(squares - np.square(mean).sum(axis=-1), 0.0)
