"""Displacement fields that are fitted while pairs are found, and projection on a known field."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from pcbench.deformation.model import POSITION_NOISE
from pcbench.deformation.polynomials import EXPONENTS, derivative_squares, monomials, normal_equations, normal_matrix
from pcbench.geometry.arrays import FloatArray

_HALF_INFORMATION = 0.01  # relative information (at most 1) of a field that is fitted with half its amplitude
_RIDGE = 1e-12


class Displacement(NamedTuple):
    """A cubic displacement field, constant beyond `radius` from the centre along each axis.

    Attributes:
        coefficients: (20, 3) coefficients of the monomials.
        center: (3,) centre of the scene.
        radius: half the extent.
    """

    coefficients: FloatArray
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
        half_information: float = _HALF_INFORMATION,
    ) -> Displacement:
        """Return the field that explains residuals along normals, by weighted and regularised least squares.

        Fields with little information are damped. Information is relative to the field's size at all positions,
        whatever their weight: otherwise a field could grow where a forest has no weight, and its closest points would
        seem to confirm it. A coordinate that hardly varies more than the noise, which affects positions and residuals,
        gives no slope.

        Args:
            places: (N, 3) positions.
            normals: (N, 3) unit normals.
            residuals: (N,) residuals along the normals.
            weights: (N,) weights.
            noise: standard deviation of the residuals.
            half_information: relative information at which half of the amplitude is fitted.
        """
        x = self._inside(places)
        moments, scores = (sums[0] for sums in normal_equations(x, normals, weights, residuals))
        values = monomials(x)
        squares = np.einsum("an,bn->ab", values, values, optimize=False) / len(x)
        squares += np.diag(POSITION_NOISE * (noise / self.radius) ** 2 * derivative_squares(squares))
        to_orthonormal = np.linalg.inv(np.linalg.cholesky(squares + _RIDGE * np.eye(len(squares))))
        basis = np.kron(to_orthonormal, np.eye(3))
        information, fields = np.linalg.eigh(basis @ normal_matrix(moments) @ basis.T / weights.sum())
        along = fields.T @ (basis @ scores.ravel()) / weights.sum()
        solution = fields @ (information / (np.square(information) + half_information**2) * along)
        return self._replace(coefficients=(basis.T @ solution).reshape(-1, 3))

    def _inside(self, places: FloatArray) -> FloatArray:
        inside: FloatArray = np.clip((places - self.center) / self.radius, -1, 1)
        return inside


def projected_share(
    places: FloatArray, normals: FloatArray, residuals: FloatArray, weights: FloatArray, bend: FloatArray, gauge: str
) -> tuple[float, float]:
    """Return the share of a known displacement that the residuals contain beyond a motion of the gauge, and its RMS.

    Args:
        places: (N, 3) positions.
        normals: (N, 3) unit normals.
        residuals: (N,) residuals along the normals.
        weights: (N,) weights.
        bend: (N,) the known displacement along the normals.
        gauge: "similarity", or anything else for a rigid motion.
    """
    x = places - np.average(places, axis=0, weights=weights)
    columns = [*normals.T, *np.cross(x, normals).T]
    if gauge == "similarity":
        columns.append(np.einsum("ni,ni->n", x, normals))
    matrix = np.stack(columns, axis=1) * np.sqrt(weights)[:, None]
    known, observed = bend * np.sqrt(weights), residuals * np.sqrt(weights)
    known = known - matrix @ np.linalg.lstsq(matrix, known, rcond=1e-6)[0]
    power = float(known @ known)
    return float(known @ observed) / max(power, 1e-300), math.sqrt(power / float(weights.sum()))
