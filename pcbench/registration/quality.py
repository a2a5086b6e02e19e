"""Quality of a pose: the same measurements for every method, so that the methods can be compared."""

from __future__ import annotations

import math
from typing import Literal, NamedTuple

import numpy as np

from pcbench.errors import Notice, RegistrationError
from pcbench.geometry.arrays import FloatArray, IntArray, bounds, random_rows
from pcbench.geometry.neighbors import Index
from pcbench.geometry.normals import Surface
from pcbench.geometry.transform import Similarity
from pcbench.geometry.voxels import voxel_downsample, voxel_downsample_to
from pcbench.registration.advice import align_coarsely
from pcbench.registration.contrast import (
    BLURRED_CONTRAST,
    CONFIDENT_CONTRAST,
    DOUBTFUL_CONTRAST,
    MIN_CONTRAST,
    SURE_CONTRAST,
    Contrast,
    contrast,
)
from pcbench.registration.degeneracy import Observability, observability
from pcbench.registration.icp_stages import MAX_RANDOM_SAMPLE
from pcbench.registration.motion import PoseCovariance
from pcbench.registration.restarts import MIN_RETURNED_SHARE, returned_share
from pcbench.registration.result import (
    BLURRED,
    DOUBTFUL_POSE,
    FAR_OFF,
    FEW_POINTS,
    LOW_OVERLAP,
    OFF_SURFACE,
    UNKNOWN_SCALE,
    UNOBSERVABLE,
    WEAKLY_OBSERVABLE,
)
from pcbench.registration.sample_matches import (
    MAX_SPACINGS_ON_SURFACE,
    NEAR_EXTENT_SHARE,
    SampleMatches,
    match_sample,
)
from pcbench.registration.target import Target
from pcbench.registration.turns import closest_turned_pose
from pcbench.registration.unmatched import MAX_UNMATCHED_SHARE, unmatched_share
from pcbench.registration.weighted_pairs import MIN_POINTS, WeightedPairs, weigh

MAX_OFF_SURFACE_SHARE = 0.25  # share of near points off the reference's surface, above which other starts are tried

_MAX_SAMPLE = 30_000  # candidate points for assessing a given pose
_NOISE_SPACINGS = 3.0  # spacing of the thinned reference, in standard deviations of the candidate's noise
_MIN_OVERLAP = 0.3  # below it a warning is given
_MIN_SENSITIVITY = 0.015  # see `Contrast.min_sensitivity`
_FULL_OVERLAP = 0.95  # overlap above which no relevant part is left without a counterpart
_MAX_HOVERING_SHARE = 0.1  # share of near points that float beside the surface, above which a warning is given
_MIN_SIGMAS_OFF = 4.0  # floating points are farther off than this many standard deviations of the residuals
_MIN_NORMAL_COSINE = 0.9  # floating points lie along the normal, and not beyond the end of the surface
# Share of near points off the surface above which turned poses are tried, and the ratio of mean distances below which
# one of them fits better.
_MIN_UNEXPLAINED_SHARE, _MAX_TURNED_RATIO = 0.05, 0.7
_MAX_KEPT_SCALE = 1e-9  # change of the logarithm of the scale by rounding, if ICP keeps it
_MIN_SCALE_SHARE = 0.05  # of the scale in the unobservable motions, from which on a solved scale is unknown
_MAX_SPACINGS_OFF = 10  # distance of the candidate's nearest quarter, above which a warning is given

PoseSource = Literal["icp", "given", "stated", "search"]


class Quality(NamedTuple):
    """Quality of a pose; `Registration` explains the values."""

    rmse: float
    overlap: float
    off_surface: float  # share of the points near the reference that do not lie on it
    contrast: float | None  # None if `contrast` cannot measure it
    returned: float | None  # share of restarts that returned to the pose; None if none were needed
    eigenvalues: tuple[float, ...]
    weakest_sigma: float | None
    unobservable: FloatArray  # (6 or 7, U) orthonormal motions that the geometry does not fix
    covariance: PoseCovariance | None  # None with too few points
    is_weak: bool  # whether some motion is known so badly that restarts have to confirm the pose
    warnings: tuple[Notice, ...]


