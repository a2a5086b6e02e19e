"""Models of displacement, their observable fields, and the covariance of the noise, from the sums over cells."""

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
from pcbench.deformation.sums import LENGTHS, TileSums, sum_over_tiles, tiles_of_cells
from pcbench.geometry.arrays import FloatArray

TILE = 2  # cells along each edge of a tile
# Information of an observable field, relative to a field along the normals everywhere; noise of normals stays below.
MIN_INFORMATION = 0.02
_MIN_INFORMATION_AFFINE = 1e-4  # for affine and simpler fields
_RIDGE = 1e-12
_CELLS_PER_BATCH = 32  # their matrices are much larger than their moments
POSITION_NOISE = 100 / MIN_INFORMATION  # a coordinate must vary by ten standard deviations of the noise
_LAGS = (-1.0, 0.0, 1.3, 2.1, 3.3, 5.0)  # limits of the classes of distances between cells, in cells


class Noise(NamedTuple):
    """Variances of the noise at its mean size.

    Attributes:
        white: variance of the white noise.
        components: (J,) variance of each kernel's component.
        lengths: (J,) lengths of the kernels, in the clouds' unit.
    """

    white: float
    components: FloatArray
    lengths: FloatArray

    @property
    def correlated(self) -> float:
        """Variance of the correlated noise."""
        return float(self.components.sum())

    @property
    def correlation_length(self) -> float:
        """Length l of the Gaussian kernel exp(-d^2 / 2 l^2) with the same integral as the mixture, 2 pi l^2."""
        if self.correlated == 0:
            return 0.0
        return math.sqrt(float(self.components @ np.square(self.lengths)) / self.correlated)


class ModelStep:
    """The fields of a model beyond a smaller model, as orthonormal modes of the remaining information.

    Attributes:
        smaller: (60, M) observable fields of the smaller model.
        modes: (60, K) maps scores (60,) to modes (K,), each of variance sigma^2 for white noise; also the coefficients
            of each mode.
        responses: (C, 3, K) response of the modes to noise that is constant in a cell.
        white: (K, K) covariance of the modes for unit white noise.
    """

    def __init__(self, geometry: Geometry, smaller: str, larger: str) -> None:
        large, matrix = geometry.columns[larger], geometry.matrix
        self.smaller = geometry.fields(smaller)
        projection = matrix @ self.smaller @ self.smaller.T
        values, vectors = geometry.observable(large.T @ (matrix - projection @ matrix) @ large, MIN_INFORMATION)
        self.modes = (np.eye(len(matrix)) - projection).T @ large @ (vectors / np.sqrt(values))
        self.responses = np.einsum("ik,cij->cjk", self.modes, geometry.loads, optimize=True)
        self.white = self.modes.T @ geometry.white @ self.modes


