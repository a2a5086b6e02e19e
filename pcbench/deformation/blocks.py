"""Averages over blocks of the scene, for quantities that vary smoothly over it, such as the scale of the noise."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.order_statistics import NORMAL_MAD, percentiles_of_columns
from pcbench.geometry.voxels import cells

_BLOCKS_ALONG_SCENE = 10  # noise correlated over a 25th of the scene still has independent samples in each
# The far width is so large that a part that moved does not set the scale.
_NEAR_WIDTH_BLOCKS, _FAR_WIDTH_BLOCKS = 1.0, 3.0
# Residuals below this share of their 90th percentile count as exact: of normal ones, 1.3 % do.
_EXACT_SHARE = 0.01
_MIN_NOISY_WEIGHT, _MIN_NOISY_BLOCKS = 0.15, 0.25  # shares of a block's weight, and of the blocks, that have noise
_MIN_WEIGHT_SHARE = 0.1  # of the mean weight of well seen blocks: one with less says nothing
_MIN_SIZE = 0.5  # of the blocks' median: a quiet part does not set the scale of the others


class Blocks(NamedTuple):
    """Cubes of a tenth of the scene that contain N positions.

    Attributes:
        of_point: (N,) block of each position.
        side: edge of the blocks.
        squared_distances: (M, M) between the mean positions of the blocks.
    """

    of_point: IntArray
    side: float
    squared_distances: FloatArray

    @classmethod
    def of(cls, places: FloatArray) -> Blocks:
        """Return the blocks of positions (N, 3)."""
        lower, upper = percentiles_of_columns(places, [1, 99])
        side = float((upper - lower).max()) / _BLOCKS_ALONG_SCENE
        grid = cells(places, side, lower)
        means = np.stack([grid.means(places[:, axis]) for axis in range(3)], axis=1)
        return cls(grid.of_point, side, np.square(means[:, None] - means[None]).sum(axis=2))

    def __len__(self) -> int:
        return len(self.squared_distances)

    def sums(self, values: FloatArray) -> FloatArray:
        """Return the sums (M,) of values (N,)."""
        sums: FloatArray = np.bincount(self.of_point, values, len(self)).astype(np.float64)
        return sums

    def smooth(self, values: FloatArray, weights: FloatArray) -> FloatArray:
        """Return kernel-weighted means (N,) of values (N,) around each position."""
        total = self.sums(weights)
        means = self.sums(weights * values) / np.maximum(total, 1e-300)
        return self.kernel_means(means, total, _NEAR_WIDTH_BLOCKS)

    def kernel_means(self, values: FloatArray, weights: FloatArray, width: float) -> FloatArray:
        """Return (N,) Gaussian-kernel means of values (M,) with weights (M,), at the block of each position."""
        share = np.exp(-0.5 * self.squared_distances / (width * self.side) ** 2) * weights + 1e-12 * weights.max()
        smoothed: FloatArray = (share @ values / share.sum(axis=1))[self.of_point]
        return smoothed

    def share_with_weight(self, weights: FloatArray, areas: FloatArray) -> float:
        """Return the share of the area in blocks whose mean weight is at least a tenth of that behind half the fit."""
        area, total = self.sums(areas), self.sums(areas * weights)
        mean = total / area
        order = np.argsort(mean)
        well_seen = mean[order][np.searchsorted(np.cumsum(total[order]), 0.5 * total.sum())]
        return float(area[(mean >= _MIN_WEIGHT_SHARE * well_seen) & (mean > 0)].sum() / area.sum())


def noise_sizes(places: FloatArray, residuals: FloatArray, weights: FloatArray, exact: float = 0.0) -> FloatArray:
    """Estimate the standard deviation of the noise at each position (N,), smooth over a third of the scene.

    The estimate uses weighted medians, and is so smooth that a part that moved by itself stands out against it. Exact
    parts, such as flat water, filled holes or copied points, say nothing about the noise of the others: where at least
    a quarter of the scene has noise, exact residuals do not count, and each block of the scene counts the same.

    Args:
        places: (N, 3) positions.
        residuals: (N,) residuals, which may contain outliers.
        weights: (N,) weights.
        exact: largest residual that may count as exact.
    """
    lengths = np.abs(residuals)
    blocks = Blocks.of(places)
    everything = blocks.sums(weights)
    is_noisy = lengths > min(exact, _EXACT_SHARE * float(np.percentile(lengths, 90)))
    total = blocks.sums(weights * is_noisy)
    has_noise = (total > _MIN_NOISY_WEIGHT * everything) & (total > 0)
    if np.count_nonzero(has_noise) < _MIN_NOISY_BLOCKS * np.count_nonzero(everything):
        return np.full(len(places), NORMAL_MAD * float(_medians(lengths, weights, np.zeros(len(lengths), np.int64))[0]))
    sizes = NORMAL_MAD * _medians(lengths, weights * is_noisy, blocks.of_point)
    has_noise &= sizes > 0
    if not has_noise.any():
        return np.zeros(len(places))
    typical = float(np.median(sizes[has_noise]))
    logarithms = np.log(np.maximum(np.where(has_noise, sizes, typical), _MIN_SIZE * typical))
    noise: FloatArray = np.exp(blocks.kernel_means(logarithms, np.where(has_noise, total, 0.0), _FAR_WIDTH_BLOCKS))
    return noise


def _medians(values: FloatArray, weights: FloatArray, group: IntArray) -> FloatArray:
    """Return (G,) weighted medians of values (N,) in groups."""
    order = np.lexsort((values, group))
    counts = np.bincount(group)
    ends = np.cumsum(counts)
    below = np.concatenate([[0.0], np.cumsum(weights[order])])
    half = 0.5 * (below[ends - counts] + below[ends])
    medians: FloatArray = values[order][np.clip(np.searchsorted(below[1:], half), ends - counts, ends - 1)]
    return medians
