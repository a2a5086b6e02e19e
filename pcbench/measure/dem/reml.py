"""Estimate the errors of a DEM of difference on stable terrain by restricted maximum likelihood.

Variograms are not fitted: an empirical variogram is computed about the mean of the same area and so is blind to errors
as long as the area (Hugonnet et al. 2022, section 4.3). Restricted maximum likelihood (Patterson & Thompson 1971) takes
the unknown mean into account.

In simulations of areas of 60 x 60 cells on five terrains, with white and correlated errors of up to a quarter of the
extent in both epochs, 95 % intervals of net volumes hold the truth in some 95 % of the runs (tests/volume_cases.py):
in more, with intervals up to twice as wide as need be, where the errors are short against the area, and in 91 % where
they are exponential and as long as a quarter of it. Longer errors cannot be told from change.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray
from pcbench.measure.dem.covariance import FAMILIES, FAR_LENGTH_SHARE, GAUSSIAN, ErrorModel, Mask

MIN_STABLE_CELLS = 64
"""Smallest number of stable cells on which correlated errors are estimated."""
_WINDOW, _MAX_WINDOWS = 10, 8  # edge of the windows of the short range, in cells, and their number
_MIN_WINDOW_SHARE = 0.5  # of stable cells in a window
_BLOCKS_PER_SIDE, _MIN_BLOCK_SHARE = 14, 0.25
_SHORT_LENGTHS = (0.8, 1.5, 2.5, 4.5, 8.0, 14.0)  # in cells
_LEAST_SCALE = 1e-12  # of the white variances, so that equal epochs have errors above 0 too
_LEAST_GAIN = 4.0  # of the logarithm of the likelihood, by which an error of short range has to explain more
_SHORT_RATIOS = np.concatenate([[0.0], np.geomspace(0.03, 30, 16)])
_LONG_RANGES = 8
_LONG_RATIOS = np.concatenate([[0.0], np.geomspace(0.02, 5000, 32)])
_MAX_RANGE_SHARE = 0.5  # of the extent
_KAPPA_DOF = 8.0  # weight of the estimate at the short range against that of the blocks
_FAR_RATIOS = np.array([0.0, 0.1, 0.3, 1.0])
_FAR_PRIOR = np.array([0.1, 0.3, 0.3, 0.3])


def fit_errors(residuals: FloatArray, white: FloatArray, stable: Mask) -> ErrorModel | None:
    """Estimate the errors of a DEM of difference on stable terrain; None if it has too few cells.

    Args:
        residuals: (H, W) differences of height.
        white: (H, W) relative white variances of the differences.
        stable: (H, W) cells without change, in which the others are finite.
    """
    if np.count_nonzero(stable) < MIN_STABLE_CELLS:
        return None
    return _fit_long(residuals, white, stable, _fit_short(residuals, white, stable))


class _Contrasts(NamedTuple):
    """Whitened contrasts of values, that is without their mean, in a basis whose first axis is that of the contrasts.

    In this basis the correlation is tridiagonal, which gives the likelihood for all variances at once.

    Attributes:
        diagonal: (n,) of the correlation.
        beside: (n - 1,) elements beside its diagonal.
        square: sum of the squared contrasts.
    """

    diagonal: FloatArray
    beside: FloatArray
    square: float

    def forms(self, ratios: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the quadratic form (R,) of the contrasts and the log determinant (R,) of their covariance.

        Args:
            ratios: variances (R,) of the correlated error in units of the noise, which has the variance 1.
        """
        pivots = 1 + np.outer(self.diagonal, ratios)
        squares = np.outer(self.beside**2, ratios**2)
        for k in range(len(squares) - 1, -1, -1):
            pivots[k] -= squares[k] / pivots[k + 1]
        return self.square / pivots[0], np.log(pivots).sum(axis=0)


def _contrasts(values: FloatArray, noise: FloatArray, correlation: FloatArray) -> _Contrasts:
    """Return the whitened contrasts of values (n,).

    Args:
        values: observations.
        noise: standard deviations (n,) of one error, or the (n, n) lower Cholesky factor of its covariance.
        correlation: (n, n) correlation of the other error.
    """
    from scipy.linalg import solve_triangular
    from scipy.linalg.lapack import dsytrd

    def whiten(columns: FloatArray) -> FloatArray:
        if noise.ndim == 1:
            return columns / noise[:, None]
        result: FloatArray = solve_triangular(noise, columns, lower=True, check_finite=False)
        return result

    scaled = whiten(whiten(correlation).T)
    ones, observed = whiten(np.column_stack([np.ones(len(values)), values])).T
    # One reflection maps the whitened constant to the first axis, which is dropped, and another one the contrasts.
    scaled, observed = _reflected(scaled, observed, ones)
    scaled, observed = scaled[1:, 1:], observed[1:]
    scaled, observed = _reflected(scaled, observed, observed)
    _, diagonal, beside, _, _ = dsytrd(scaled, lower=1)
    return _Contrasts(diagonal, beside, float(observed[0] ** 2))


