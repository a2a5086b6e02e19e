"""Correspondences of candidate points with reference points, their residuals, and how much each of them counts."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.neighbors import Matches
from pcbench.geometry.normals import Surface
from pcbench.native import _core


class WeightedPairs(NamedTuple):
    """Weighted correspondences at one pose; the residuals are what ICP minimises."""

    moved: FloatArray  # (M, 3) candidate points in the reference frame
    indices: IntArray  # (M,) of the reference points they are matched with
    distances: FloatArray  # (M,) point to point
    residuals: FloatArray  # (M,) signed, along the reference's normals
    weights: FloatArray  # (M,) in [0, 1]
    near: int  # of them lie within the maximum correspondence distance; the others weigh nothing
    sigma: float  # robust standard deviation of the residuals of those

    def take(self, which: NDArray[np.bool_] | slice) -> WeightedPairs:
        """The pairs of some rows, with `near` and `sigma` as they were."""
        return self._replace(
            moved=self.moved[which],
            indices=self.indices[which],
            distances=self.distances[which],
            residuals=self.residuals[which],
            weights=self.weights[which],
        )


def weigh(
    target: Surface, moved: FloatArray, nearest: Matches, max_distance: float, *, robust: bool, kept: float = 1.0
) -> WeightedPairs:
    """Weights of pairs that lie within the maximum correspondence distance, and residuals to the tangent planes.

    Args:
        target: what the points are matched with.
        moved: (M, 3) candidate points in the target's frame.
        nearest: the target's points that are nearest to them.
        max_distance: the maximum correspondence distance, in the target's unit: pairs beyond it weigh nothing.
        robust: Tukey's biweight, whose width follows the residuals; else 1 for the nearest pairs.
        kept: the share of the pairs within reach that counts where the weights are not robust.
    """
    distances, indices = nearest
    normals = target.with_normals_at(indices)
    residuals, weights = np.empty(len(moved)), np.empty(len(moved))
    near, sigma = _core.weigh(
        moved, distances, target.points, indices, normals, max_distance, robust, kept, residuals, weights
    )
    return WeightedPairs(moved, indices, distances, residuals, weights, near, sigma)
