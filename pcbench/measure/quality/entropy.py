"""Mean map entropy and mean plane variance: how blurred a map is.

For each point with at least k points within r (itself included), with their covariance S (divisor n - 1) and its
smallest eigenvalue l:

- mean map entropy: mean of 0.5 ln det(2 pi e S) (Droeschel, Stueckler, Behnke 2014, eq. 7; Razlaw et al. 2015, eq. 1)
- mean plane variance: mean of l (Kornilova & Ferrer 2021, eq. 4). Razlaw et al. take the upper quartile of the
  distances to a plane instead.

Both depend on r and on the density, so they compare maps of the same place with the same r and density. The entropy has
the logarithm of a cubed length: another unit of length shifts it by 3 ln of the ratio of the units.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.neighbors import Index
from pcbench.measure.intervals import partition
from pcbench.measure.quality.bootstrap import BlockEstimate, mean_estimate
from pcbench.measure.quality.groups import PointGroups

SAMPLE = 20_000
"""Points at which entropy is computed, at most; the mean over a random sample has an interval."""
_CHUNK_ROWS = 2_000_000
_MAX_MEAN_POINTS = 2_000.0
_MIN_EIGENVALUE_SHARE = 1e-13  # smallest over largest eigenvalue: below it, the points lie in a plane up to rounding


class MapEntropy(NamedTuple):
    """Mean map entropy and mean plane variance.

    Attributes:
        entropy: mean map entropy, in nats.
        plane_variance: mean plane variance, in squared units.
        radius: radius of the neighbourhoods.
        min_neighbors: least number of their points.
        mean_neighbors: mean number of points of the neighbourhoods.
        used_share: share of the points that have enough neighbours, not all in one plane.
        sample: number of points at which it was computed.
    """

    entropy: BlockEstimate
    plane_variance: BlockEstimate
    radius: float
    min_neighbors: int
    mean_neighbors: float
    used_share: float
    sample: int


def map_entropy(index: Index, radius: float, min_neighbors: int, seed: int, sample: int = SAMPLE) -> MapEntropy | None:
    """Return mean map entropy and mean plane variance; None if too few points have enough neighbours.

    Args:
        index: index of the points.
        radius: radius of the neighbourhoods.
        min_neighbors: least number of points, the point itself included.
        seed: seed of the sample and of the bootstrap.
        sample: number of points at which they are computed, at most.
    """
    rng = np.random.default_rng(seed)
    points = index.points
    rows = np.arange(len(points))
    mean = float(index.query_radius(points[rng.integers(0, len(points), 64)], radius).counts.mean())
    most = max(int(sample * min(1.0, _MAX_MEAN_POINTS / max(mean, 1.0))), 100)
    if len(rows) > most:
        rows = np.sort(rng.choice(rows, most, replace=False))
    entropies, variances, numbers = (np.full(len(rows), math.nan) for _ in range(3))
    step = max(int(_CHUNK_ROWS / max(mean, 1.0)), 1)
    for start in range(0, len(rows), step):
        part = slice(start, start + step)
        centres = points[rows[part]]
        groups = PointGroups.of(index.query_radius(centres, radius), points)
        entropies[part], variances[part] = _measures(groups, centres)
        numbers[part] = groups.counts
    used = (numbers >= min_neighbors) & np.isfinite(entropies)
    if not used.any():
        return None
    blocks = partition(points[rows]).of_point[used]
    entropy, variance = mean_estimate(entropies[used], blocks, seed), mean_estimate(variances[used], blocks, seed)
    assert entropy is not None and variance is not None
    return MapEntropy(
        entropy, variance, radius, min_neighbors, float(numbers[used].mean()), float(used.mean()), len(rows)
    )


def _measures(groups: PointGroups, centres: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the entropy (G,), NaN where the points lie in a plane, and the smallest eigenvalue (G,) of each group."""
    offsets = groups.values - centres[groups.of_row]
    _, values, _ = groups.principal_axes(offsets, np.ones(len(offsets)))
    values *= (groups.counts / np.maximum(groups.counts - 1, 1))[:, None]
    values = np.maximum(values, 0)
    is_solid = values[:, 0] > _MIN_EIGENVALUE_SHARE * values[:, 2]
    logarithms = np.log(np.where(is_solid[:, None], values, 1.0)).sum(axis=1)
    entropies = np.where(is_solid, 0.5 * (3 * math.log(2 * math.pi * math.e) + logarithms), math.nan)
    return entropies, values[:, 0]
