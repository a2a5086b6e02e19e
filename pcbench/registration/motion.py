"""Small motions of a candidate: the frame they refer to, and the covariance of a pose."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pcbench.geometry.arrays import FloatArray

_MAX_UNOBSERVABLE_SHARE = 0.01  # of a squared displacement: a tenth of the displacement itself


class MotionFrame(NamedTuple):
    """Centre (3,) and radius to which motions refer: rotations and the log-scale are lengths at the radius."""

    center: FloatArray
    radius: float

    @classmethod
    def of(cls, points: FloatArray, weights: FloatArray) -> MotionFrame:
        """Return the weighted centre and RMS radius of points (M, 3)."""
        total = weights.sum()
        center = (points * weights[:, None]).sum(axis=0) / total
        squares = np.square(points - center).sum(axis=1)
        return cls(center, float(np.sqrt((squares * weights).sum() / total)) or 1.0)

    def jacobian(self, points: FloatArray, directions: FloatArray) -> FloatArray:
        """Return rows (M, 7): displacement of points along directions by rotation, translation and log-scale."""
        offsets = points - self.center
        scale_column = np.einsum("ni,ni->n", offsets, directions)[:, None]
        return np.hstack([np.cross(offsets, directions) / self.radius, directions, scale_column / self.radius])


class PoseCovariance(NamedTuple):
    """Covariance of a pose, as small motions of the candidate.

    Attributes:
        frame: centre and radius of the motions, in the same coordinates as the points of `sigma_along`.
        matrix: (K, K) covariance of rotation (3), translation (3) and, with K = 7, log-scale, in squared units; zero
            along motions that the geometry does not fix.
        unobservable: (K, U) orthonormal motions that the geometry does not fix.
    """

    frame: MotionFrame
    matrix: FloatArray
    unobservable: FloatArray

    def sigma_along(self, points: FloatArray, directions: FloatArray) -> FloatArray:
        """Return the standard errors (M,) of the positions of points (M, 3) along unit directions (M, 3).

        They are infinite where a motion that the geometry does not fix displaces a point along its direction.
        """
        rows = self.frame.jacobian(points, directions)[:, : len(self.matrix)]
        variances = np.einsum("ni,ij,nj->n", rows, self.matrix, rows, optimize=False)
        unknown = np.square(rows @ self.unobservable).sum(axis=1) > _MAX_UNOBSERVABLE_SHARE * np.square(rows).sum(
            axis=1
        )
        return np.where(unknown, np.inf, np.sqrt(np.maximum(variances, 0.0)))

    def shifted(self, shift: FloatArray) -> PoseCovariance:
        """Return the same covariance in coordinates to which `shift` (3,) was added."""
        return self._replace(frame=self.frame._replace(center=self.frame.center + shift))

    @property
    def weakest(self) -> tuple[float, FloatArray]:
        """Standard error of the motion that is known worst among the observable ones, and that motion (K,)."""
        variances, directions = np.linalg.eigh(self.matrix)
        return float(np.sqrt(max(variances[-1], 0.0))), directions[:, -1]