class Fit(NamedTuple):
    """A pose between local coordinates (minus the reference's local origin), and its quality."""

    T_local: Similarity
    quality: Quality
    iterations: int = 0
    converged: bool | None = None

    def with_covariance(self, covariance: PoseCovariance | None) -> Fit:
        """Return the fit with another covariance: that of a pose which the clouds' points did not determine."""
        return self._replace(quality=self.quality._replace(covariance=covariance))


def assess(
    target: Target,
    sample: Index,
    random_sample: FloatArray,
    T: Similarity,
    *,
    plane: bool,
    with_scale: bool,
    hint: IntArray | None = None,
) -> Quality:
    """Assess a pose without changing it: residuals, overlap, observability and contrast.

    Overlap counts an even sample, so that dense parts do not dominate. Contrast and points beside the surface are
    measured on a random sample: an even one exaggerates outliers, which fill space.

    Args:
        target: reference.
        sample: even sample of the candidate's points, minus the reference's local origin.
        random_sample: (N, 3) random sample of the same points.
        T: pose between local coordinates.
        plane: whether the RMSE is of distances to tangent planes, or to points.
        with_scale: whether the scale is one of the motions that the geometry has to fix.
        hint: reference points last found closest to the sample, where the search starts.
    """
    matched = match_sample(target, sample, T, hint)
    on_surface, informing = _pairs_with_weight(matched.on_surface), _pairs_with_weight(matched.informing)
    if matched.on_surface is None or on_surface is None or informing is None:
        return _quality_from_distances(matched, with_scale=with_scale)
    observation = observability(target.surface, informing, with_scale=with_scale)
    moved = T.apply(random_sample)
    nearest = target.surface.index.query(moved)
    pose_contrast = contrast(
        target.surface,
        moved,
        nearest,
        np.flatnonzero(nearest.distances <= matched.max_near),
        sigma=on_surface.sigma,
        spacing=target.spacing,
        extent=target.extent,
        with_scale=with_scale,
    )
    hovering = _hovering_share(weigh(target.surface, moved, nearest, matched.max_on_surface, robust=True), matched)
    warnings = _warnings(matched, observation, pose_contrast, hovering)
    return Quality(
        rmse=_weighted_rmse(on_surface, plane=plane),
        overlap=matched.overlap,
        off_surface=matched.off_surface,
        contrast=None if pose_contrast is None else pose_contrast.share,
        returned=None,
        eigenvalues=observation.eigenvalues,
        weakest_sigma=observation.weakest_sigma,
        unobservable=observation.unobservable,
        covariance=observation.covariance,
        is_weak=observation.is_weak or any(notice.code == WEAKLY_OBSERVABLE for notice in warnings),
        warnings=warnings,
    )


