"""Correspondences of candidate points with reference points, their residuals and weights."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.neighbors import Matches
from pcbench.geometry.normals import Surface
from pcbench.native import _core

MIN_POINTS = 10  # needed to fit a pose, and to assess it


class WeightedPairs(NamedTuple):
    """Weighted correspondences at one pose; ICP minimises their residuals."""

    moved: FloatArray  # (M, 3) candidate points in the reference frame
    indices: IntArray  # (M,) rows of the matched reference points
    distances: FloatArray  # (M,) point to point
    residuals: FloatArray  # (M,) signed, along the reference's normals
    weights: FloatArray  # (M,) in [0, 1]
    near_count: int  # pairs within the maximum correspondence distance; the others have weight zero
    sigma: float  # robust standard deviation of the residuals of these near pairs

    def take(self, which: NDArray[np.bool_] | slice) -> WeightedPairs:
        """Return the pairs of some rows, with `near_count` and `sigma` unchanged."""
        return self._replace(
            moved=self.moved[which],
            indices=self.indices[which],
            distances=self.distances[which],
            residuals=self.residuals[which],
            weights=self.weights[which],
        )


def weigh(
    target: Surface, moved: FloatArray, nearest: Matches, max_distance: float, *, robust: bool, kept_share: float = 1.0
) -> WeightedPairs:
    """Weight pairs within the maximum correspondence distance, and compute residuals to the tangent planes.

    Args:
        target: surface that the points are matched with.
        moved: (M, 3) candidate points in the target's frame.
        nearest: target points closest to them.
        max_distance: maximum correspondence distance in the target's unit; pairs beyond it have weight zero.
        robust: whether to use Tukey's biweight, whose width follows the residuals; else the nearest pairs weigh 1.
        kept_share: share of the pairs within the maximum distance that are used if the weights are not robust.
    """
    distances, indices = nearest
    normals = target.compute_normals(indices)
    residuals, weights = np.empty(len(moved)), np.empty(len(moved))
    near_count, sigma = _core.weigh(
        moved, distances, target.points, indices, normals, max_distance, robust, kept_share, residuals, weights
    )
    return WeightedPairs(moved, indices, distances, residuals, weights, near_count, sigma)