class Geometry:
    """The part of the sums that does not depend on the residuals: models, observability, and responses to noise."""

    def __init__(self, sums: TileSums) -> None:
        total = sums.moments.sum(axis=0)
        squares = gram(total)
        self.total = float(squares[0, 0])  # weight of all pairs
        # Polynomials that are orthonormal over the pairs. Those that noise of the positions could produce are damped,
        # so that they count as unobservable: the third coordinate of a plane is noise, and noise that affects positions
        # and residuals looks like a slope.
        squares = squares / self.total
        power, weight = sums.powers[0], sums.dyadic[0, 0]
        damping = POSITION_NOISE * power / max(weight, 1e-300) / sums.radius**2 * derivative_squares(squares)
        factor = np.linalg.cholesky(squares + np.diag(damping + _RIDGE))
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
        self.white_information = translation_columns(sums.white)[:, :3]  # sums of (w s)^2 n n'
        self.load = translation_columns(sums.loads)[:, :3]  # sums of w s n n'
        self.weights: FloatArray = np.trace(self.information, axis1=1, axis2=2)  # (C,) weight of the pairs in each cell
        self.side, self.radius, self.center = sums.side, sums.radius, sums.center
        self.dyadic = sums.dyadic
        self.surface = self.basis @ normal_matrix(sums.surface / gram(sums.surface)[0, 0]) @ self.basis.T
        mean, spread = mean_and_spread(sums.moments)
        self.means = mean * sums.radius + sums.center  # (C, 3)
        # A surface patch in a cell extends in two directions, each with at most the variance of an interval of its
        # edge.
        within = np.minimum(spread * sums.radius**2 / 2, sums.side**2 / 12)
        self._squared_distances = _squared_distances(self.means)
        self._within = within[:, None] + within[None]
        self.lengths = sums.side * np.array(LENGTHS)
        self._near = sums.near / np.maximum(np.square(self.load).sum(axis=(1, 2)), 1e-300)[:, None]
        self.cell_matrices = np.empty((len(sums.moments), *self.basis.shape))
        for start in range(0, len(sums.moments), _CELLS_PER_BATCH):
            batch = slice(start, start + _CELLS_PER_BATCH)
            self.cell_matrices[batch] = self.basis @ normal_matrix(sums.moments[batch]) @ self.basis.T
        self.tiles = tiles_of_cells(sums.cells, TILE)  # (C,)
        self.tile_matrices = sum_over_tiles(self.cell_matrices, self.tiles)
        self._steps: dict[tuple[str, str], ModelStep] = {}
        self._fields: dict[str, FloatArray] = {}
        self._mixed: tuple[Noise, FloatArray] | None = None

    @cached_property
    def kernels(self) -> list[FloatArray]:
        """Correlation (C, C) of each kernel between cells.

        It is averaged over the patches of two cells, and over the actual pairs within one cell.
        """
        kernels = []
        for length, near in zip(self.lengths, self._near.T, strict=True):
            squared = length**2 + self._within
            kernel = length**2 / squared * np.exp(-self._squared_distances / (2 * squared))
            np.fill_diagonal(kernel, near)
            kernels.append(kernel)
        return kernels

    def mixture(self, noise: Noise) -> FloatArray:
        """Return the covariance (C, C) of the correlated noise between cell means."""
        if self._mixed is None or self._mixed[0] is not noise:
            total: FloatArray = np.zeros(self._squared_distances.shape)
            for variance, kernel in zip(noise.components, self.kernels, strict=True):
                if variance > 0:
                    total += variance * kernel
            self._mixed = noise, total
        return self._mixed[1]

    def covariance(self, step: ModelStep, noise: Noise) -> FloatArray:
        """Return the covariance (K, K) of a step's modes under a noise, from the responses of the cells."""
        responses, size = step.responses, step.modes.shape[1]
        if size == 0:
            return np.zeros((0, 0))
        spread = self.mixture(noise) @ responses.reshape(len(responses), -1)
        correlated: FloatArray = responses.reshape(-1, size).T @ spread.reshape(-1, size)
        total: FloatArray = noise.white * step.white + correlated
        return total

    def step(self, smaller: str, larger: str) -> ModelStep:
        """Return the step from a smaller to a larger model; steps are cached."""
        if (smaller, larger) not in self._steps:
            self._steps[smaller, larger] = ModelStep(self, smaller, larger)
        return self._steps[smaller, larger]

    def observable(self, matrix: FloatArray, min_information: float) -> tuple[FloatArray, FloatArray]:
        """Return the eigenvalues and eigenvectors of a part of the normal matrix that have enough information."""
        values, vectors = np.linalg.eigh(0.5 * (matrix + matrix.T))
        is_observable = values > min_information * self.total
        return values[is_observable], vectors[:, is_observable]

    def fields(self, model: str) -> FloatArray:
        """Return the observable fields (60, K) of a model, orthonormal in the information.

        For affine and simpler models the limit of observability is lower: an unmodelled affine part would look like a
        non-affine deformation.
        """
        if model not in self._fields:
            if PARAMETERS[model] > PARAMETERS["affine"]:
                self._fields[model] = np.hstack([self.fields("affine"), self.step("affine", model).modes])
            else:
                columns = self.columns[model]
                values, vectors = self.observable(columns.T @ self.matrix @ columns, _MIN_INFORMATION_AFFINE)
                self._fields[model] = columns @ (vectors / np.sqrt(values))
        return self._fields[model]

    def over_surface(self, step: ModelStep) -> FloatArray:
        """Return the quadratic form (K, K) of the area-weighted mean square of a step's modes beyond affine."""
        affine = self.columns["affine"]
        mixed = self.surface @ affine
        projection = mixed @ np.linalg.pinv(affine.T @ mixed, rcond=_RIDGE, hermitian=True) @ mixed.T
        form: FloatArray = step.modes.T @ (self.surface - projection) @ step.modes
        return form

    def fit(self, model: str, scores: FloatArray) -> FloatArray:
        """Return the least-squares coefficients (60,) of a model's observable fields."""
        fields = self.fields(model)
        coefficients: FloatArray = fields @ (fields.T @ scores)
        return coefficients

    def explained(self, scores: Scores, model: str) -> float:
        """Return the sum of w (n . u)^2 that a model explains."""
        return float(scores.total @ self.fit(model, scores.total))

    @cached_property
    def noise_design(self) -> tuple[FloatArray, list[NDArray[np.bool_]], FloatArray]:
        """Expected moments of the largest model's residuals for white noise and for each kernel.

        The residual vector of a cell is h_c = sum w n r minus the fitted part. Noise g_c in each cell contributes
        L_c g_c, of which the fit explains Z_c' A^+ sum_d Y_d g_d (L: `load`, Y: `loads`, Z: `translations`). Expected
        products over a class D of pairs of cells, sum_D h_c . h_d, are traces of products of these.

        Returns:
            Expectations (lags, 1 + J) for unit variances, the masks (C, C) of the classes, and the share (J,) of each
            kernel's power within cells that remains after the fit.
        """
        count = len(self.information)
        inverse = self.fields("cubic") @ self.fields("cubic").T
        z = self.translations.transpose(0, 2, 1)  # (C, 3, 60)
        q = (self.loads.transpose(0, 2, 1).reshape(-1, z.shape[2]) @ inverse).reshape(z.shape)
        white = (self.white_translations.transpose(0, 2, 1).reshape(-1, z.shape[2]) @ inverse).reshape(z.shape)
        spread = inverse @ self.white @ inverse
        load = self.load
        squares = load.reshape(count, 9) @ load.reshape(count, 9).T
        lags = np.sqrt(self._squared_distances) / self.side
        np.fill_diagonal(lags, 0.0)
        rows, masks = [], []
        remaining_share = np.ones(len(self.lengths))
        for low, high in pairwise(_LAGS):
            mask = ((lags > low) & (lags <= high)).astype(np.float64)
            dz = (mask @ z.reshape(count, -1)).reshape(z.shape)
            inner = z.reshape(-1, z.shape[2]).T @ dz.reshape(-1, z.shape[2])
            half = np.einsum("cij,cje->cie", load, dz) - 0.5 * q @ inner
            explained = half.reshape(count, -1) @ q.reshape(count, -1).T
            product = mask * squares - explained - explained.T
            own = float(np.diag(mask) @ np.trace(self.white_information, axis1=1, axis2=2))
            by_white = own - 2 * float((dz * white).sum()) + float((inner * spread).sum())
            rows.append([by_white, *(float(np.einsum("cd,cd->", product, kernel)) for kernel in self.kernels)])
            if low < 0:
                within = [float(np.diag(squares) @ np.diag(kernel)) for kernel in self.kernels]
                remaining_share = np.array(rows[0][1:]) / np.maximum(within, 1e-300)
            masks.append(mask > 0)
        return np.array(rows), masks, remaining_share