def with_doubt(
    target: Target,
    random_sample: FloatArray,
    T: Similarity,
    quality: Quality,
    *,
    with_scale: bool,
    source: PoseSource = "icp",
) -> Quality:
    """Complete the quality of a pose with a warning if the pose may be wrong, or the candidate is blurred.

    Noise and blur lower the contrast of a right pose. So a low contrast is measured again at the scale of the noise. If
    it is then high, or if the geometry weakly constrains some motion, most of the restarts have to return to the pose.
    If it stays low, all of them have to, and the geometry has to constrain all motions well. At a nearly symmetric
    scene the contrast of a turned pose may be high. So if points near the reference do not lie on it, no pose turned by
    a quarter or a half may fit better.

    Args:
        target: reference.
        random_sample: (N, 3) random sample of the candidate, minus the reference's local origin.
        T: pose between local coordinates.
        quality: result of `assess`.
        with_scale: whether the scale was solved for.
        source: where the pose comes from. The best of many poses (`search`) has to pass a further test, see
            `unmatched_share`: a part of a regular city may slide onto another part, and restarts then return.
    """
    share = quality.contrast
    if with_scale and _leaves_scale_open(quality, T if source == "icp" else None):
        text = (
            "the scale may be wrong, because the geometry does not fix it; use --register icp if the scale is known, or"
            " points:FILE (control points)"
        )
        return _with_notice(quality, Notice(UNKNOWN_SCALE, text))
    if share is None:
        return quality
    name = "the given pose" if source == "given" else "the pose"
    is_determined = not quality.unobservable.shape[1]
    if source != "search" and is_determined and quality.off_surface > _MIN_UNEXPLAINED_SHARE:
        turned = closest_turned_pose(target, random_sample, T, with_scale=with_scale)
        if turned is not None and turned.distance_ratio < _MAX_TURNED_RATIO:
            text = (
                f"{name} may be wrong, because another one, rotated by {turned.angle_deg:.0f} degrees, reduces the"
                f" candidate's mean distance to the reference to {turned.distance_ratio:.0%}; {align_coarsely()}"
            )
            return _with_notice(quality, Notice(DOUBTFUL_POSE, text))
    if source == "stated":
        return quality
    if source == "search":
        unmatched = unmatched_share(target, T.apply(random_sample))
        if unmatched > MAX_UNMATCHED_SHARE:
            text = (
                f"{name} may be wrong, because {unmatched:.1%} of the points inside the other cloud have no"
                " counterpart in it"
            )
            return _with_notice(quality, Notice(DOUBTFUL_POSE, text))
    if share >= SURE_CONTRAST and not quality.is_weak:
        return quality
    at_noise = share
    if MIN_CONTRAST <= share < DOUBTFUL_CONTRAST:
        at_noise = _contrast_at_noise(target, random_sample, T, quality, with_scale=with_scale)
    low_contrast = Notice(
        DOUBTFUL_POSE,
        f"{name} may be wrong, because displacing the candidate worsens its fit by {max(at_noise, 0):.0%} of what the"
        " same displacement costs the reference itself",
    )
    is_low = share < MIN_CONTRAST or at_noise < DOUBTFUL_CONTRAST
    if is_low and (source == "search" or quality.is_weak or not is_determined):
        return _with_notice(quality, low_contrast)
    if not is_determined:
        return quality  # restarts would slide along the unobservable motions
    tolerance = max(target.spacing, quality.rmse)
    required = 1.0 if is_low else MIN_RETURNED_SHARE
    returned = returned_share(target, random_sample, T, tolerance=tolerance, with_scale=with_scale, required=required)
    quality = quality._replace(returned=returned)
    if returned < required:
        text = f"{name} may be wrong, because only {returned:.0%} of the registrations that start nearby return to it"
        return _with_notice(quality, low_contrast if is_low else Notice(DOUBTFUL_POSE, text))
    if share < BLURRED_CONTRAST:
        text = (
            f"the candidate is blurred or noisy: displacing it worsens its fit by {share:.0%} of what the same"
            " displacement costs the reference itself, but registrations that start nearby return to this pose"
        )
        return _with_notice(quality, Notice(BLURRED, text))
    return quality


def _leaves_scale_open(quality: Quality, T: Similarity | None) -> bool:
    """Return whether the geometry does not fix the scale, and it is unknown or was solved for nevertheless.

    A scale about which only few pairs inform keeps its initial value, so that it is no result of theirs.

    Args:
        quality: result of `assess`.
        T: pose by ICP from the identity; None for other methods.
    """
    if float(np.square(quality.unobservable[6]).sum()) <= _MIN_SCALE_SHARE:
        return False
    is_open = any(notice.code == UNOBSERVABLE for notice in quality.warnings)
    return is_open or (T is not None and abs(math.log(T.scale)) > _MAX_KEPT_SCALE)


