"""Errors of a DEM of difference, white and correlated, and the uncertainty of sums over any area.

The error of a cell is a white error of known relative variance and correlated errors of a short and a long range, as
the nested variograms of Rolstad et al. (2009) and Hugonnet et al. (2022). `pcbench.measure.dem.reml` estimates them on
stable terrain. The long range, which determines the uncertainty of volumes, is not fixed at one value: sums are weighed
over all ranges and variances that the data support.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray

Mask = NDArray[np.bool_]

FAR_LENGTH_SHARE = 0.4
"""Length of a Gaussian correlation over the whole area, as a share of its extent."""
_LAG_BINS = 96
_MAX_FFT_EDGE = 256


def _exponential(h: FloatArray) -> FloatArray:
    return np.exp(-h)


def _gaussian(h: FloatArray) -> FloatArray:
    return np.exp(-0.5 * h * h)


FAMILIES = (_exponential, _gaussian)
"""Correlation functions of a distance in lengths."""
GAUSSIAN = 1
"""Number of the Gaussian function in `FAMILIES`."""
_PRACTICAL_RANGE = (3.0, 2.4477)  # at which the correlation is 0.05, in lengths


class CorrelatedError(NamedTuple):
    """A correlated error: its standard deviation, and the range at which the correlation has fallen to 0.05."""

    sigma: float
    range: float


@dataclass(frozen=True, eq=False)
class ErrorModel:
    """Errors of the cells of a DEM of difference, relative to the white variances of `SumWeights`.

    Attributes:
        white_scale: factor of the white variances.
        short_sigma: standard deviation of the error of short range, in the unit of heights.
        short_family: number of its correlation function: `FAMILIES`.
        short_length: its length, in cells.
        families: number of the correlation function (S,) of each supported long error: `FAMILIES`.
        ranges: length (S,) of each, in cells.
        variances: variance (S,) of each, in squared units of heights.
        scales: factor (S,) of the variances of white and short errors that goes with it.
        weights: posterior probability (S,) of each.
        dof: degrees of freedom of the scale.
        far_ratios: variances (Q,) of an error as long as the area, which the data do not exclude, over that of the
            long error.
        far_weights: posterior probability (Q,) of each.
        mean: mean of the stable terrain.
        extent: longest edge of the area, in cells: longer errors cannot be told from change.
    """

    white_scale: float
    short_sigma: float
    short_family: int
    short_length: float
    families: NDArray[np.intp]
    ranges: FloatArray
    variances: FloatArray
    scales: FloatArray
    weights: FloatArray
    dof: float
    far_ratios: FloatArray
    far_weights: FloatArray
    mean: float
    extent: int

    @cached_property
    def long(self) -> CorrelatedError:
        """The long error: root of the mean variance, and the geometric mean of the ranges, in cells."""
        variance = float(self.weights @ self.variances)
        parts = self.weights * self.variances
        if not parts.sum() > 0:
            return CorrelatedError(0.0, 0.0)
        practical = self.ranges * np.array([_PRACTICAL_RANGE[k] for k in self.families])
        return CorrelatedError(variance**0.5, float(np.exp(parts @ np.log(practical) / parts.sum())))

    @property
    def short(self) -> CorrelatedError:
        """The short error, with its range in cells."""
        length = self.short_length * _PRACTICAL_RANGE[self.short_family]
        return CorrelatedError(self.short_sigma, length if self.short_sigma else 0.0)

    @property
    def far(self) -> CorrelatedError:
        """The error that is correlated over the whole area, which cannot be told from a change of all of it."""
        variance = float(self.far_weights @ self.far_ratios) * float(self.weights @ self.variances)
        return CorrelatedError(variance**0.5, float(self.extent) if variance > 0 else 0.0)

    @property
    def correlated_sigma(self) -> float:
        """Standard deviation of the correlated error of one cell."""
        return float(np.linalg.norm([self.long.sigma, self.short_sigma, self.far.sigma]))

    def variances_of(self, sums: SumWeights) -> tuple[FloatArray, FloatArray]:
        """Return the variance of a weighted sum of cells for each pair of a long and a far error, and their weights."""
        near = self.white_scale * sums.white
        if self.short_sigma > 0:
            near += self.short_sigma**2 * sums.form(self.short_family, self.short_length)
        kinds, numbers = np.unique(np.column_stack([self.families, self.ranges]), axis=0, return_inverse=True)
        forms = np.array([sums.form(int(family), float(length)) for family, length in kinds])
        within = self.scales * near + self.variances * forms[numbers.ravel()]
        far = sums.form(GAUSSIAN, FAR_LENGTH_SHARE * self.extent) * np.outer(self.variances, self.far_ratios)
        return (within[:, None] + far).ravel(), np.outer(self.weights, self.far_weights).ravel()

    def sigma(self, sums: SumWeights) -> float:
        """Return the standard deviation of a weighted sum of cells, in units of heights times weight."""
        variances, weights = self.variances_of(sums)
        return math.sqrt(float(weights @ variances))

    def half_width(self, sums: SumWeights, level: float = 0.95, further_variance: float = 0.0) -> float:
        """Return half the width of the interval of a weighted sum of cells.

        Args:
            sums: weights of the cells.
            level: probability of the interval.
            further_variance: variance of an independent error of the sum.
        """
        from scipy.optimize import brentq
        from scipy.special import stdtr

        variances, weights = self.variances_of(sums)
        scales = np.sqrt(variances + further_variance)
        if not scales.max() > 0:
            return 0.0
        tail = (1 - level) / 2

        def excess(width: float) -> float:
            return float(weights @ stdtr(self.dof, -width / np.maximum(scales, 1e-300))) - tail

        return float(brentq(excess, 0.0, 1000 * scales.max(), xtol=1e-6 * scales.max()))


@dataclass(frozen=True, eq=False)
class SumWeights:
    """Quantities that determine the variance of a weighted sum of cells.

    Attributes:
        white: sum of squared weights times white variances.
        lags: distances (B,) between blocks of cells, in cells.
        products: (B,) sums of products of the weights of two blocks of cells at these distances.
        step: edge of the blocks, in cells.
    """

    white: float
    lags: FloatArray
    products: FloatArray
    step: int

    @classmethod
    def of(cls, weights: FloatArray, white: FloatArray) -> SumWeights:
        """Return the moments of a sum.

        Args:
            weights: (H, W) weights of the cells; 0 outside.
            white: (H, W) white variances; NaN only where the weight is 0.
        """
        rows, columns = np.flatnonzero(weights.any(axis=1)), np.flatnonzero(weights.any(axis=0))
        if not len(rows):
            return cls(0.0, np.zeros(1), np.zeros(1), 1)
        part = (slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1))
        inside, variances = weights[part].astype(float), white[part]
        squared = inside**2
        noise = float((squared * np.where(squared > 0, variances, 0.0)).sum())
        return cls(noise, *_lag_products(inside))

    def form(self, family: int, length: float) -> float:
        """Return the quadratic form of the weights with a correlation function of this length in cells."""
        return float(self.products @ _mean_correlation(family, self.lags, self.step, length))


def _lag_products(weights: FloatArray) -> tuple[FloatArray, FloatArray, int]:
    """Return distances, the sums of products of weights at these distances (Wiener-Khinchin), and the edge of blocks.

    Large areas are summed over blocks of cells first.
    """
    from scipy.fft import irfft2, next_fast_len, rfft2

    step = -(-int(max(weights.shape)) // _MAX_FFT_EDGE)
    if step > 1:
        pad = [(0, -edge % step) for edge in weights.shape]
        padded = np.pad(weights, pad)
        height, width = (edge // step for edge in padded.shape)
        weights = padded.reshape(height, step, width, step).sum(axis=(1, 3))
    shape = [next_fast_len(2 * edge - 1, real=True) for edge in weights.shape]
    products = irfft2(np.abs(rfft2(weights, shape)) ** 2, shape)
    dy, dx = (np.minimum(np.arange(edge), edge - np.arange(edge)) for edge in shape)
    distances = np.hypot(*np.meshgrid(dy, dx, indexing="ij")).ravel()
    edges = np.concatenate([[-0.5], np.geomspace(0.5, distances.max() + 1, _LAG_BINS)])
    numbers = np.digitize(distances, edges) - 1
    counts = np.bincount(numbers, minlength=_LAG_BINS)
    kept = counts > 0
    lags: FloatArray = step * np.bincount(numbers, distances, _LAG_BINS)[kept] / counts[kept]
    sums = np.bincount(numbers, products.ravel(), _LAG_BINS)[kept].astype(np.float64)
    return lags, sums, step


def _mean_correlation(family: int, lags: FloatArray, step: int, length: float) -> FloatArray:
    """Return the mean correlation of the cells of two blocks with an edge of `step` cells at each of the lags (B,)."""
    correlation = FAMILIES[family]
    if step == 1:
        return correlation(lags / length)
    if length < step / 8:  # both functions have the integral 2 pi length^2 over the plane
        return np.where(lags < step / 2, 2 * np.pi * (length / step) ** 2, correlation(lags / length))
    places = min(step, 16)
    offsets = np.arange(1 - places, places)
    shares = (places - np.abs(offsets)) / places**2
    along, across = np.meshgrid(offsets * (step / places), offsets * (step / places), indexing="ij")
    distances = np.hypot(lags[:, None, None] + along, across)
    result: FloatArray = np.einsum("bij,i,j->b", correlation(distances / length), shares, shares)
    return result
