"""How fields and noise show in the sums: models, what can be seen of them, and the noise's covariance."""

from __future__ import annotations

import math
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.deformation.nnls import nonnegative_least_squares
from pcbench.deformation.polynomials import (
    EXPONENTS,
    MODELS,
    PARAMETERS,
    derivative_squares,
    gram,
    mean_and_spread,
    model_columns,
    normal_matrix,
    translation_columns,
)
from pcbench.deformation.sums import LENGTHS, TileSums, added, merged
from pcbench.geometry.arrays import FloatArray

TILE = 2  # cells along each edge of a tile
# Information of a field against that of one seen along its direction everywhere: below it, where the noise of normals
# lies, the field is not observable.
MIN_INFORMATION = 0.02
_MIN_INFORMATION_AFFINE = 1e-4  # of an affine field and less
_RIDGE = 1e-12
_CELLS_AT_ONCE = 32  # whose matrices are made: they are much larger than the moments they are made of
PLACE_NOISE = 100 / MIN_INFORMATION  # a coordinate has to vary by ten standard deviations of the noise
_LAGS = (-1.0, 0.0, 1.3, 2.1, 3.3, 5.0)  # distances of cells, in cells, between which moments are taken


class Noise(NamedTuple):
    """Variances of the residuals where noise has its mean size: white, and of each kernel's component (lengths in the
    clouds' unit).
    """

    white: float
    components: FloatArray  # (J,)
    lengths: FloatArray  # (J,)

    @property
    def correlated(self) -> float:
        return float(self.components.sum())

    @property
    def correlation_length(self) -> float:
        """The Gaussian kernel exp(-d^2 / 2 l^2) that covers the same area as the mixture: 2 pi l^2."""
        if self.correlated == 0:
            return 0.0
        return math.sqrt(float(self.components @ np.square(self.lengths)) / self.correlated)


class ModelStep:
    """What a model explains beyond a smaller one: orthonormal modes of the information that the smaller leaves."""

    def __init__(self, geometry: Geometry, smaller: str, larger: str) -> None:
        large, matrix = geometry.columns[larger], geometry.matrix
        self.smaller = geometry.half(smaller)
        taken = matrix @ self.smaller @ self.smaller.T
        values, vectors = geometry.observable(large.T @ (matrix - taken @ matrix) @ large, MIN_INFORMATION)
        # Scores (60,) to modes (K,): variance sigma^2 each for white noise. Coefficients of a mode: the same columns.
        self.modes = (np.eye(len(matrix)) - taken).T @ large @ (vectors / np.sqrt(values))
        # (C, 3, K) what noise that is the same in a whole cell adds to the modes, and (K, K) what white noise does.
        self.responses = np.einsum("ik,cij->cjk", self.modes, geometry.loads, optimize=True)
        self.white = self.modes.T @ geometry.white @ self.modes


