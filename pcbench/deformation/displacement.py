"""Displacement fields fitted during the search for pairs, and the projection onto a known field."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from pcbench.deformation.model import POSITION_NOISE_FACTOR
from pcbench.deformation.polynomials import (
    EXPONENTS,
    mean_squared_gradients,
    monomials,
    normal_equations,
    normal_matrix,
)
from pcbench.geometry.arrays import FloatArray

_HALF_DAMPED_INFORMATION = 0.01  # information, at most 1, at which the fit is damped to half
_RIDGE = 1e-12


class Displacement(NamedTuple):
    """A cubic displacement field (N, 3) at positions (N, 3), constant beyond `radius` from the centre on each axis."""

    coefficients: FloatArray  # (20, 3)
    center: FloatArray
    radius: float

    @classmethod
    def zero(cls, center: FloatArray, radius: float) -> Displacement:
        """Return the field without displacement."""
        return cls(np.zeros((len(EXPONENTS), 3)), center, radius)

    def __call__(self, places: FloatArray) -> FloatArray:
        """Return the displacements (N, 3) at positions (N, 3)."""
        field: FloatArray = np.einsum("an,ak->nk", monomials(self._inside(places)), self.coefficients)
        return field

    def fit(
        self,
        places: FloatArray,
        normals: FloatArray,
        residuals: FloatArray,
        weights: FloatArray,
        noise: float,
        half_damped_information: float = _HALF_DAMPED_INFORMATION,
    ) -> Displacement:
        """Fit the field to (N,) residuals along normals, by damped weighted least squares.

        Poorly determined parts are left out. Their information is relative to the field's size at all positions,
        whatever the weights: a field that is free where a forest has no weight would find pairs there that confirm it.
        A coordinate that varies hardly more than the `noise` of positions and residuals gives no slope. A part of
        information `half_damped_information` is damped to half.
        """
        x = self._inside(places)
        moments, scores = (sums[0] for sums in normal_equations(x, normals, weights, residuals))
        values = monomials(x)
        squares = np.einsum("an,bn->ab", values, values, optimize=False) / len(x)
        squares += np.diag(POSITION_NOISE_FACTOR * (noise / self.radius) ** 2 * mean_squared_gradients(squares))
        to_orthonormal = np.linalg.inv(np.linalg.cholesky(squares + _RIDGE * np.eye(len(squares))))
        basis = np.kron(to_orthonormal, np.eye(3))
        information, fields = np.linalg.eigh(basis @ normal_matrix(moments) @ basis.T / weights.sum())
        loads = fields.T @ (basis @ scores.ravel()) / weights.sum()
        solution = fields @ (information / (np.square(information) + half_damped_information**2) * loads)
        return self._replace(coefficients=(basis.T @ solution).reshape(-1, 3))

    def _inside(self, places: FloatArray) -> FloatArray:
        inside: FloatArray = np.clip((places - self.center) / self.radius, -1, 1)
        return inside


def projected_share(
    places: FloatArray,
    normals: FloatArray,
    residuals: FloatArray,
    weights: FloatArray,
    deformation: FloatArray,
    gauge: str,
) -> tuple[float, float]:
    """Return the share of a known deformation (N,) in the residuals along the normals, and its RMS.

    Both are taken after projecting out a motion of the gauge, rigid or similarity.
    """
    x = places - np.average(places, axis=0, weights=weights)
    columns = [*normals.T, *np.cross(x, normals).T]
    if gauge == "similarity":
        columns.append(np.einsum("ni,ni->n", x, normals))
    matrix = np.stack(columns, axis=1) * np.sqrt(weights)[:, None]
    expected, observed = deformation * np.sqrt(weights), residuals * np.sqrt(weights)
    expected = expected - matrix @ np.linalg.lstsq(matrix, expected, rcond=1e-6)[0]
    power = float(expected @ expected)
    return float(expected @ observed) / max(power, 1e-300), math.sqrt(power / float(weights.sum()))