def _reflected(matrix: FloatArray, vector: FloatArray, direction: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return a symmetric matrix and a vector after Householder's reflection of a direction to the first axis."""
    norm = float(np.linalg.norm(direction))
    if not norm > 0:
        return matrix, vector
    axis = direction / norm
    axis[0] += np.copysign(1.0, axis[0])
    axis /= np.linalg.norm(axis)
    product = matrix @ axis
    side = product - (axis @ product) * axis
    result = matrix - 2 * (np.outer(axis, side) + np.outer(side, axis))
    return result, vector - 2 * axis * (axis @ vector)


class _ShortError(NamedTuple):
    """The scale of the white variances, and the variance, correlation function and length of the error beside them."""

    white_scale: float
    variance: float
    family: int
    length: float


def _fit_short(residuals: FloatArray, white: FloatArray, stable: Mask) -> _ShortError:
    """Return the white error and the error of short range that windows of full resolution support best."""
    windows = [
        (residuals[part][stable[part]], white[part][stable[part]], LagTable.of(stable[part]))
        for part in _windows(stable)
    ]
    if not windows:
        values, noise = residuals[stable], white[stable]
        scale = float(np.mean((values - values.mean()) ** 2 / noise))
        return _ShortError(max(scale, _LEAST_SCALE), 0.0, 0, _SHORT_LENGTHS[0])
    unit = float(np.mean(np.concatenate([noise for _, noise, _ in windows])))
    best, best_likelihood = _ShortError(1.0, 0.0, 0, _SHORT_LENGTHS[0]), -np.inf
    for family, correlation in enumerate(FAMILIES):
        for length in _SHORT_LENGTHS:
            parts = [
                _contrasts(
                    values,
                    np.sqrt(noise / unit),
                    pairs.matrix(correlation(np.hypot(*pairs.lags) / length)),
                )
                for values, noise, pairs in windows
            ]
            squares, logs = np.sum([part.forms(_SHORT_RATIOS) for part in parts], axis=0)
            freedom = sum(len(part.diagonal) for part in parts)
            scales = np.maximum(squares / freedom, _LEAST_SCALE * unit)
            likelihoods = -0.5 * (freedom * np.log(scales) + logs)
            likelihoods[1:] -= _LEAST_GAIN
            row = int(likelihoods.argmax())
            if likelihoods[row] > best_likelihood + 1e-9:
                best_likelihood, scale = float(likelihoods[row]), float(scales[row])
                best = _ShortError(scale / unit, float(_SHORT_RATIOS[row]) * scale, family, length)
    return best


def _windows(stable: Mask) -> list[tuple[slice, slice]]:
    """Return windows with the most stable cells, spread over the area."""
    edge = min(_WINDOW, *stable.shape)
    starts = [np.unique(np.linspace(0, size - edge, min(6, max(1, size // edge))).astype(int)) for size in stable.shape]
    parts = [(slice(row, row + edge), slice(column, column + edge)) for row in starts[0] for column in starts[1]]
    counts = np.array([np.count_nonzero(stable[part]) for part in parts])
    usable = np.flatnonzero(counts >= max(_MIN_WINDOW_SHARE * edge**2, 16))
    step = max(1, len(usable) // _MAX_WINDOWS)
    return [parts[k] for k in usable[::step][:_MAX_WINDOWS]]


class LagTable(NamedTuple):
    """The pairs of the cells of a mask, of which many have the same lag.

    Attributes:
        lags: (A, B) differences of rows, and of columns, between two cells.
        numbers: (n, n) position of the lag of each pair in the raveled table.
    """

    lags: tuple[FloatArray, FloatArray]
    numbers: NDArray[np.intp]

    @classmethod
    def of(cls, mask: Mask) -> LagTable:
        """Return the pairs of the cells of a mask (H, W), row by row."""
        height, width = mask.shape
        rows, columns = np.nonzero(mask)
        down, right = np.meshgrid(np.arange(1.0 - height, height), np.arange(1.0 - width, width), indexing="ij")
        numbers = (rows[:, None] - rows + height - 1) * (2 * width - 1) + columns[:, None] - columns + width - 1
        return cls((down, right), numbers)

    def matrix(self, table: FloatArray) -> FloatArray:
        """Return the values (n, n) of the pairs from those (A, B) of the lags."""
        values: FloatArray = table.ravel()[self.numbers]
        return values


def _fit_long(residuals: FloatArray, white: FloatArray, stable: Mask, short: _ShortError) -> ErrorModel:
    """Return the errors with the posterior of the long error from the means of blocks."""
    extent = max(stable.shape)
    edge = max(1, round((stable.size / _BLOCKS_PER_SIDE**2) ** 0.5))
    counts = _block_sums(stable.astype(float), edge)
    kept = counts >= max(1.0, _MIN_BLOCK_SHARE * edge**2)
    if np.count_nonzero(kept) < 9:
        kept = counts > 0
    n = counts[kept]
    values = _block_sums(np.where(stable, residuals, 0.0), edge)[kept] / n
    noise = short.white_scale * _block_sums(np.where(stable, white, 0.0), edge)[kept] / n**2
    pairs = LagTable.of(kept)
    covariance = np.diag(noise) + short.variance * _block_correlation(short.family, pairs, edge, short.length)
    unit = float(np.trace(covariance)) / len(n)
    factor = np.linalg.cholesky(covariance / unit).astype(np.float64)
    longest = max(_MAX_RANGE_SHARE * extent / 2, 1.5 * edge)
    lengths = np.geomspace(max(0.5 * edge, 0.8), longest, _LONG_RANGES)
    states, logs = [], []
    for family in range(len(FAMILIES)):
        for far in lengths:
            contrasts = _contrasts(values, factor, _block_correlation(family, pairs, edge, far))
            squares, log_determinant = contrasts.forms(_LONG_RATIOS)
            count = len(contrasts.diagonal)
            # Inverse-gamma prior of the scale about the estimate at the short range, with `_KAPPA_DOF`.
            squares = squares + _KAPPA_DOF * unit
            scale = squares / (count + _KAPPA_DOF)
            log = -0.5 * ((count + _KAPPA_DOF) * np.log(squares) + log_determinant)
            states += [(family, far, ratio * s, s / unit) for ratio, s in zip(_LONG_RATIOS, scale, strict=True)]
            logs.append(log + _LOG_PRIOR)
    likelihood = np.concatenate(logs)
    weights = np.exp(likelihood - likelihood.max())
    weights /= weights.sum()
    family, far, variance, scale = states[int(weights.argmax())]
    others = scale * covariance + variance * _block_correlation(family, pairs, edge, far)
    chosen = weights > 1e-4
    families, ranges, variances, scales = (np.array(column) for column in zip(*states, strict=True))
    return ErrorModel(
        white_scale=short.white_scale,
        short_sigma=short.variance**0.5,
        short_family=short.family,
        short_length=short.length,
        families=families[chosen].astype(np.intp),
        ranges=ranges[chosen],
        variances=variances[chosen],
        scales=scales[chosen],
        weights=weights[chosen] / weights[chosen].sum(),
        dof=float(len(values) - 1 + _KAPPA_DOF),
        far_ratios=_FAR_RATIOS,
        far_weights=_far_weights(values, others, variance, pairs, edge, extent),
        mean=float(np.average(values, weights=n)),
        extent=extent,
    )


def _far_weights(
    values: FloatArray, others: FloatArray, variance: float, pairs: LagTable, edge: int, extent: int
) -> FloatArray:
    """Return the posterior probability of errors as long as the area, with `_FAR_RATIOS` times the long variance.

    A long error changes all blocks alike, so that only the few contrasts of largest wavelength can exclude it. What
    they cannot exclude widens the intervals of sums over large parts of the area.

    Args:
        values: means (n,) of the blocks.
        others: covariance (n, n) of the other errors, as the data support them best.
        variance: variance of the long error.
        pairs: lags of the blocks.
        edge: edge of a block, in cells.
        extent: longest edge of the area, in cells.
    """
    if not variance > 0:
        return _FAR_PRIOR
    far = _block_correlation(GAUSSIAN, pairs, edge, FAR_LENGTH_SHARE * extent)
    factor = np.linalg.cholesky(others).astype(np.float64)
    squares, log_determinant = _contrasts(values, factor, variance * far).forms(_FAR_RATIOS)
    log = -0.5 * (squares + log_determinant)
    weights = _FAR_PRIOR * np.exp(log - log.max())
    result: FloatArray = weights / weights.sum()
    return result


_LOG_PRIOR = np.log(np.concatenate([[0.5], np.full(len(_LONG_RATIOS) - 1, 0.5 / (len(_LONG_RATIOS) - 1))]))


def _block_sums(values: FloatArray, edge: int) -> FloatArray:
    """Return the sums over square blocks of `edge` cells."""
    padded = np.pad(values, [(0, -size % edge) for size in values.shape])
    height, width = (size // edge for size in padded.shape)
    sums: FloatArray = padded.reshape(height, edge, width, edge).sum(axis=(1, 3))
    return sums


def _block_correlation(family: int, pairs: LagTable, edge: int, length: float) -> FloatArray:
    """Return the correlation (n, n) of the means of blocks: the mean over a square of places in each."""
    places = min(edge, max(3, min(2 * round(edge / length), 12)))
    dy, dx = (lag * edge for lag in pairs.lags)
    table = np.zeros_like(dy)
    shares = places - np.abs(np.arange(1 - places, places))
    offsets = np.arange(1 - places, places) * (edge / places)
    for down, share_down in zip(offsets, shares, strict=True):
        for right, share_right in zip(offsets, shares, strict=True):
            table += share_down * share_right * FAMILIES[family](np.hypot(dy + down, dx + right) / length)
    return pairs.matrix(table / places**4)