class Geometry:
    """All that does not depend on the residuals: models, what can be seen, and how noise of each kernel would show."""

    def __init__(self, sums: TileSums) -> None:
        total = sums.moments.sum(axis=0)
        squares = gram(total)
        self.total = float(squares[0, 0])  # weight of all pairs
        # Polynomials that are orthonormal over the pairs, but for those that the noise of the places could make up:
        # their size is kept small, so that they count as not observable. A plane's third coordinate is its noise, and
        # noise that is in places and residuals alike looks like a slope.
        squares = squares / self.total
        power, weight = sums.powers[0], sums.dyadic[0, 0]
        doubt = PLACE_NOISE * power / max(weight, 1e-300) / sums.radius**2 * derivative_squares(squares)
        factor = np.linalg.cholesky(squares + np.diag(doubt + _RIDGE))
        self.to_orthonormal = np.linalg.inv(factor)  # (20, 20)
        self.basis = np.kron(self.to_orthonormal, np.eye(3))
        self.matrix = self.basis @ normal_matrix(total) @ self.basis.T
        coefficients = np.kron(factor.T, np.eye(3))
        self.dome = coefficients @ _dome()
        self.columns = {model: np.linalg.qr(coefficients @ model_columns(model))[0] for model in MODELS}
        self.translations = np.einsum("ij,cjk->cik", self.basis, translation_columns(sums.moments), optimize=True)
        self.loads = np.einsum("ij,cjk->cik", self.basis, translation_columns(sums.loads), optimize=True)
        self.white = self.basis @ normal_matrix(sums.white.sum(axis=0)) @ self.basis.T
        self.white_translations = np.einsum("ij,cjk->cik", self.basis, translation_columns(sums.white), optimize=True)
        self.information = translation_columns(sums.moments)[:, :3]  # (C, 3, 3) sums of w n n'
        self.white_information = translation_columns(sums.white)[:, :3]  # of (w s)^2 n n'
        self.load = translation_columns(sums.loads)[:, :3]  # of w s n n'
        self.weights: FloatArray = np.trace(self.information, axis1=1, axis2=2)  # (C,) of the pairs in each
        self.side, self.radius, self.center = sums.side, sums.radius, sums.center
        self.dyadic = sums.dyadic
        self.surface = self.basis @ normal_matrix(sums.surface / gram(sums.surface)[0, 0]) @ self.basis.T
        mean, spread = mean_and_spread(sums.moments)
        self.means = mean * sums.radius + sums.center  # (C, 3)
        # Across a surface patch in a cell: two directions, each spread like an interval of at most the cell's edge.
        within = np.minimum(spread * sums.radius**2 / 2, sums.side**2 / 12)
        self._apart = _squared_distances(self.means)
        self._within = within[:, None] + within[None]
        self.lengths = sums.side * np.array(LENGTHS)
        self._near = sums.near / np.maximum(np.square(self.load).sum(axis=(1, 2)), 1e-300)[:, None]
        self.cell_matrices = np.empty((len(sums.moments), *self.basis.shape))
        for start in range(0, len(sums.moments), _CELLS_AT_ONCE):
            few = slice(start, start + _CELLS_AT_ONCE)
            self.cell_matrices[few] = self.basis @ normal_matrix(sums.moments[few]) @ self.basis.T
        self.tiles = merged(sums.cells, TILE)  # (C,)
        self.tile_matrices = added(self.cell_matrices, self.tiles)
        self._steps: dict[tuple[str, str], ModelStep] = {}
        self._halves: dict[str, FloatArray] = {}
        self._mixed: tuple[Noise, FloatArray] | None = None

    @cached_property
    def kernels(self) -> list[FloatArray]:
        """(C, C) correlation of each kernel between cells: averaged over the patches in two cells, and over the very
        pairs within one.
        """
        found = []
        for length, near in zip(self.lengths, self._near.T, strict=True):
            squared = length**2 + self._within
            kernel = length**2 / squared * np.exp(-self._apart / (2 * squared))
            np.fill_diagonal(kernel, near)
            found.append(kernel)
        return found

    def mixture(self, noise: Noise) -> FloatArray:
        """(C, C) covariance of the correlated noise between the means of cells."""
        if self._mixed is None or self._mixed[0] is not noise:
            total: FloatArray = np.zeros(self._apart.shape)
            for variance, kernel in zip(noise.components, self.kernels, strict=True):
                if variance > 0:
                    total += variance * kernel
            self._mixed = noise, total
        return self._mixed[1]

    def covariance(self, step: ModelStep, noise: Noise) -> FloatArray:
        """(K, K) of a step's modes under a noise: responses of each two cells times the covariance between them."""
        responses, size = step.responses, step.modes.shape[1]
        if size == 0:
            return np.zeros((0, 0))
        spread = self.mixture(noise) @ responses.reshape(len(responses), -1)
        correlated: FloatArray = responses.reshape(-1, size).T @ spread.reshape(-1, size)
        total: FloatArray = noise.white * step.white + correlated
        return total

    def step(self, smaller: str, larger: str) -> ModelStep:
        if (smaller, larger) not in self._steps:
            self._steps[smaller, larger] = ModelStep(self, smaller, larger)
        return self._steps[smaller, larger]

    def observable(self, matrix: FloatArray, least: float) -> tuple[FloatArray, FloatArray]:
        """Eigenvalues and vectors of a part of the normal matrix, of those with more than a share of information."""
        values, vectors = np.linalg.eigh(0.5 * (matrix + matrix.T))
        enough = values > least * self.total
        return values[enough], vectors[:, enough]

    def half(self, model: str) -> FloatArray:
        """(60, K) observable fields of a model, with unit information each and none in common.

        Of an affine field and less, all that is observable in the least: what is there and not modelled would look
        bent.
        """
        if model not in self._halves:
            if PARAMETERS[model] > PARAMETERS["affine"]:
                self._halves[model] = np.hstack([self.half("affine"), self.step("affine", model).modes])
            else:
                columns = self.columns[model]
                values, vectors = self.observable(columns.T @ self.matrix @ columns, _MIN_INFORMATION_AFFINE)
                self._halves[model] = columns @ (vectors / np.sqrt(values))
        return self._halves[model]

    def over_surface(self, step: ModelStep) -> FloatArray:
        """(K, K) the mean square along the normals, over the surface by its area, of what a step's modes show there
        beyond an affine field.
        """
        affine = self.columns["affine"]
        crossed = self.surface @ affine
        taken = crossed @ np.linalg.pinv(affine.T @ crossed, rcond=_RIDGE, hermitian=True) @ crossed.T
        form: FloatArray = step.modes.T @ (self.surface - taken) @ step.modes
        return form

    def fit(self, model: str, scores: FloatArray) -> FloatArray:
        """(60,) coefficients of a model, of what is observable, by least squares."""
        half = self.half(model)
        coefficients: FloatArray = half @ (half.T @ scores)
        return coefficients

    def explained(self, scores: Scores, model: str) -> float:
        """Sum of w (n . u)^2 of what a model fits."""
        return float(scores.total @ self.fit(model, scores.total))

    @cached_property
    def noise_design(self) -> tuple[FloatArray, list[NDArray[np.bool_]], FloatArray]:
        """Expected moments of the largest model's residuals by white noise and by each kernel.

        A residual vector of a cell is h_c = sum w n r less what the fit explains. Noise that is g_c in each cell adds
        L_c g_c, of which Z_c' A^+ sum_d Y_d g_d is explained (L: `load`, Y: `loads`, Z: `translations`). Expected
        products over a class D of pairs of cells, sum_D h_c . h_d, are traces of products of these.

        Returns:
            (lags, 1 + J) expectations for unit variances, the (C, C) masks, and (J,) the share of each kernel's
            power within cells that the fit leaves.
        """
        count = len(self.information)
        inverse = self.half("cubic") @ self.half("cubic").T
        z = self.translations.transpose(0, 2, 1)  # (C, 3, 60)
        q = (self.loads.transpose(0, 2, 1).reshape(-1, z.shape[2]) @ inverse).reshape(z.shape)
        white = (self.white_translations.transpose(0, 2, 1).reshape(-1, z.shape[2]) @ inverse).reshape(z.shape)
        spread = inverse @ self.white @ inverse
        load = self.load
        squares = load.reshape(count, 9) @ load.reshape(count, 9).T
        apart = np.sqrt(self._apart) / self.side
        np.fill_diagonal(apart, 0.0)
        rows, masks = [], []
        kept = np.ones(len(self.lengths))
        for low, high in pairwise(_LAGS):
            mask = ((apart > low) & (apart <= high)).astype(np.float64)
            dz = (mask @ z.reshape(count, -1)).reshape(z.shape)
            inner = z.reshape(-1, z.shape[2]).T @ dz.reshape(-1, z.shape[2])
            half = np.einsum("cij,cje->cie", load, dz) - 0.5 * q @ inner
            taken = half.reshape(count, -1) @ q.reshape(count, -1).T
            product = mask * squares - taken - taken.T
            own = float(np.diag(mask) @ np.trace(self.white_information, axis1=1, axis2=2))
            by_white = own - 2 * float((dz * white).sum()) + float((inner * spread).sum())
            rows.append([by_white, *(float(np.einsum("cd,cd->", product, kernel)) for kernel in self.kernels)])
            if low < 0:
                within = [float(np.diag(squares) @ np.diag(kernel)) for kernel in self.kernels]
                kept = np.array(rows[0][1:]) / np.maximum(within, 1e-300)
            masks.append(mask > 0)
        return np.array(rows), masks, kept