def _contrast_at_noise(
    target: Target, random_sample: FloatArray, T: Similarity, quality: Quality, *, with_scale: bool
) -> float:
    """Return the contrast with a reference that is as sparse as the candidate is noisy; -1 if it cannot be measured.

    Noise moves points off the surface. It lowers the contrast most if the displacement is a few spacings of a reference
    that is much denser than the noise is large.
    """
    side = _NOISE_SPACINGS * quality.rmse
    surface = target.surface
    if side <= 1.5 * target.spacing:
        return -1.0 if quality.contrast is None else quality.contrast
    surface = Surface(Index(surface.points[voxel_downsample(surface.points, side)]))
    moved = T.apply(random_sample)
    nearest = surface.index.query(moved)
    max_near = max(NEAR_EXTENT_SHARE * target.extent, MAX_SPACINGS_ON_SURFACE * surface.spacing)
    sharpness = contrast(
        surface,
        moved,
        nearest,
        np.flatnonzero(nearest.distances <= max_near),
        sigma=quality.rmse,
        spacing=surface.spacing,
        extent=target.extent,
        with_scale=with_scale,
    )
    return -1.0 if sharpness is None else sharpness.share


def _with_notice(quality: Quality, notice: Notice) -> Quality:
    return quality._replace(warnings=(notice, *quality.warnings))


def assess_given(
    target: Target,
    points: FloatArray,
    T_local: Similarity,
    origin: FloatArray,
    text: str,
    *,
    source: PoseSource = "given",
) -> Fit:
    """Assess a given pose in the same way as a fitted one.

    Args:
        target: reference.
        points: (N, 3) candidate points minus the reference's local origin.
        T_local: pose between local coordinates.
        origin: (3,) local origin, added again in the error message.
        text: method text for the error message.
        source: `given` by the user, `stated` by one coordinate system of both clouds, or found by a `search` over all
            poses. A displacement in stated coordinates is a result and no doubt.

    Raises:
        RegistrationError: the bounding boxes do not overlap.
    """
    surface = target.surface
    if target.spacing > 0:
        start = max(target.extent / 500, target.spacing) / T_local.scale
        sample = Index(points[voxel_downsample_to(points, _MAX_SAMPLE, start=start)])
    else:
        sample = Index(points[:_MAX_SAMPLE])
    moved = T_local.apply(sample.points)
    lower, upper = surface.bounds
    margin = 0.1 * float(np.linalg.norm(upper - lower))
    # Fewer than three points have no extent that could overlap.
    if len(surface) >= 3 and ((moved.min(axis=0) > upper + margin).any() or (moved.max(axis=0) < lower - margin).any()):
        centre, other = ((low + high) / 2 + origin for low, high in ((lower, upper), bounds(moved)))
        raise RegistrationError(
            f"the candidate does not overlap the reference after --register {text}: their bounding boxes are disjoint"
            f" (reference centre {_format(centre)}, candidate centre {_format(other)}):"
            f" {align_coarsely()}"
        )
    random_sample, with_scale = random_rows(points, MAX_RANDOM_SAMPLE), T_local.scale != 1
    quality = assess(target, sample, random_sample, T_local, plane=True, with_scale=with_scale)
    quality = with_doubt(target, random_sample, T_local, quality, with_scale=False, source=source)
    return Fit(T_local, quality)


def plane_rms(surface: Surface, points: FloatArray) -> float:
    """Return the RMS distance of a random sample of points (N, 3) to the tangent planes at their closest points."""
    sample = random_rows(points, MAX_RANDOM_SAMPLE)
    pairs = weigh(surface, sample, surface.index.query(sample), np.inf, robust=False)
    return float(np.sqrt(np.mean(np.square(pairs.residuals))))


