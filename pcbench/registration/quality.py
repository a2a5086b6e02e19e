"""How well a pose fits: the same questions for every method, so that their answers can be compared."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.errors import Notice, RegistrationError
from pcbench.geometry.arrays import FloatArray, IntArray, bounds
from pcbench.geometry.neighbors import Index, Matches
from pcbench.geometry.transform import Similarity
from pcbench.geometry.voxels import voxel_downsample_to
from pcbench.registration.advice import align_coarsely
from pcbench.registration.contrast import LEAST, SURE, Contrast, contrast
from pcbench.registration.degeneracy import Observability, observability
from pcbench.registration.result import DOUBTFUL_POSE, FAR_OFF, FEW_POINTS, LOW_OVERLAP, OFF_SURFACE, WEAKLY_OBSERVABLE
from pcbench.registration.target import Target
from pcbench.registration.weighted_pairs import WeightedPairs, weigh

MIN_EXTENT = 1e-150  # of a reference: squares of less are lost
MIN_POINTS = 10  # that a fit is judged by
MAX_OFF_SURFACE = 0.25  # share of the candidate near the reference that does not lie on it, before others are tried

_MAX_SAMPLE = 30_000  # candidate points that a given pose is judged by
_MAX_SPACINGS_ON_SURFACE = 5  # of the reference: a candidate point nearer than that lies on it
_MAX_NEAR = 0.05  # of the extent: where a point has its counterpart, if there is one
_MIN_OVERLAP = 0.3  # before a small one is said
_MIN_FELT, _WHOLE_OVERLAP = 0.015, 0.95  # see `Contrast.felt`, and the overlap above which nothing is left to meet
_MAX_HOVERING = 0.1  # share of the candidate near the reference that floats beside its surface, before that is said
_SIGMAS_OFF = 4.0  # of the residuals: what floats is farther off than noise is
_MIN_UPRIGHT = 0.9  # cosine to the normal: what floats, and does not lie beyond the surface's end
_MAX_SPACINGS_OFF = 10  # of the candidate's nearest quarter, before that is said


class Quality(NamedTuple):
    """What is known of a pose; `Registration` explains the numbers."""

    rmse: float
    overlap: float
    off_surface: float  # share of the points near the reference that do not lie on it
    contrast: float | None  # of the reference's own, see `contrast`; None where too few points meet
    eigenvalues: tuple[float, ...]
    weakest_sigma: float | None
    unobservable: FloatArray  # (6 or 7, U) orthonormal motions that the geometry does not fix
    warnings: tuple[Notice, ...]


class Fit(NamedTuple):
    """A pose between local coordinates (those minus the reference's local origin), and what is known of it."""

    T_local: Similarity
    quality: Quality
    iterations: int = 0
    converged: bool | None = None


def assess(
    target: Target,
    sample: Index,
    T: Similarity,
    *,
    plane: bool,
    with_scale: bool,
    hint: IntArray | None = None,
    given: bool = False,
) -> Quality:
    """Residual, overlap and what the geometry fixes, at a pose that is taken as it is.

    Args:
        target: the reference.
        sample: an even sample of the candidate's points, minus the reference's local origin.
        T: the pose between local coordinates.
        plane: whether the RMSE is of distances to tangent planes, or to points.
        with_scale: whether the scale is one of the motions that the geometry has to fix.
        hint: the reference's points that the sample's were nearest to last, where the search starts.
        given: whether the pose is from elsewhere, so that a blurred cloud explains as much as a wrong pose.
    """
    matched = _match(target, sample, T, hint)
    on_surface, informing = _counted(matched.on_surface), _counted(matched.informing)
    if matched.on_surface is None or on_surface is None or informing is None:
        return _too_few(matched, with_scale=with_scale)
    observed = observability(target.surface, informing, with_scale=with_scale)
    sharp = contrast(
        target.surface,
        matched.moved,
        matched.nearest,
        np.flatnonzero(matched.is_near),
        sigma=on_surface.sigma,
        spacing=target.spacing,
        extent=target.extent,
        with_scale=with_scale,
    )
    hovering = _hovering_share(matched, matched.on_surface)
    return Quality(
        rmse=_weighted_rmse(on_surface, plane=plane),
        overlap=matched.overlap,
        off_surface=matched.off_surface,
        contrast=None if sharp is None else sharp.share,
        eigenvalues=observed.eigenvalues,
        weakest_sigma=observed.weakest_sigma,
        unobservable=observed.unobservable,
        warnings=_warnings(matched, observed, sharp, hovering, given=given),
    )


def assess_given(target: Target, points: FloatArray, T_local: Similarity, origin: FloatArray, text: str) -> Fit:
    """A pose from elsewhere, assessed like one that was fitted here.

    Args:
        target: the reference.
        points: (N, 3) of the candidate, minus the reference's local origin.
        T_local: the pose between local coordinates.
        origin: (3,) the local origin, which the message of a refusal adds again.
        text: of the method, for that message.

    Raises:
        RegistrationError: the bounding boxes lie apart.
    """
    surface = target.surface
    if target.spacing > 0:
        start = max(target.extent / 500, target.spacing)
        sample = Index(points[voxel_downsample_to(points, _MAX_SAMPLE, start=start)])
    else:
        sample = Index(points[:_MAX_SAMPLE])
    moved = T_local.apply(sample.points)
    lower, upper = bounds(surface.points)
    margin = 0.1 * float(np.linalg.norm(upper - lower))
    # Fewer than three points have no extent to overlap with.
    if len(surface) >= 3 and ((moved.min(axis=0) > upper + margin).any() or (moved.max(axis=0) < lower - margin).any()):
        raise RegistrationError(
            f"the candidate does not overlap the reference after --register {text}: their bounding boxes lie apart"
            f" (reference centre {_format(origin)}, candidate centre {_format(moved.mean(axis=0) + origin)}):"
            f" {align_coarsely()}"
        )
    return Fit(T_local, assess(target, sample, T_local, plane=True, with_scale=T_local.scale != 1, given=True))


class _SampleMatches(NamedTuple):
    """Correspondences of the candidate's sample of M points at one pose, from which the fit is measured."""

    target: Target
    moved: FloatArray  # (M, 3) candidate points in the reference frame
    nearest: Matches  # the reference's points nearest to them
    max_on_surface: float  # distance up to which a point lies on the reference
    on_surface: WeightedPairs | None  # weighted up to that distance; None where the reference has no surface
    informing: WeightedPairs | None  # weighted up to the distance that the fit may have used; None like the above

    @property
    def overlap(self) -> float:
        """Share of the candidate that lies on the reference."""
        return float(np.mean(self.nearest.distances <= self.max_on_surface))

    @property
    def is_near(self) -> NDArray[np.bool_]:
        """(M,) whether a point may have a counterpart.

        A part that the reference does not have lies far from it; a wrong pose leaves points beside their counterparts.
        """
        near: NDArray[np.bool_] = self.nearest.distances <= max(_MAX_NEAR * self.target.extent, self.max_on_surface)
        return near

    @property
    def off_surface(self) -> float:
        """Share of the points near the reference that do not lie on it.

        Tangent planes bridge what the reference samples sparsely, such as the gaps between a scanner's lines.
        """
        near = self.is_near
        distances = self.nearest.distances if self.on_surface is None else np.abs(self.on_surface.residuals)
        return 1 - float(np.mean((distances <= self.max_on_surface)[near])) if near.any() else 1.0

    @property
    def nearest_quarter(self) -> float:
        """First quartile of the distances: partial overlap is no failure."""
        return float(np.percentile(self.nearest.distances, 25))


def _match(target: Target, sample: Index, T: Similarity, hint: IntArray | None) -> _SampleMatches:
    """Match the sample at a pose with the reference, and weight the pairs within two distances."""
    surface, spacing = target.surface, target.spacing
    moved, nearest = surface.index.nearest_of_moved(sample, T.matrix, hint)
    distances = nearest.distances
    # One distance for every method: if it followed the fit, a worse fit would count more points as overlap.
    max_on_surface = _MAX_SPACINGS_ON_SURFACE * spacing
    if len(surface) < 3 or target.extent <= MIN_EXTENT:
        return _SampleMatches(target, moved, nearest, max_on_surface, None, None)
    # Observability considers all pairs that the fit may have used: where the density varies, these lie farther apart.
    reach = float(np.clip(3 * _mad(distances[distances <= np.median(distances)]), 3 * spacing, 10 * spacing))
    on_surface, informing = (weigh(surface, moved, nearest, d, robust=True) for d in (max_on_surface, reach))
    return _SampleMatches(target, moved, nearest, max_on_surface, on_surface, informing)


def _counted(pairs: WeightedPairs | None) -> WeightedPairs | None:
    """The pairs of weight above zero; None where there are fewer than `MIN_POINTS`."""
    if pairs is None or np.count_nonzero(pairs.weights) < MIN_POINTS:
        return None
    return pairs.take(pairs.weights > 0)


def _too_few(matched: _SampleMatches, *, with_scale: bool) -> Quality:
    """The quality of a pose at which too few points meet: distances alone."""
    return Quality(
        rmse=float(np.sqrt(np.mean(np.square(matched.nearest.distances)))),
        overlap=matched.overlap,
        off_surface=matched.off_surface,
        contrast=None,
        eigenvalues=(),
        weakest_sigma=None,
        unobservable=np.zeros((7 if with_scale else 6, 0)),
        warnings=(Notice(FEW_POINTS, "too few points to say what the geometry fixes"),),
    )


def _weighted_rmse(pairs: WeightedPairs, *, plane: bool) -> float:
    """Weighted RMSE of the distances to tangent planes, or to points."""
    errors = pairs.residuals if plane else pairs.distances
    return float(np.sqrt((pairs.weights * errors**2).sum() / pairs.weights.sum()))


def _hovering_share(matched: _SampleMatches, pairs: WeightedPairs) -> float:
    """Share of the candidate near the reference that floats above or below its surface.

    Args:
        matched: the sample's correspondences.
        pairs: those weighted within the distance up to which a point lies on the reference.
    """
    distances = matched.nearest.distances
    min_distance = max(matched.max_on_surface, _SIGMAS_OFF * pairs.sigma)
    floating = (distances > min_distance) & (np.abs(pairs.residuals) > _MIN_UPRIGHT * distances)
    return float(np.mean(floating[distances <= max(_MAX_NEAR * matched.target.extent, 2 * min_distance)]))


def _warnings(
    matched: _SampleMatches, observed: Observability, sharp: Contrast | None, hovering: float, *, given: bool
) -> tuple[Notice, ...]:
    """What speaks against trusting a pose, judged from its measurements."""
    warnings = list(observed.warnings)
    overlap = matched.overlap
    if sharp is not None and sharp.share < LEAST:
        what = "the given pose may be wrong, or the cloud is blurred" if given else "the pose may be wrong"
        text = (
            f"{what}: moving the candidate away from it costs {max(sharp.share, 0):.0%} of what moving the reference"
            " away from itself costs"
        )
        warnings.append(Notice(DOUBTFUL_POSE, text))
    # A round body fits turned about its axis. What would tell the turn, such as its handle, then meets nothing.
    if sharp is not None and sharp.felt < _MIN_FELT and overlap < _WHOLE_OVERLAP and not observed.warnings:
        text = "what meets hardly fixes some motion, and the rest, which would fix it, does not meet"
        warnings.append(Notice(WEAKLY_OBSERVABLE, text))
    if overlap < _MIN_OVERLAP:
        warnings.append(Notice(LOW_OVERLAP, f"only {overlap:.0%} of the candidate lies on the reference"))
    if hovering > _MAX_HOVERING:
        text = (
            f"{hovering:.0%} of the candidate near the reference does not lie on it: a wrong alignment, outliers or"
            " changes"
        )
        warnings.append(Notice(OFF_SURFACE, text))
    typical, spacing = matched.nearest_quarter, matched.target.spacing
    if typical > _MAX_SPACINGS_OFF * spacing > 0 and (sharp is None or sharp.share < SURE):
        text = (
            f"the candidate lies far off the reference (its nearest quarter by {typical:.3g}, {typical / spacing:.0f}"
            " times the reference's spacing): the registration may have failed"
        )
        warnings.append(Notice(FAR_OFF, text))
    return tuple(warnings)


def _mad(values: FloatArray) -> float:
    """Robust standard deviation about zero: 1.4826 times the median absolute value."""
    return 1.4826 * float(np.median(np.abs(values))) if len(values) else 0.0


def _format(point: FloatArray) -> str:
    return "(" + ", ".join(f"{v:.6g}" for v in point) + ")"
