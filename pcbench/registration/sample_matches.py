"""Correspondences of a candidate's sample at one pose: which points lie on the reference, near it, or far from it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.neighbors import Index, Matches
from pcbench.geometry.order_statistics import robust_sigma
from pcbench.geometry.sampling import line_gaps
from pcbench.geometry.transform import Similarity
from pcbench.registration.target import MIN_EXTENT, Target
from pcbench.registration.weighted_pairs import WeightedPairs, weigh

MAX_SPACINGS_ON_SURFACE = 5  # a candidate point within this many reference spacings lies on the reference
NEAR_EXTENT_SHARE = 0.05  # of the extent: within this distance a point may have a counterpart

_SPARSE_NEIGHBORS = 8  # 99.9 % of random places of a surface are nearer to a point than its 8th neighbour
_LINE_GAP_SHARE = 0.75  # points between two lines are nearer to one of them than half the gap, which varies


class SampleMatches(NamedTuple):
    """Correspondences of the candidate's sample of M points at one pose."""

    target: Target
    moved: FloatArray  # (M, 3) candidate points in the reference frame
    nearest: Matches  # reference points closest to them
    max_on_surface: float  # distance up to which a point lies on the reference, where its density is typical
    sparse_reach: FloatArray  # (M,) the same where it is sparse
    on_surface: WeightedPairs | None  # weighted up to that distance; None if the reference has no surface
    informing: WeightedPairs | None  # weighted up to the distance that the fit may have used; None likewise

    @property
    def overlap(self) -> float:
        """Share of the candidate that lies on the reference."""
        return float(np.mean(self.nearest.distances <= np.maximum(self.max_on_surface, self.sparse_reach)))

    @property
    def max_near(self) -> float:
        """Distance up to which a point may have a counterpart."""
        return max(NEAR_EXTENT_SHARE * self.target.extent, self.max_on_surface)

    @property
    def is_near(self) -> NDArray[np.bool_]:
        """(M,) whether a point may have a counterpart.

        Parts missing in the reference lie far from it; a wrong pose leaves points beside their counterparts.
        """
        near: NDArray[np.bool_] = self.nearest.distances <= self.max_near
        return near

    @property
    def off_surface(self) -> float:
        """Share of the points near the reference that do not lie on it.

        Tangent planes bridge areas that the reference samples sparsely, such as the gaps between scan lines.
        """
        near = self.is_near
        distances = self.nearest.distances if self.on_surface is None else np.abs(self.on_surface.residuals)
        return 1 - float(np.mean((distances <= self.max_on_surface)[near])) if near.any() else 1.0

    @property
    def nearest_quarter(self) -> float:
        """First quartile of the distances, so that partial overlap is not taken for a failure."""
        return float(np.percentile(self.nearest.distances, 25))


def match_sample(target: Target, sample: Index, T: Similarity, hint: IntArray | None) -> SampleMatches:
    """Match the candidate's sample at a pose with the reference, and weight the pairs for two maximum distances.

    Args:
        target: reference.
        sample: the sample.
        T: pose of the candidate.
        hint: rows (M,) of reference points near the closest ones, if known.
    """
    surface, spacing = target.surface, target.spacing
    moved, nearest = surface.index.nearest_of_moved(sample, T.matrix, hint)
    distances = nearest.distances
    # The same distance for all methods: if it followed the fit, a worse fit would count more points as overlap.
    max_on_surface = MAX_SPACINGS_ON_SURFACE * spacing
    if len(surface) < 3 or target.extent <= MIN_EXTENT:
        return SampleMatches(target, moved, nearest, max_on_surface, np.zeros(len(moved)), None, None)
    # Observability uses all pairs that the fit may have used: if the density varies, these are farther apart.
    reach = float(np.clip(3 * robust_sigma(distances[distances <= np.median(distances)]), 3 * spacing, 10 * spacing))
    on_surface, informing = (weigh(surface, moved, nearest, d, robust=True) for d in (max_on_surface, reach))
    sparse_reach = _sparse_reach(target, nearest, max_on_surface)
    return SampleMatches(target, moved, nearest, max_on_surface, sparse_reach, on_surface, informing)


def _sparse_reach(target: Target, nearest: Matches, max_on_surface: float) -> FloatArray:
    """Return the distance (M,) up to which points lie on the reference where it is sparse; else 0.

    It is the distance of an outer neighbour of the closest reference point, within which nearly all points of the
    surface have a reference point. Between scan lines, it is most of the gap. An outlier, which has no neighbours, does
    not reach farther than a point may have a counterpart.
    """
    reach = np.zeros(len(nearest.distances))
    longest = NEAR_EXTENT_SHARE * target.extent
    unclear = np.flatnonzero((nearest.distances > max_on_surface) & (nearest.distances <= longest))
    if len(unclear):
        rows, of_point = np.unique(nearest.indices[unclear], return_inverse=True)
        index, sampling = target.surface.index, target.surface.sampling
        points = index.points[rows]
        k = min(sampling.neighbors(1 + _SPARSE_NEIGHBORS), len(index))
        reached = index.query(points, k).distances[:, -1]
        if sampling.has_lines:
            reached = np.maximum(reached, _LINE_GAP_SHARE * np.linalg.norm(line_gaps(index, points), axis=1))
        reach[unclear] = np.minimum(reached, longest)[of_point]
    return reach
