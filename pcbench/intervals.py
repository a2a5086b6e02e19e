"""How far a mean would move on another, equally large piece of the scene: spatial block bootstrap.

Neighbouring distances are alike, so points are no independent sample. Blocks of space are resampled instead, the
same ones in both directions and for every candidate, so that differences between candidates have intervals too. The
registration is taken as it is, and maxima get no interval.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from pcbench.neighbors import FloatArray, IntArray
from pcbench.voxels import cell_keys, robust_extent

REPLICATES = 1000
LEVEL = 0.95
_BLOCKS_ALONG = 10  # a side of the scene


class Blocks(NamedTuple):
    """A partition of the reference into cubes."""

    of_point: IntArray  # (N,) the block of each point
    weights: FloatArray  # (REPLICATES, B) of the blocks in each replicate
    side: float  # of the cubes


def partition(points: FloatArray, seed: int) -> Blocks:
    """Cut reference points (N, 3) into cubes of a tenth of the scene's extent and draw the replicates' weights.

    Weights are exponential (the Bayesian bootstrap, Rubin 1981): no replicate lacks a block altogether, and a block's
    weight does not depend on which other blocks a candidate reaches.
    """
    side = robust_extent(points) / _BLOCKS_ALONG
    if not side > 0:  # all points at one place
        return Blocks(np.zeros(len(points), dtype=np.int64), np.ones((REPLICATES, 1)), 0.0)
    keys, of_point = np.unique(cell_keys(points, side, points.min(axis=0)), return_inverse=True)
    return Blocks(of_point, np.random.default_rng(seed).exponential(size=(REPLICATES, len(keys))), side)


def replicate_means(blocks: IntArray, values: Mapping[str, FloatArray], weights: FloatArray) -> dict[str, FloatArray]:
    """The mean of each of `values` (N,), whose points lie in `blocks` (N,), under each replicate's block weights."""

    def weighted(per_block: FloatArray) -> FloatArray:
        total: FloatArray = np.einsum("rb,b->r", weights, per_block)  # einsum: same bits at any number of threads
        return total

    size = weights.shape[1]
    count = weighted(np.bincount(blocks, minlength=size).astype(np.float64))
    sums = {name: np.bincount(blocks, value, minlength=size).astype(np.float64) for name, value in values.items()}
    return {name: weighted(per_block) / count for name, per_block in sums.items()}


def interval(replicates: FloatArray) -> list[float]:
    """[low, high] percentile interval at LEVEL."""
    tail = 50 * (1 - LEVEL)
    low, high = np.percentile(replicates, [tail, 100 - tail])
    return [float(low), float(high)]
