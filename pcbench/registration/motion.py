"""Motions of a candidate: the covariance of its pose, and the motion that registration removed."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.transform import Similarity

_Z95 = 1.96  # half width of a 95 % interval, in standard errors
_Z95_OF_THREE = 2.39  # the same, if none of three components may be outside
_NEGLIGIBLE_NOISE_SHARE = 0.1  # of the residuals: smaller motions change no score
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
        return self._sigmas(self.frame.jacobian(points, directions)[:, : len(self.matrix)])

    def sigma_of(self, motion: FloatArray) -> float:
        """Return the standard error of the component of the motion along a row (K,); infinite if it is unknown."""
        return float(self._sigmas(motion[None])[0])

    def _sigmas(self, rows: FloatArray) -> FloatArray:
        variances = np.einsum("ni,ij,nj->n", rows, self.matrix, rows, optimize=False)
        shares = np.square(rows @ self.unobservable).sum(axis=1) / np.square(rows).sum(axis=1)
        return np.where(shares > _MAX_UNOBSERVABLE_SHARE, np.inf, np.sqrt(np.maximum(variances, 0.0)))

    def shifted(self, shift: FloatArray) -> PoseCovariance:
        """Return the same covariance in coordinates to which `shift` (3,) was added."""
        return self._replace(frame=self.frame._replace(center=self.frame.center + shift))

    @property
    def weakest(self) -> tuple[float, FloatArray]:
        """Standard error of the motion that is known worst among the observable ones, and that motion (K,)."""
        variances, directions = np.linalg.eigh(self.matrix)
        return float(np.sqrt(max(variances[-1], 0.0))), directions[:, -1]


@dataclass(frozen=True, eq=False)
class RemovedMotion:
    """Motion of the candidate from its given coordinates to the registered ones.

    Attributes:
        center: (3,) centre of the overlap, in the reference's coordinates, where the motion is stated.
        shift: (3,) displacement of the candidate's point that registration moved to the centre.
        shift_sigma: (3,) its standard errors; infinite along an axis that the geometry does not fix.
        significant_shift: (3,) the shift, with zeros for components that do not exceed both their errors and a tenth of
            the noise.
        size_sigma: standard error of the length of the significant shift.
        angle_deg: angle of the rotation, in degrees.
        angle_sigma_deg: its standard error; infinite if the geometry does not fix it.
        axis: (3,) unit axis of the rotation; None without a rotation.
        scale: factor of the scale.
        noise: RMSE of the registration's residuals, in the clouds' unit.
        radius: RMS distance of the overlap from its centre, where turning and scaling are compared with the noise.
    """

    center: FloatArray
    shift: FloatArray
    shift_sigma: FloatArray
    significant_shift: FloatArray
    size_sigma: float
    angle_deg: float
    angle_sigma_deg: float
    axis: FloatArray | None
    scale: float
    noise: float
    radius: float

    @classmethod
    def of(cls, T: Similarity, covariance: PoseCovariance, noise: float) -> RemovedMotion:
        """Return the motion of a pose candidate -> reference with this covariance and these residuals."""
        center = covariance.frame.center
        motion = T.motion_at(T.inverse().apply(center[None])[0])
        shift_sigma = covariance.sigma_along(np.repeat(center[None], 3, axis=0), np.eye(3))
        least = np.maximum(_Z95_OF_THREE * shift_sigma, _NEGLIGIBLE_NOISE_SHARE * noise)
        significant = np.where(np.abs(motion.shift) > least, motion.shift, 0.0)
        size = float(np.linalg.norm(significant))
        size_sigma = covariance.sigma_along(center[None], significant[None] / size)[0] if size > 0 else 0.0
        turn_sigma = 0.0
        if motion.axis is not None:
            turn = np.zeros(len(covariance.matrix))
            turn[:3] = motion.axis
            turn_sigma = covariance.sigma_of(turn)
        return cls(
            center=center,
            shift=motion.shift,
            shift_sigma=shift_sigma,
            significant_shift=significant,
            size_sigma=float(size_sigma),
            angle_deg=motion.angle_deg,
            angle_sigma_deg=math.degrees(turn_sigma / covariance.frame.radius),
            axis=motion.axis,
            scale=motion.scale,
            noise=noise,
            radius=covariance.frame.radius,
        )

    @property
    def size(self) -> float:
        """Length of the significant shift, in the clouds' unit; 0 if no component is significant."""
        return float(np.linalg.norm(self.significant_shift))

    @property
    def half_width(self) -> float:
        """Half of the width of the 95 % confidence interval of that length."""
        return _Z95 * self.size_sigma

    @property
    def is_shift(self) -> bool:
        """Return whether the candidate's given coordinates fit as well up to a shift.

        Turning and scaling then displace the overlap by less than the residuals or their own errors, and the shift is
        smaller than the overlap.
        """
        turn, of_turn = (math.radians(angle) * self.radius for angle in (self.angle_deg, self.angle_sigma_deg))
        stretch = abs(math.log(self.scale)) * self.radius
        largest = max(self.noise, _Z95_OF_THREE * of_turn)
        return math.hypot(turn, stretch) <= largest and self.size < self.radius
