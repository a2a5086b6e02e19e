"""Averages over blocks of the scene, for quantities that vary smoothly over it, such as the scale of the noise."""

from __future__ import annotations

import numpy as np

from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.order_statistics import NORMAL_MAD
from pcbench.geometry.voxels import Cells, cells

_BLOCKS_ALONG_SCENE = 10  # noise correlated over a 25th of the scene still has independent samples in each
# The far width is so large that a part that moved does not set the scale.
_NEAR_WIDTH_BLOCKS, _FAR_WIDTH_BLOCKS = 1.0, 3.0
# Residuals below this share of their 90th percentile count as exact: of normal ones, 1.3 % do.
_EXACT_SHARE = 0.01
_MIN_NOISY_WEIGHT, _MIN_NOISY_BLOCKS = 0.15, 0.25  # shares of a block's weight, and of the blocks, that have noise
_MIN_WEIGHT_SHARE = 0.1  # of the mean weight of well seen blocks: one with less says nothing
_MIN_SIZE = 0.5  # of the blocks' median: a quiet part does not set the scale of the others


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
    blocks, side = _blocks(places)
    count = len(blocks.first)
    everything = np.bincount(blocks.of_point, weights, count)
    is_noisy = lengths > min(exact, _EXACT_SHARE * float(np.percentile(lengths, 90)))
    total = np.bincount(blocks.of_point, weights * is_noisy, count).astype(np.float64)
    has_noise = (total > _MIN_NOISY_WEIGHT * everything) & (total > 0)
    if np.count_nonzero(has_noise) < _MIN_NOISY_BLOCKS * np.count_nonzero(everything):
        return np.full(len(places), NORMAL_MAD * float(_medians(lengths, weights, np.zeros(len(lengths), np.int64))[0]))
    sizes = NORMAL_MAD * _medians(lengths, weights * is_noisy, blocks.of_point)
    has_noise &= sizes > 0
    if not has_noise.any():
        return np.zeros(len(places))
    typical = float(np.median(sizes[has_noise]))
    logarithms = np.log(np.maximum(np.where(has_noise, sizes, typical), _MIN_SIZE * typical))
    means = _kernel_means(places, blocks, logarithms, np.where(has_noise, total, 0.0), _FAR_WIDTH_BLOCKS * side)
    noise: FloatArray = np.exp(means)
    return noise


def smooth(places: FloatArray, values: FloatArray, weights: FloatArray) -> FloatArray:
    """Return kernel-weighted means of values (N,) around each position (N,)."""
    blocks, side = _blocks(places)
    total: FloatArray = np.bincount(blocks.of_point, weights, len(blocks.first)).astype(np.float64)
    means = np.bincount(blocks.of_point, weights * values, len(blocks.first)) / np.maximum(total, 1e-300)
    return _kernel_means(places, blocks, means, total, _NEAR_WIDTH_BLOCKS * side)


def share_with_weight(places: FloatArray, weights: FloatArray, areas: FloatArray) -> float:
    """Return the share of the area in blocks whose mean weight is at least a tenth of that behind half of the fit."""
    blocks, _ = _blocks(places)
    area, total = np.bincount(blocks.of_point, areas), np.bincount(blocks.of_point, areas * weights)
    mean = total / area
    order = np.argsort(mean)
    well_seen = mean[order][np.searchsorted(np.cumsum(total[order]), 0.5 * total.sum())]
    return float(area[(mean >= _MIN_WEIGHT_SHARE * well_seen) & (mean > 0)].sum() / area.sum())


def _medians(values: FloatArray, weights: FloatArray, group: IntArray) -> FloatArray:
    """Return (G,) weighted medians of values (N,) in groups."""
    order = np.lexsort((values, group))
    counts = np.bincount(group)
    ends = np.cumsum(counts)
    below = np.concatenate([[0.0], np.cumsum(weights[order])])
    half = 0.5 * (below[ends - counts] + below[ends])
    medians: FloatArray = values[order][np.clip(np.searchsorted(below[1:], half), ends - counts, ends - 1)]
    return medians


def _blocks(places: FloatArray) -> tuple[Cells, float]:
    lower, upper = np.percentile(places, [1, 99], axis=0)
    side = float((upper - lower).max()) / _BLOCKS_ALONG_SCENE
    return cells(places, side, lower), side


def _kernel_means(
    places: FloatArray, blocks: Cells, values: FloatArray, weights: FloatArray, reach: float
) -> FloatArray:
    """Return (N,) Gaussian-kernel means of block values (M,) with weights (M,), evaluated at each position's block."""
    means = np.stack([blocks.means(places[:, axis]) for axis in range(3)], axis=1)
    squared_distances = np.square(means[:, None] - means[None]).sum(axis=2)
    share = np.exp(-0.5 * squared_distances / reach**2) * weights + 1e-12 * weights.max()
    smoothed: FloatArray = (share @ values / share.sum(axis=1))[blocks.of_point]
    return smoothed
