"""Isolated points: those whose neighbours are much farther away than the neighbours of their neighbours.

The statistical filter of Rusu et al. 2008 compares the distances with those of the whole cloud, so that it removes
the far parts of a sweep, whose density falls with distance. Here, as in the local outlier factor (Breunig et al.
2000), they are compared with those around: a point is an outlier if the distance to its 8th neighbour is more than 4
times the median of that distance over its 8 neighbours. PointGroups of up to 7 points are found, too.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.neighbors import Index

NEIGHBORS = 8
"""Number of neighbours of a point."""
MAX_RATIO = 4.0
"""Ratio of distances beyond which a point is an outlier."""
_SCREEN_RATIO = 2.0  # to the spacing around, below which a point need not be looked at


class Outliers(NamedTuple):
    """The isolated points of a cloud.

    Attributes:
        number: how many there are.
        share: their share of all points.
    """

    number: int
    share: float


def find_outliers(index: Index, copies: float) -> tuple[Outliers, NDArray[np.bool_]]:
    """Return the isolated points of a cloud, and their mask (N,).

    Args:
        index: index of the points.
        copies: mean number of points at a position, by which the number of neighbours is multiplied.
    """
    neighbors = max(NEIGHBORS, round(NEIGHBORS * copies))
    k = 1 + neighbors
    mask = np.zeros(len(index), dtype=bool)
    if len(index) < 4 * k:
        return Outliers(0, 0.0), mask
    reach = index.local_planes(k).reach
    suspects = np.flatnonzero(reach > _SCREEN_RATIO * _typical(reach))
    step = max(2_000_000 // k, 1)
    for start in range(0, len(suspects), step):
        rows = suspects[start : start + step]
        distances, near = index.query(index.points[rows], k)
        around = np.median(reach[near[:, 1:]], axis=1)
        mask[rows] = distances[:, -1] > MAX_RATIO * around
    count = int(np.count_nonzero(mask))
    return Outliers(count, count / len(index)), mask


def _typical(reach: NDArray[np.float64]) -> float:
    """Return a distance that few outliers are below: the smallest decile."""
    return float(np.percentile(reach, 10))
