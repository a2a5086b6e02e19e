"""Result of a registration: the transform, its quality, and reasons not to trust it.

The result is more than a matrix. A matrix does not show whether the iteration converged, how much of the candidate lies
on the reference, or along which motions the geometry does not determine the pose. All later scores depend on these.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from pcbench.errors import Notice
from pcbench.geometry.transform import Similarity
from pcbench.registration.motion import PoseCovariance, RemovedMotion
from pcbench.registration.residuals import PointResidual, SurveyResiduals

# Warning codes of a registration: programs use these, not the texts.
FEW_POINTS = "few-points"  # too few points to determine which motions the geometry constrains
UNOBSERVABLE = "unobservable"  # the geometry does not fix some motion
WEAKLY_OBSERVABLE = "weakly-observable"  # the geometry weakly constrains some motion
SCALE_MISSING = "scale-missing"  # the residuals indicate a scale that was not solved for
LOW_OVERLAP = "low-overlap"  # only a small part of the candidate lies on the reference
OFF_SURFACE = "off-surface"  # many points near the reference float beside its surface
FAR_OFF = "far-off"  # even the nearest quarter is far from the reference
NO_CONVERGENCE = "no-convergence"  # the iteration ended before the updates were small
AMBIGUOUS = "ambiguous"  # a clearly different pose fits about as well
UNKNOWN_SCALE = "unknown-scale"  # the scale was to be solved for, but the geometry does not fix it
UNIT_MISMATCH = "unit-mismatch"  # the extents differ by a ratio of units
DOUBTFUL_POSE = "doubtful-pose"  # the pose fits little better than its surroundings
MIRRORED = "mirrored"  # no rotation aligns the candidate, but its reflection fits
BLURRED = "blurred"  # noise or blur hides how well the pose fits, but restarts return to it

# Codes of warnings about clouds that cannot belong together as they are, even in a given pose.
_IMPLAUSIBLE_CODES = frozenset((FAR_OFF, UNIT_MISMATCH, MIRRORED))
# Codes of warnings that the pose may be wrong. The others limit how accurately a right pose is known.
_DOUBT_CODES = frozenset(
    (FEW_POINTS, FAR_OFF, NO_CONVERGENCE, AMBIGUOUS, UNKNOWN_SCALE, UNIT_MISMATCH, DOUBTFUL_POSE, MIRRORED)
)


@dataclass(frozen=True, eq=False, repr=False)
class Registration:
    """Pose of the candidate on the reference, with its quality and warnings.

    Attributes:
        method: method text, such as `icp`.
        T_reference_candidate: transform from candidate to reference coordinates.
        T_local: the same transform between coordinates minus the reference's local origin (see `local_origin`); free of
            the rounding errors of large translations.
        rmse: Tukey-weighted root mean square of the residuals, in the clouds' unit, over an even sample of the
            candidate points on the reference. Residuals are distances to the tangent plane, for `icp-point` to the
            point.
        overlap: share of the voxel-downsampled candidate that lies on the reference, within `overlap_distance`.
        overlap_distance: 5 median spacings of the reference, in the clouds' unit. If the reference is a mesh, 5 times
            the larger of the candidate's spacing and noise.
        iterations: number of iterations of both stages; 0 if the method does not iterate.
        converged: whether the last update was below the noise; None if the method does not iterate.
        information_eigenvalues: eigenvalues of the information matrix of the inliers' point-to-plane pairs, per pair,
            ascending. Points are centred and divided by their RMS radius, so that rotation and translation share a
            unit.
        weakest_sigma: predicted standard deviation of the motion that the geometry constrains least, in the clouds'
            unit, as a displacement at the RMS radius. Estimated by a bootstrap over tiles of an eighth of the scene;
            too small by up to two thirds if errors are correlated over more than half a tile. None if the geometry does
            not fix it.
        covariance: covariance of the pose, in the reference's coordinates: of ICP from that bootstrap, of control
            points from their residuals. None for a given pose, or if it is unknown.
        shares_crs: whether both clouds state the same coordinate system.
        rms_as_given: RMS distance of a sample of the candidate, in its given coordinates, to the tangent planes of the
            reference; None for a given pose, or where those coordinates have no meaning in the reference.
        residuals: residuals of control and check points; empty unless the pose was fitted to such pairs.
        warnings: warnings to read before any score, as codes (those of this module) with texts.
        solved_scale: whether the scale was estimated from the data. A given scale is not.
        contrast: how much a displacement worsens the candidate's fit, over the same for the reference itself: about 1
            at a right pose, whatever the scene. None if the clouds overlap in too few points, or if no motion changes
            the reference's distances significantly.
        returned_share: share of ICP runs from starts displaced by several spacings that return to the pose. None if no
            restarts were needed.
    """

    method: str
    T_reference_candidate: Similarity
    T_local: Similarity
    rmse: float
    overlap: float
    overlap_distance: float = 0.0
    iterations: int = 0
    converged: bool | None = None
    information_eigenvalues: tuple[float, ...] = ()
    weakest_sigma: float | None = None
    covariance: PoseCovariance | None = None
    shares_crs: bool = False
    rms_as_given: float | None = None
    residuals: SurveyResiduals = field(default_factory=SurveyResiduals)
    warnings: tuple[Notice, ...] = ()
    solved_scale: bool = False
    contrast: float | None = None
    returned_share: float | None = None

    @property
    def is_given(self) -> bool:
        """Return whether the user gave the pose (`none`, `matrix`), so that no data determined it."""
        return self.converged is None and not self.residuals

    @property
    def motion(self) -> RemovedMotion | None:
        """Motion of the candidate that the registration removed; None for a given pose, or if its error is unknown."""
        if self.covariance is None:
            return None
        return RemovedMotion.of(self.T_reference_candidate, self.covariance, self.rmse)

    @property
    def keeps_frame(self) -> bool:
        """Return whether the candidate's given coordinates mean the same as the reference's.

        Both clouds state the same coordinate system, or the given coordinates fit as well up to a shift.
        """
        return self.shares_crs or ((motion := self.motion) is not None and motion.is_shift)

    @property
    def check_points(self) -> tuple[PointResidual, ...]:
        """Residuals of the pairs that were left out of the fit."""
        return self.residuals.check

    @property
    def keeps_pose(self) -> bool:
        """Return whether the pose is the given one (`none`, `matrix`): a remaining motion is then the candidate's."""
        return self.method.partition(":")[0] in ("none", "matrix")

    @property
    def doubtful(self) -> bool:
        """Return whether any warning says that the pose may be wrong: then no later score can be trusted."""
        return bool(self.doubts)

    @property
    def is_ranked(self) -> bool:
        """Return whether scores under this pose are stated and ranked: it is not doubtful, or the user vouches for it.

        Who gives a pose (`none`, `matrix`), as all benchmarks do, asks for the distances in it. Doubts are then notes,
        and only what cannot be meant stays a warning, such as another unit.
        """
        return self.keeps_pose or not self.doubtful

    @property
    def notes(self) -> tuple[Notice, ...]:
        """Doubts about a pose that the user gave and vouches for."""
        return tuple(doubt for doubt in self.doubts if self.keeps_pose and doubt.code not in _IMPLAUSIBLE_CODES)

    @property
    def doubts(self) -> tuple[Notice, ...]:
        """Warnings that the pose may be wrong.

        Unobservable motions, a missing scale and a small overlap do not make a pose doubtful: they limit how accurately
        a right pose is known. Neither do points beside the surface: outliers and changes cause them under a right pose,
        and a wrong pose causes other warnings too.
        """
        codes = _DOUBT_CODES
        if any(notice.code == UNOBSERVABLE for notice in self.warnings):
            codes = codes - {NO_CONVERGENCE}  # the iteration drifts along unobservable motions
        return tuple(notice for notice in self.warnings if notice.code in codes)

    def __repr__(self) -> str:
        state = {True: "converged", False: "NOT converged", None: "not iterated"}[self.converged]
        parts = [f"{self.method}: {state}", f"rmse {self.rmse:.4g}", f"overlap {self.overlap:.1%}"]
        if self.solved_scale or self.T_reference_candidate.scale != 1:
            parts.append(f"scale {self.T_reference_candidate.scale:.6g} ({'solved' if self.solved_scale else 'given'})")
        if self.warnings:
            parts.append("warnings: " + " ".join(notice.code for notice in self.warnings))
        return f"<Registration {', '.join(parts)}>"
