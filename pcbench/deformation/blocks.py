"""Averages over blocks of the scene, for what varies smoothly over it: the size of the noise, above all."""

from __future__ import annotations

import numpy as np

from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.voxels import Cells, cells

_BLOCKS = 10  # along the scene: noise that is correlated over a 25th of it still has independent places in each
_NEAR, _FAR = 1.0, 3.0  # blocks, of the kernels: far enough that a part that moved by itself does not set the size


def noise_sizes(places: FloatArray, residuals: FloatArray, weights: FloatArray) -> FloatArray:
    """Standard deviation of the noise at each place (N,), by medians, and smooth over a third of the scene: a part that
    moved by itself is to stand out against it.

    Args:
        places: (N, 3).
        residuals: (N,), which may hold outliers: weighted medians count.
        weights: (N,).
    """
    blocks, side = _blocks(places)
    sizes = _medians(np.abs(residuals), weights, blocks.of_point)
    total: FloatArray = np.bincount(blocks.of_point, weights, len(sizes)).astype(np.float64)
    known = (sizes > 0) & (total > 0)
    overall = 1.4826 * float(_medians(np.abs(residuals), weights, np.zeros(len(residuals), dtype=np.int64))[0])
    if not known.any() or overall == 0:
        return np.full(len(places), overall)
    logarithms = np.log(np.where(known, sizes, 1.0))
    relative = np.exp(_spread(places, blocks, logarithms, np.where(known, total, 0.0), _FAR * side))
    found: FloatArray = overall * relative / np.exp(np.average(np.log(relative), weights=weights))
    return found


def smoothed(places: FloatArray, values: FloatArray, weights: FloatArray) -> FloatArray:
    """Weighted means of values (N,) around each place (N,)."""
    blocks, side = _blocks(places)
    total: FloatArray = np.bincount(blocks.of_point, weights, len(blocks.first)).astype(np.float64)
    means = np.bincount(blocks.of_point, weights * values, len(blocks.first)) / np.maximum(total, 1e-300)
    return _spread(places, blocks, means, total, _NEAR * side)


def _medians(values: FloatArray, weights: FloatArray, group: IntArray) -> FloatArray:
    """(G,) weighted medians of values (N,) in groups."""
    order = np.lexsort((values, group))
    counts = np.bincount(group)
    ends = np.cumsum(counts)
    below = np.concatenate([[0.0], np.cumsum(weights[order])])
    half = 0.5 * (below[ends - counts] + below[ends])
    medians: FloatArray = values[order][np.clip(np.searchsorted(below[1:], half), ends - counts, ends - 1)]
    return medians


def _blocks(places: FloatArray) -> tuple[Cells, float]:
    lower, upper = np.percentile(places, [1, 99], axis=0)
    side = float((upper - lower).max()) / _BLOCKS
    return cells(places, side, lower), side


def _spread(places: FloatArray, blocks: Cells, values: FloatArray, weights: FloatArray, reach: float) -> FloatArray:
    """(N,) for each place the mean of values (M,) of blocks with weights (M,) under a Gaussian kernel about its own."""
    means = np.stack([blocks.means(places[:, axis]) for axis in range(3)], axis=1)
    apart = np.square(means[:, None] - means[None]).sum(axis=2)
    share = np.exp(-0.5 * apart / reach**2) * weights + 1e-12 * weights.max()
    found: FloatArray = (share @ values / share.sum(axis=1))[blocks.of_point]
    return found
