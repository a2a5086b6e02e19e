"""How far a mean would move on another, equally large piece of the scene: spatial block bootstrap.

Neighbouring distances are alike, so points are no independent sample. Blocks of space are resampled instead, the
same ones in both directions and for every candidate, so that differences between candidates have intervals too. The
registration is taken as it is, and maxima get no interval.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pcbench.geometry.arrays import FloatArray, IntArray, bounds
from pcbench.geometry.voxels import cells, robust_extent

REPLICATES = 1000
LEVEL = 0.95
_BLOCKS_ALONG = 10  # a side of the scene


class Interval(NamedTuple):
    """A 95 % interval by the spatial block bootstrap."""

    low: float
    high: float


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
    blocks = cells(points, side)
    # Numbered by their place, not by the order of the points, which must not decide which block gets which weight.
    place = np.floor((points[blocks.first] - bounds(points)[0]) / side)
    number = np.empty(len(place), np.int64)
    number[np.lexsort(place.T[::-1])] = np.arange(len(place))
    weights = np.random.default_rng(seed).exponential(size=(REPLICATES, len(place)))
    return Blocks(number[blocks.of_point], weights, side)


def replicate_sums(blocks: IntArray, values: FloatArray | None, weights: FloatArray) -> FloatArray:
    """Sums (R,) of `values` (N,), or of ones, whose points lie in `blocks` (N,), under each replicate's weights."""
    per_block = np.bincount(blocks, values, weights.shape[1]).astype(np.float64)
    sums: FloatArray = np.einsum("rb,b->r", weights, per_block)  # einsum: same bits at any number of threads
    return sums


def interval(replicates: FloatArray) -> Interval:
    """The percentile interval of replicates (R,) at LEVEL."""
    tail = 50 * (1 - LEVEL)
    low, high = np.percentile(replicates, [tail, 100 - tail])
    return Interval(float(low), float(high))
