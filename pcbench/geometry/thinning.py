"""Thin clouds to a share of their points: at random, to one point per voxel, or to points a minimum distance apart."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from pcbench.errors import InputError
from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.neighbors import Index
from pcbench.geometry.sampling import median_spacing
from pcbench.geometry.voxels import voxel_downsample

_MAX_STEPS = 12  # of the search for a voxel side or a disk radius
_SHARE_TOLERANCE = 0.02  # relative
_FIRST_BATCH = 1_000  # points that are decided together first
_RADIUS_SAMPLE = 50_000  # points of the contiguous part in which a disk radius is searched


def thin_at_random(points: FloatArray, share: float, seed: int) -> IntArray:
    """Return the rows (M,), ascending, of a random share of points (N, 3), at least one.

    Raises:
        InputError: the share is not above 0 and at most 1.
    """
    count = _count(len(points), share)
    return np.sort(np.random.default_rng(seed).choice(len(points), count, replace=False))


def thin_by_disks(points: FloatArray, radius: float, seed: int) -> IntArray:
    """Return the rows (M,), ascending, of a random maximal set of points (N, 3) farther apart than `radius`.

    Poisson-disk sampling by dart throwing over the given points (Cook 1986): in random order, a point is kept unless a
    kept one lies within the radius.
    """
    order = np.argsort(np.random.default_rng(seed).permutation(len(points)))
    kept, start = order[:0], 0
    while start < len(order):
        # Later batches are larger, but few of their points lie beyond the radius of all kept ones, however dense the
        # cloud is: the number of neighbours stays proportional to that of the points.
        batch = order[start : start + max(_FIRST_BATCH, start)]
        start += len(batch)
        if len(kept):
            batch = batch[Index(points[kept]).query(points[batch]).distances > radius]
        if len(batch):
            kept = np.concatenate([kept, batch[_throw_darts(points[batch], radius)]])
    return np.sort(kept)


def _throw_darts(points: FloatArray, radius: float) -> NDArray[np.bool_]:
    """Return which points (N, 3) are kept: in their order, those without a kept point within the radius.

    Points that come first among their undecided neighbours are decided together, which gives the same set.
    """
    near = Index(points).query_radius(points, radius)
    one, other = np.repeat(np.arange(len(points)), near.counts), near.indices  # each point is its own neighbour
    undecided, kept = np.ones(len(points), bool), np.zeros(len(points), bool)
    while len(one):
        starts = np.flatnonzero(np.diff(one, prepend=-1))
        rows = one[starts]
        accepted = np.zeros(len(points), bool)
        accepted[rows[np.minimum.reduceat(other, starts) == rows]] = True
        kept |= accepted
        undecided[other[accepted[one]]] = False
        still = undecided[one] & undecided[other]
        one, other = one[still], other[still]
    return kept


def voxel_side_for(points: FloatArray, share: float) -> float:
    """Return the voxel side at which `voxel_downsample` keeps about this share of points (N, 3).

    Raises:
        InputError: the share is not above 0 and at most 1.
    """
    return _search_length(
        lambda side: len(voxel_downsample(points, side)), _count(len(points), share), _first_length(points, share)
    )


def disk_radius_for(points: FloatArray, share: float, seed: int = 0) -> float:
    """Return the radius at which `thin_by_disks` keeps about this share of points (N, 3).

    Of large clouds a compact part of 50,000 points is used.

    Raises:
        InputError: the share is not above 0 and at most 1.
    """
    if len(points) > _RADIUS_SAMPLE:
        points = points[Index(points).query(np.median(points, axis=0)[None], k=_RADIUS_SAMPLE).indices[0]]
    return _search_length(
        lambda radius: len(thin_by_disks(points, radius, seed)),
        _count(len(points), share),
        _first_length(points, share),
    )


def _count(total: int, share: float) -> int:
    if not 0 < share <= 1:
        raise InputError(f"expected a share of points above 0 and at most 1, got {share:g}")
    return max(1, round(share * total))


def _first_length(points: FloatArray, share: float) -> float:
    """Return the length that would fit a surface."""
    return (median_spacing(Index(points)) or 1.0) / math.sqrt(share)


def _search_length(count_at: Callable[[float], int], wanted: int, length: float) -> float:
    """Return the length at which a count that decreases with it is about the wanted one, by bisection of its logarithm.

    Args:
        count_at: number of points that remain at a length.
        wanted: wanted number of points.
        length: first guess.
    """
    low, high = 0.0, math.inf
    for _ in range(_MAX_STEPS):
        count = count_at(length)
        if abs(count - wanted) <= _SHARE_TOLERANCE * wanted:
            break
        if count > wanted:
            low = length
        else:
            high = length
        guess = length * math.sqrt(count / wanted)
        length = guess if low < guess < high else math.sqrt(low * high) if low > 0 and high < math.inf else guess
    return length