class Scores:
    """The residuals' part of the sums, in the geometry's coordinates."""

    def __init__(self, geometry: Geometry, scores: FloatArray, energy: FloatArray, powers: FloatArray) -> None:
        rows = np.einsum("ab,cbk->cak", geometry.to_orthonormal, scores)
        self.cells: FloatArray = rows.reshape(len(scores), -1)  # (C, 60)
        self.total: FloatArray = self.cells.sum(axis=0)
        self.translations: FloatArray = scores[:, 0]  # (C, 3) sums of w n r
        self.energy = energy  # (C,)
        self.powers = powers  # of sub-cells


def estimate_noise(geometry: Geometry, scores: Scores) -> Noise:
    """Variances of white noise and of the kernels, by least squares on moments of the largest model's residuals."""
    expected, masks, kept = geometry.noise_design
    coefficients = geometry.fit("cubic", scores.total)
    left = scores.translations - np.einsum("cik,i->ck", geometry.translations, coefficients)
    products = left @ left.T
    power = np.square(left).sum(axis=1)
    rows, values, sigmas = [], [], []
    for row, mask in zip(expected, masks, strict=True):
        rows.append(row)
        values.append(float((mask * products).sum()))
        # Products of independent vectors scatter by the product of their lengths.
        sigmas.append(math.sqrt(2 * float(power @ mask @ power) / 3))
    for row, power_within in zip(geometry.dyadic, scores.powers, strict=True):
        rows.append(np.concatenate([row[:1], row[1:] * kept]))
        values.append(float(power_within))
        sigmas.append(0.05 * float(power_within))  # of many sub-cells, but long noise is the same in many of them
    scale = 1 / np.maximum(sigmas, 1e-300)
    found = nonnegative_least_squares(np.array(rows) * scale[:, None], np.array(values) * scale)
    return Noise(float(found[0]), found[1:], geometry.lengths)


def _dome() -> FloatArray:
    """(60,) coefficients of the vertical displacement x^2 + y^2."""
    coefficients = np.zeros((len(EXPONENTS), 3))
    for powers in ([2, 0, 0], [0, 2, 0]):
        coefficients[EXPONENTS.tolist().index(powers), 2] = 1.0
    return coefficients.ravel()


def _squared_distances(points: FloatArray) -> FloatArray:
    total = np.zeros((len(points), len(points)))
    for axis in range(3):
        total += np.square(points[:, axis, None] - points[None, :, axis])
    return total