def _pairs_with_weight(pairs: WeightedPairs | None) -> WeightedPairs | None:
    """Return the pairs with positive weight; None if there are fewer than `MIN_POINTS`."""
    if pairs is None or np.count_nonzero(pairs.weights) < MIN_POINTS:
        return None
    return pairs.take(pairs.weights > 0)


def _quality_from_distances(matched: SampleMatches, *, with_scale: bool) -> Quality:
    """Return the quality of a pose with too few overlapping points, from distances alone."""
    return Quality(
        rmse=float(np.sqrt(np.mean(np.square(matched.nearest.distances)))),
        overlap=matched.overlap,
        off_surface=matched.off_surface,
        contrast=None,
        returned=None,
        eigenvalues=(),
        weakest_sigma=None,
        unobservable=np.zeros((7 if with_scale else 6, 0)),
        covariance=None,
        is_weak=False,
        warnings=(Notice(FEW_POINTS, "too few points to determine which motions the geometry constrains"),),
    )


def _weighted_rmse(pairs: WeightedPairs, *, plane: bool) -> float:
    """Return the weighted RMSE of the distances to tangent planes, or to points."""
    errors = pairs.residuals if plane else pairs.distances
    return float(np.sqrt((pairs.weights * errors**2).sum() / pairs.weights.sum()))


def _hovering_share(pairs: WeightedPairs, matched: SampleMatches) -> float:
    """Return the share of the candidate near the reference that floats above or below its surface.

    Args:
        pairs: random sample, weighted up to the distance at which a point lies on the reference.
        matched: correspondences of the even sample, for the distances.
    """
    min_distance = max(matched.max_on_surface, _MIN_SIGMAS_OFF * pairs.sigma)
    is_hovering = (pairs.distances > min_distance) & (np.abs(pairs.residuals) > _MIN_NORMAL_COSINE * pairs.distances)
    is_near = pairs.distances <= max(NEAR_EXTENT_SHARE * matched.target.extent, 2 * min_distance)
    return float(np.mean(is_hovering[is_near])) if is_near.any() else 0.0


def _warnings(
    matched: SampleMatches,
    observation: Observability,
    pose_contrast: Contrast | None,
    hovering: float,
) -> tuple[Notice, ...]:
    """Return the warnings about a pose from its measurements."""
    warnings = list(observation.warnings)
    overlap = matched.overlap
    # A round body fits turned about its axis. The part that would fix the rotation, such as a handle, then does not
    # overlap.
    is_insensitive = pose_contrast is not None and pose_contrast.min_sensitivity < _MIN_SENSITIVITY
    if is_insensitive and overlap < _FULL_OVERLAP and not observation.warnings:
        text = "the overlap weakly constrains some motion, and the parts that would constrain it do not overlap"
        warnings.append(Notice(WEAKLY_OBSERVABLE, text))
    if overlap < _MIN_OVERLAP:
        warnings.append(Notice(LOW_OVERLAP, f"only {overlap:.0%} of the candidate lies on the reference"))
    if hovering > _MAX_HOVERING_SHARE:
        text = (
            f"{hovering:.0%} of the candidate near the reference does not lie on it: there are outliers or changes, or"
            " the alignment is wrong"
        )
        warnings.append(Notice(OFF_SURFACE, text))
    typical, spacing = matched.nearest_quarter, matched.target.spacing
    if typical > _MAX_SPACINGS_OFF * spacing > 0 and (
        pose_contrast is None or pose_contrast.share < CONFIDENT_CONTRAST
    ):
        text = (
            f"the candidate is far from the reference (its nearest quarter is {typical:.3g} away,"
            f" {typical / spacing:.0f} times the reference's point spacing): the registration may have failed"
        )
        warnings.append(Notice(FAR_OFF, text))
    return tuple(warnings)


def _format(point: FloatArray) -> str:
    return "(" + ", ".join(f"{v:.6g}" for v in point) + ")"
