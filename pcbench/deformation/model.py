"""Geometry of the models (what is observable) and covariance of the noise, computed from the sums over cells."""

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
    form_of_moments,
    gram_matrix,
    mean_and_spread,
    mean_squared_gradients,
    model_columns,
    normal_matrix,
    translation_columns,
)
from pcbench.deformation.sums import KERNEL_LENGTHS, TileSums, sum_over_tiles, tile_of_cells
from pcbench.geometry.arrays import FloatArray, IntArray

TILE = 2  # cells along each edge of a tile
# Information of a field relative to one that is observed along its direction everywhere. Below this, which is the level
# of errors in the normals, a field counts as not observable.
MIN_INFORMATION = 0.02
_MIN_INFORMATION_AFFINE = 1e-4  # for affine fields and smaller models
_RIDGE = 1e-12
POSITION_NOISE_FACTOR = 100 / MIN_INFORMATION  # a coordinate has to vary by ten standard deviations of the noise
# Kinds of deformation whose detectable size is stated: powers of x, y and z by the axis of the displacement.
KINDS = {
    "dome": {"z": [(2, 0, 0), (0, 2, 0)]},
    "saddle": {"z": [(2, 0, 0)], "-z": [(0, 2, 0)]},
    "S-bend": {"z": [(3, 0, 0), (1, 2, 0)]},
    "twist": {"-x": [(1, 1, 0)], "y": [(2, 0, 0)]},
    "lean": {"x": [(0, 0, 2)]},
}
_MIN_EXPONENT = -700.0  # where exp is 1e-304: it takes three times as long where it underflows
_LAGS = (-1.0, 0.0, 1.3, 2.1, 3.3, 5.0)  # bounds of the lag classes, in cells; negative to 0: within a cell


class Noise(NamedTuple):
    """Variance components of the residuals at the mean scale of the noise: white, and one per kernel.

    Attributes:
        white: variance of the white noise.
        components: (J,) variance of each correlated component.
        lengths: (J,) length of each kernel, in the clouds' unit.
    """

    white: float
    components: FloatArray  # (J,)
    lengths: FloatArray  # (J,)

    @property
    def correlated(self) -> float:
        """Total variance of the correlated noise."""
        return float(self.components.sum())

    @property
    def correlation_length(self) -> float:
        """Length l of the Gaussian kernel exp(-d^2 / 2 l^2) with the same integral 2 pi l^2 as the mixture."""
        if self.correlated == 0:
            return 0.0
        return math.sqrt(float(self.components @ np.square(self.lengths)) / self.correlated)


class ModelStep:
    """Modes of a model beyond a smaller one, orthonormal with respect to the information the smaller one leaves."""

    def __init__(self, geometry: Geometry, smaller: str, larger: str) -> None:
        large, matrix = geometry.columns[larger], geometry.matrix
        self.smaller = geometry.half(smaller)
        taken = matrix @ self.smaller @ self.smaller.T
        values, vectors = geometry.observable_directions(large.T @ (matrix - taken @ matrix) @ large, MIN_INFORMATION)
        # (60, K) from scores to modes, each of variance sigma^2 under white noise; also the coefficients of the modes.
        self.modes = (np.eye(len(matrix)) - taken).T @ large @ (vectors / np.sqrt(values))
        # (C, 3, K) response of the modes to noise that is constant in a cell, and (K, K) covariance under white noise.
        self.responses = np.einsum("ik,cij->cjk", self.modes, geometry.loads, optimize=True)
        self.white = self.modes.T @ geometry.white @ self.modes
        self.covariance: tuple[Noise, FloatArray] | None = None  # (K, K) under a noise, see `Geometry.covariance`


