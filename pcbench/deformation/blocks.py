"""Averages over blocks of the scene, for quantities that vary smoothly over it, such as the size of the noise."""

from __future__ import annotations

import numpy as np

from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.voxels import Cells, cells

_BLOCKS_ALONG = 10  # along the scene; noise correlated over 1/25 of the scene has independent locations in each block
_SMOOTHING_BLOCKS = 1.0  # kernel length in blocks
_NOISE_SMOOTHING_BLOCKS = 3.0  # kernel length in blocks; a part that moved separately must not set the local size


def estimate_noise_sizes(places: FloatArray, residuals: FloatArray, weights: FloatArray) -> FloatArray:
    """Return the standard deviation (N,) of the noise at each position, smooth over a third of the scene.

    It is based on weighted medians, which are robust against outliers. The smoothing keeps a part that moved separately
    visible.

    Args:
        places: (N, 3) positions.
        residuals: (N,) residuals, with outliers.
        weights: (N,) weights.
    """
    blocks, side = _blocks(places)
    sizes = _weighted_medians(np.abs(residuals), weights, blocks.of_point)
    total: FloatArray = np.bincount(blocks.of_point, weights, len(sizes)).astype(np.float64)
    known = (sizes > 0) & (total > 0)
    overall = 1.4826 * float(_weighted_medians(np.abs(residuals), weights, np.zeros(len(residuals), dtype=np.int64))[0])
    if not known.any() or overall == 0:
        return np.full(len(places), overall)
    logarithms = np.log(np.where(known, sizes, 1.0))
    relative = np.exp(
        _kernel_average(places, blocks, logarithms, np.where(known, total, 0.0), _NOISE_SMOOTHING_BLOCKS * side)
    )
    local: FloatArray = overall * relative / np.exp(np.average(np.log(relative), weights=weights))
    return local


def smooth(places: FloatArray, values: FloatArray, weights: FloatArray) -> FloatArray:
    """Return weighted means (N,) of values (N,) around each position (N, 3)."""
    blocks, side = _blocks(places)
    total: FloatArray = np.bincount(blocks.of_point, weights, len(blocks.first)).astype(np.float64)
    means = np.bincount(blocks.of_point, weights * values, len(blocks.first)) / np.maximum(total, 1e-300)
    return _kernel_average(places, blocks, means, total, _SMOOTHING_BLOCKS * side)


def _weighted_medians(values: FloatArray, weights: FloatArray, group: IntArray) -> FloatArray:
    """Return the weighted medians (G,) of values (N,) in groups."""
    order = np.lexsort((values, group))
    counts = np.bincount(group)
    ends = np.cumsum(counts)
    below = np.concatenate([[0.0], np.cumsum(weights[order])])
    half = 0.5 * (below[ends - counts] + below[ends])
    medians: FloatArray = values[order][np.clip(np.searchsorted(below[1:], half), ends - counts, ends - 1)]
    return medians


def _blocks(places: FloatArray) -> tuple[Cells, float]:
    lower, upper = np.percentile(places, [1, 99], axis=0)
    side = float((upper - lower).max()) / _BLOCKS_ALONG
    return cells(places, side, lower), side


def _kernel_average(
    places: FloatArray, blocks: Cells, values: FloatArray, weights: FloatArray, reach: float
) -> FloatArray:
    """Return at each position (N,) the mean of block values (M,), with a Gaussian kernel around its block."""
    means = np.stack([blocks.means(places[:, axis]) for axis in range(3)], axis=1)
    squared_distances = np.square(means[:, None] - means[None]).sum(axis=2)
    share = np.exp(-0.5 * squared_distances / reach**2) * weights + 1e-12 * weights.max()
    averages: FloatArray = (share @ values / share.sum(axis=1))[blocks.of_point]
    return averages
