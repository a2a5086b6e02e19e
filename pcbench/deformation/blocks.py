"""Averages over blocks of the scene, for quantities that vary smoothly over it, such as the scale of the noise."""

from __future__ import annotations

import numpy as np

from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.voxels import Cells, cells

_BLOCKS_ALONG_SCENE = 10  # noise correlated over a 25th of the scene still has independent samples in each
# The far width is so large that a part that moved does not set the scale.
_NEAR_WIDTH_BLOCKS, _FAR_WIDTH_BLOCKS = 1.0, 3.0


def noise_sizes(places: FloatArray, residuals: FloatArray, weights: FloatArray) -> FloatArray:
    """Estimate the standard deviation of the noise at each position (N,), smooth over a third of the scene.

    The estimate uses weighted medians, and is so smooth that a part that moved by itself stands out against it.

    Args:
        places: (N, 3) positions.
        residuals: (N,) residuals, which may contain outliers.
        weights: (N,) weights.
    """
    blocks, side = _blocks(places)
    sizes = _medians(np.abs(residuals), weights, blocks.of_point)
    total: FloatArray = np.bincount(blocks.of_point, weights, len(sizes)).astype(np.float64)
    known = (sizes > 0) & (total > 0)
    overall = 1.4826 * float(_medians(np.abs(residuals), weights, np.zeros(len(residuals), dtype=np.int64))[0])
    if not known.any() or overall == 0:
        return np.full(len(places), overall)
    logarithms = np.log(np.where(known, sizes, 1.0))
    relative = np.exp(_kernel_means(places, blocks, logarithms, np.where(known, total, 0.0), _FAR_WIDTH_BLOCKS * side))
    found: FloatArray = overall * relative / np.exp(np.average(np.log(relative), weights=weights))
    return found


def smooth(places: FloatArray, values: FloatArray, weights: FloatArray) -> FloatArray:
    """Return kernel-weighted means of values (N,) around each position (N,)."""
    blocks, side = _blocks(places)
    total: FloatArray = np.bincount(blocks.of_point, weights, len(blocks.first)).astype(np.float64)
    means = np.bincount(blocks.of_point, weights * values, len(blocks.first)) / np.maximum(total, 1e-300)
    return _kernel_means(places, blocks, means, total, _NEAR_WIDTH_BLOCKS * side)


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
    apart = np.square(means[:, None] - means[None]).sum(axis=2)
    share = np.exp(-0.5 * apart / reach**2) * weights + 1e-12 * weights.max()
    found: FloatArray = (share @ values / share.sum(axis=1))[blocks.of_point]
    return found