class Geometry:
    """The part of the model that does not depend on the residuals: design, observability and noise kernels."""

    def __init__(self, sums: TileSums) -> None:
        total = sums.moments.sum(axis=0)
        squares = gram_matrix(total)
        self.total = float(squares[0, 0])  # weight of all pairs
        # Polynomials orthonormal over the pairs, except those that the noise of the positions could produce: they are
        # scaled down, so that they count as not observable. The third coordinate of a plane is pure noise, and noise
        # that positions and residuals share looks like a slope.
        squares = squares / self.total
        power, weight = sums.powers[0], sums.dyadic[0, 0]
        doubt = POSITION_NOISE_FACTOR * power / max(weight, 1e-300) / sums.radius**2 * mean_squared_gradients(squares)
        factor = np.linalg.cholesky(squares + np.diag(doubt + _RIDGE))
        self.to_orthonormal = np.linalg.inv(factor)  # (20, 20)
        self.basis = np.kron(self.to_orthonormal, np.eye(3))
        self.matrix = self.basis @ normal_matrix(total) @ self.basis.T
        coefficients = np.kron(factor.T, np.eye(3))
        self.kinds = {kind: coefficients @ _kind(terms) for kind, terms in KINDS.items()}
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
        self.surface = self.basis @ normal_matrix(sums.surface / gram_matrix(sums.surface)[0, 0]) @ self.basis.T
        mean, spread = mean_and_spread(sums.moments)
        self.means = mean * sums.radius + sums.center  # (C, 3)
        # A surface patch in a cell extends in two directions, each at most like a uniform interval of the cell's edge.
        within = np.minimum(spread * sums.radius**2 / 2, sums.side**2 / 12)
        self._apart = _squared_distances(self.means)
        self._within = within[:, None] + within[None]
        self.lengths = sums.side * np.array(KERNEL_LENGTHS)
        self._near = sums.near / np.maximum(np.square(self.load).sum(axis=(1, 2)), 1e-300)[:, None]
        self._moments = sums.moments
        self.tiles = tile_of_cells(sums.cells, TILE)  # (C,)
        self.tile_matrices = self.basis @ normal_matrix(sum_over_tiles(sums.moments, self.tiles)) @ self.basis.T
        self._steps: dict[tuple[str, str], ModelStep] = {}
        self._halves: dict[str, FloatArray] = {}
        self._mixed: tuple[Noise, FloatArray] | None = None

    def kernels(self, which: IntArray) -> FloatArray:
        """Correlations (K, C, C) of some kernels: averaged over the patches of two cells, or over the pairs in one.

        They are not kept: all of them take more memory than the rest of the test.
        """
        kernels, squared = np.empty((len(which), *self._apart.shape)), np.empty_like(self._apart)
        for kernel, length, near in zip(kernels, self.lengths[which], self._near.T[which], strict=True):
            np.add(self._within, length**2, out=squared)
            np.multiply(squared, -2, out=kernel)
            np.divide(self._apart, kernel, out=kernel)
            np.maximum(kernel, _MIN_EXPONENT, out=kernel)
            np.exp(kernel, out=kernel)
            kernel *= np.divide(length**2, squared, out=squared)
            np.fill_diagonal(kernel, near)
        return kernels

    def squares_per_cell(self, coefficients: FloatArray) -> FloatArray:
        """Return the sums (C,) of w (n . u)^2 over the pairs in each cell, for a field with coefficients (60,)."""
        products = form_of_moments(self.basis.T @ coefficients)
        squares: FloatArray = self._moments.reshape(len(self._moments), -1) @ products.ravel()
        return squares

    def mixture(self, noise: Noise) -> FloatArray:
        """Covariance (C, C) of the correlated noise between the means of cells."""
        if self._mixed is None or self._mixed[0] is not noise:
            total: FloatArray = np.zeros(self._apart.shape)
            present = np.flatnonzero(noise.components > 0)
            for variance, kernel in zip(noise.components[present], self.kernels(present), strict=True):
                total += variance * kernel
            self._mixed = noise, total
        return self._mixed[1]

    def covariance(self, step: ModelStep, noise: Noise) -> FloatArray:
        """Covariance (K, K) of a step's modes under a noise; the last one of a step is kept."""
        responses, size = step.responses, step.modes.shape[1]
        if size == 0:
            return np.zeros((0, 0))
        if step.covariance is None or step.covariance[0] is not noise:
            spread = self.mixture(noise) @ responses.reshape(len(responses), -1)
            correlated: FloatArray = responses.reshape(-1, size).T @ spread.reshape(-1, size)
            step.covariance = noise, noise.white * step.white + correlated
        return step.covariance[1]

    def step(self, smaller: str, larger: str) -> ModelStep:
        """Step from a smaller to a larger model, cached."""
        if (smaller, larger) not in self._steps:
            self._steps[smaller, larger] = ModelStep(self, smaller, larger)
        return self._steps[smaller, larger]

    def observable_directions(self, matrix: FloatArray, least: float) -> tuple[FloatArray, FloatArray]:
        """Return eigenvalues and eigenvectors with more than the share `least` of the information."""
        values, vectors = np.linalg.eigh(0.5 * (matrix + matrix.T))
        enough = values > least * self.total
        return values[enough], vectors[:, enough]

    def half(self, model: str) -> FloatArray:
        """Observable fields (60, K) of a model, orthonormal with respect to the information.

        For an affine field and smaller models the limit of observability is low: an unmodelled affine part would look
        like a deformation.
        """
        if model not in self._halves:
            if PARAMETERS[model] > PARAMETERS["affine"]:
                self._halves[model] = np.hstack([self.half("affine"), self.step("affine", model).modes])
            else:
                columns = self.columns[model]
                values, vectors = self.observable_directions(columns.T @ self.matrix @ columns, _MIN_INFORMATION_AFFINE)
                self._halves[model] = columns @ (vectors / np.sqrt(values))
        return self._halves[model]

    def surface_form(self, step: ModelStep) -> FloatArray:
        """Quadratic form (K, K): mean square along the normals, over the surface by area, beyond an affine field."""
        affine = self.columns["affine"]
        crossed = self.surface @ affine
        taken = crossed @ np.linalg.pinv(affine.T @ crossed, rcond=_RIDGE, hermitian=True) @ crossed.T
        form: FloatArray = step.modes.T @ (self.surface - taken) @ step.modes
        return form

    def fit(self, model: str, scores: FloatArray) -> FloatArray:
        """Fit the observable part of a model to scores (60,) by least squares; return coefficients (60,)."""
        half = self.half(model)
        coefficients: FloatArray = half @ (half.T @ scores)
        return coefficients

    def explained_sum(self, scores: Scores, model: str) -> float:
        """Sum of squares w (n . u)^2 that a model explains."""
        return float(scores.total @ self.fit(model, scores.total))

    @cached_property
    def noise_design(self) -> tuple[FloatArray, list[NDArray[np.bool_]], FloatArray]:
        """Expected moments of the largest model's residuals under white noise and under each kernel.

        The residual vector of a cell is h_c = sum w n r minus the fit. Noise that is constant, g_c, in each cell adds
        L_c g_c, of which the fit explains Z_c' A^+ sum_d Y_d g_d (L: `load`, Y: `loads`, Z: `translations`). The
        expected products over a lag class D of pairs of cells, sum_D h_c . h_d, are traces of products of these.

        Returns:
            (lags, 1 + J) expectations for unit variances, the (C, C) masks of the lag classes, and (J,) the share of
            each kernel's power within cells that the fit leaves.
        """
        count = len(self.information)
        inverse = self.half("cubic") @ self.half("cubic").T
        z = self.translations.transpose(0, 2, 1)  # (C, 3, 60)
        q = (self.loads.transpose(0, 2, 1).reshape(-1, z.shape[2]) @ inverse).reshape(z.shape)
        white = (self.white_translations.transpose(0, 2, 1).reshape(-1, z.shape[2]) @ inverse).reshape(z.shape)
        spread = inverse @ self.white @ inverse
        load = self.load
        squares = load.reshape(count, 9) @ load.reshape(count, 9).T
        distances = np.sqrt(self._apart) / self.side
        np.fill_diagonal(distances, 0.0)
        masks = [(distances > low) & (distances <= high) for low, high in pairwise(_LAGS)]
        by_white, products = [], np.empty((len(masks), count, count))
        for mask, product in zip(masks, products, strict=True):
            dz = (mask.astype(np.float64) @ z.reshape(count, -1)).reshape(z.shape)
            inner = z.reshape(-1, z.shape[2]).T @ dz.reshape(-1, z.shape[2])
            half = load @ dz - 0.5 * q @ inner
            # The kernels are symmetric, so that the transposed part adds the same.
            np.matmul((-2 * half).reshape(count, -1), q.reshape(count, -1).T, out=product)
            product += mask * squares
            own = float(np.diag(mask) @ np.trace(self.white_information, axis1=1, axis2=2))
            by_white.append(own - 2 * float((dz * white).sum()) + float((inner * spread).sum()))
        kernels = self.kernels(np.arange(len(self.lengths)))
        by_kernel = products.reshape(len(products), -1) @ kernels.reshape(len(kernels), -1).T
        within = self._near.T @ np.diag(squares)
        return np.column_stack([by_white, by_kernel]), masks, by_kernel[0] / np.maximum(within, 1e-300)


