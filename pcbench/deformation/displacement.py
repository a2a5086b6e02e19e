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


class FieldFrame(NamedTuple):
    """Values that all fits of a displacement field to residuals at the same N positions use.

    Attributes:
        places: (N, 3) scaled positions.
        values: (20, N) their monomials.
        basis: (60, 60) from monomials to polynomials that are orthonormal over the positions, for three components.
    """

    places: FloatArray
    values: FloatArray
    basis: FloatArray


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
        return self.from_monomials(monomials(self._inside(places)))

    def from_monomials(self, values: FloatArray) -> FloatArray:
        """Return the displacements (N, 3) at positions whose monomials are `values` (20, N)."""
        field: FloatArray = values.T @ self.coefficients
        return field

    def frame(self, places: FloatArray, noise: float) -> FieldFrame:
        """Return the frame of fits to residuals at positions (N, 3), whose standard deviation is `noise`."""
        x = self._inside(places)
        values = monomials(x)
        squares = values @ values.T / len(x)
        squares += np.diag(POSITION_NOISE_FACTOR * (noise / self.radius) ** 2 * mean_squared_gradients(squares))
        to_orthonormal = np.linalg.inv(np.linalg.cholesky(squares + _RIDGE * np.eye(len(squares))))
        return FieldFrame(x, values, np.kron(to_orthonormal, np.eye(3)).astype(np.float64))

    def fit(
        self,
        frame: FieldFrame,
        normals: FloatArray,
        residuals: FloatArray,
        weights: FloatArray,
        half_damped_information: float = _HALF_DAMPED_INFORMATION,
    ) -> Displacement:
        """Fit the field to (N,) residuals along normals at the positions of a frame, by damped weighted least squares.

        Poorly determined parts are left out. Their information is relative to the field's size at all positions,
        whatever the weights: a field that is free where a forest has no weight would find pairs there that confirm it.
        A coordinate that varies hardly more than the noise of positions and residuals gives no slope. A part of
        information `half_damped_information` is damped to half.
        """
        moments, scores = (sums[0] for sums in normal_equations(frame.places, normals, weights, residuals))
        basis = frame.basis
        information = basis @ normal_matrix(moments) @ basis.T / weights.sum()
        # A part of information i is multiplied by i / (i^2 + h^2), the real part of 1 / (i + h sqrt(-1)).
        damped = information + 1j * half_damped_information * np.eye(len(information))
        solution = np.linalg.solve(damped, basis @ scores.ravel() / weights.sum()).real
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