class Scores:
    """The part of the sums that depends on the residuals, in the basis of the geometry.

    Attributes:
        cells: (C, 60) scores of the cells.
        total: (60,) their sum.
        translations: (C, 3) sums of w n r.
        energy: (C,) sums of w r^2.
        powers: (levels,) powers of the sub-cells.
    """

    def __init__(self, geometry: Geometry, scores: FloatArray, energy: FloatArray, powers: FloatArray) -> None:
        rows = np.einsum("ab,cbk->cak", geometry.to_orthonormal, scores)
        self.cells: FloatArray = rows.reshape(len(scores), -1)
        self.total: FloatArray = self.cells.sum(axis=0)
        self.translations: FloatArray = scores[:, 0]
        self.energy = energy
        self.powers = powers


def estimate_noise(geometry: Geometry, scores: Scores) -> Noise:
    """Estimate the variances of white noise and of the kernels, by least squares on moments of the residuals."""
    expected, masks, remaining_share = geometry.noise_design
    coefficients = geometry.fit("cubic", scores.total)
    residual = scores.translations - np.einsum("cik,i->ck", geometry.translations, coefficients)
    products = residual @ residual.T
    power = np.square(residual).sum(axis=1)
    rows, values, sigmas = [], [], []
    for row, mask in zip(expected, masks, strict=True):
        rows.append(row)
        values.append(float((mask * products).sum()))
        # The standard deviation of the product of independent vectors is the product of their lengths.
        sigmas.append(math.sqrt(2 * float(power @ mask @ power) / 3))
    for row, power_within in zip(geometry.dyadic, scores.powers, strict=True):
        rows.append(np.concatenate([row[:1], row[1:] * remaining_share]))
        values.append(float(power_within))
        sigmas.append(
            0.05 * float(power_within)
        )  # there are many sub-cells, but noise of long correlation is shared by many
    scale = 1 / np.maximum(sigmas, 1e-300)
    variances = nonnegative_least_squares(np.array(rows) * scale[:, None], np.array(values) * scale)
    return Noise(float(variances[0]), variances[1:], geometry.lengths)


def _dome() -> FloatArray:
    """Return the coefficients (60,) of the vertical displacement x^2 + y^2."""
    coefficients = np.zeros((len(EXPONENTS), 3))
    for powers in ([2, 0, 0], [0, 2, 0]):
        coefficients[EXPONENTS.tolist().index(powers), 2] = 1.0
    return coefficients.ravel()


def _squared_distances(points: FloatArray) -> FloatArray:
    total = np.zeros((len(points), len(points)))
    for axis in range(3):
        total += np.square(points[:, axis, None] - points[None, :, axis])
    return total