class Scores:
    """Scores, i.e. the part of the sums that depends on the residuals, in the coordinates of the geometry."""

    def __init__(self, geometry: Geometry, scores: FloatArray, energy: FloatArray, powers: FloatArray) -> None:
        rows = np.einsum("ab,cbk->cak", geometry.to_orthonormal, scores)
        self.cells: FloatArray = rows.reshape(len(scores), -1)  # (C, 60)
        self.total: FloatArray = self.cells.sum(axis=0)
        self.translations: FloatArray = scores[:, 0]  # (C, 3) sums of w n r
        self.energy = energy  # (C,)
        self.powers = powers  # (levels,) as in `TileSums`


def estimate_noise(geometry: Geometry, scores: Scores) -> Noise:
    """Estimate the variance components by non-negative least squares on moments of the cubic model's residuals."""
    expected, masks, kept = geometry.noise_design
    coefficients = geometry.fit("cubic", scores.total)
    remainders = scores.translations - np.einsum("cik,i->ck", geometry.translations, coefficients)
    products = remainders @ remainders.T
    power = np.square(remainders).sum(axis=1)
    rows, values, sigmas = [], [], []
    for row, mask in zip(expected, masks, strict=True):
        rows.append(row)
        values.append(float((mask * products).sum()))
        # The variance of products of independent vectors is the product of their squared lengths (per component).
        sigmas.append(math.sqrt(2 * float(power @ mask @ power) / 3))
    for row, power_within in zip(geometry.dyadic, scores.powers, strict=True):
        rows.append(np.concatenate([row[:1], row[1:] * kept]))
        values.append(float(power_within))
        sigmas.append(0.05 * float(power_within))  # many sub-cells, but long-range noise is common to many of them
    scale = 1 / np.maximum(sigmas, 1e-300)
    variances = nonnegative_least_squares(np.array(rows) * scale[:, None], np.array(values) * scale)
    return Noise(float(variances[0]), variances[1:], geometry.lengths)


def _kind(terms: dict[str, list[tuple[int, int, int]]]) -> FloatArray:
    """(60,) coefficients of a kind of deformation of unit size."""
    coefficients = np.zeros((len(EXPONENTS), 3))
    for axis, powers in terms.items():
        sign = -1.0 if axis.startswith("-") else 1.0
        for power in powers:
            coefficients[EXPONENTS.tolist().index(list(power)), "xyz".index(axis[-1])] += sign
    return coefficients.ravel()


def _squared_distances(points: FloatArray) -> FloatArray:
    total = np.zeros((len(points), len(points)))
    for axis in range(3):
        total += np.square(points[:, axis, None] - points[None, :, axis])
    return total
