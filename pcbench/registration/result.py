"""What a registration returns: the transform, how well it fits, and what speaks against trusting it.

A registration is a result and never a bare matrix. A matrix cannot say whether the iteration converged, how much of
the candidate lies on the reference, or along which motion the geometry does not determine the pose; all scores that are
computed after it depend on that.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from pcbench.errors import Notice
from pcbench.geometry.transform import Similarity
from pcbench.registration.residuals import PointResidual, SurveyResiduals

# The codes of a registration's warnings: programs decide by these, never by the texts.
FEW_POINTS = "few-points"  # too few points to say what the geometry fixes
UNOBSERVABLE = "unobservable"  # the geometry does not fix some motion at all
WEAKLY_OBSERVABLE = "weakly-observable"  # it hardly fixes some motion
SCALE_MISSING = "scale-missing"  # the residuals ask for a scale that was not solved for
LOW_OVERLAP = "low-overlap"  # little of the candidate lies on the reference
OFF_SURFACE = "off-surface"  # much of what is near the reference floats beside its surface
FAR_OFF = "far-off"  # even the best quarter is far from the reference
NO_CONVERGENCE = "no-convergence"  # the iteration ended before the updates were small
AMBIGUOUS = "ambiguous"  # a clearly different pose fits about as well
UNIT_MISMATCH = "unit-mismatch"  # the extents differ by a factor that looks like a unit
DOUBTFUL_POSE = "doubtful-pose"  # the pose fits little better than those about it

# Those that say that the pose may be wrong. The others speak of how well a right one is known.
_OF_A_WRONG_POSE = frozenset((FEW_POINTS, FAR_OFF, NO_CONVERGENCE, AMBIGUOUS, UNIT_MISMATCH, DOUBTFUL_POSE))


@dataclass(frozen=True, eq=False, repr=False)
class Registration:
    """How the candidate was brought onto the reference, and how far that can be trusted.

    Attributes:
        method: the method's text, such as `icp`.
        T_reference_candidate: maps candidate to reference coordinates.
        T_local: the same motion between coordinates from which the reference's local origin was subtracted (see
            `local_origin`); free of the rounding that large translations bring.
        rmse: root mean square of the residuals (to the tangent plane; for `icp-point` to the point) of an even sample
            of the candidate's points that lie on the reference, Tukey-weighted, in the clouds' unit.
        overlap: share of the voxel-downsampled candidate that lies on the reference: within 5 of its median spacings.
        iterations: of both stages; 0 where nothing was iterated.
        converged: whether the last update was below the noise; None where nothing was iterated.
        information_eigenvalues: of the information matrix of the inliers' point-to-plane pairs per pair, ascending;
            points are centred and divided by their RMS radius, so that rotation and translation share a unit.
        weakest_sigma: predicted standard deviation of the motion that the geometry fixes worst, as a displacement at
            the RMS radius in the clouds' unit, by a bootstrap over tiles of an eighth of the scene; too small by up to
            two thirds where errors are alike over more than half a tile. None where the geometry does not fix it.
        residuals: of the control points and the check points; empty unless the pose was fitted to such pairs.
        warnings: what the user should know before reading any score, as codes (those of this module) with texts.
        solved_scale: whether the scale was estimated from the data. A scale that was given is none of these.
        contrast: what moving the candidate away from the pose costs, as a share of what moving the reference away from
            itself costs: about 1 at a right pose, whatever the scene. None where too few points meet to say.
    """

    method: str
    T_reference_candidate: Similarity
    T_local: Similarity
    rmse: float
    overlap: float
    iterations: int = 0
    converged: bool | None = None
    information_eigenvalues: tuple[float, ...] = ()
    weakest_sigma: float | None = None
    residuals: SurveyResiduals = field(default_factory=SurveyResiduals)
    warnings: tuple[Notice, ...] = ()
    solved_scale: bool = False
    contrast: float | None = None

    @property
    def check_points(self) -> tuple[PointResidual, ...]:
        """The pairs that were measured and not used for the fit."""
        return self.residuals.check

    @property
    def doubtful(self) -> bool:
        """Whether any warning says that the pose may be wrong: then no score that is computed after it can be trusted.

        What the geometry does not fix, a scale that is missing and a small overlap are warned of too; they speak of how
        well a right pose is known, and do not make it doubtful. Nor do points beside the surface: strays and changes
        lie there under a right pose, and what else a wrong one shows is warned of by itself.
        """
        codes = {notice.code for notice in self.warnings}
        if UNOBSERVABLE in codes:
            codes.discard(NO_CONVERGENCE)  # the iteration wanders along what the geometry does not fix
        return bool(codes & _OF_A_WRONG_POSE)

    def __repr__(self) -> str:
        state = {True: "converged", False: "NOT converged", None: "not iterated"}[self.converged]
        parts = [f"{self.method}: {state}", f"rmse {self.rmse:.4g}", f"overlap {self.overlap:.1%}"]
        if self.solved_scale or self.T_reference_candidate.scale != 1:
            parts.append(f"scale {self.T_reference_candidate.scale:.6g} ({'solved' if self.solved_scale else 'given'})")
        if self.warnings:
            parts.append("warnings: " + " ".join(notice.code for notice in self.warnings))
        return f"<Registration {', '.join(parts)}>"
