"""Robust coarse-to-fine ICP that assesses its own result.

Point to plane (Chen & Medioni 1992) or point to point (Besl & McKay 1992), both with Tukey's biweight at the end.
Motions that the geometry does not fix are detected (see `degeneracy`), and no update is made along them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np

from pcbench.errors import InputError, Notice, RegistrationError
from pcbench.geometry.arrays import FloatArray, IntArray, rounding_bound
from pcbench.geometry.neighbors import Index
from pcbench.geometry.normals import Surface
from pcbench.geometry.transform import Similarity, fit_similarity
from pcbench.geometry.voxels import voxel_downsample, voxel_downsample_to
from pcbench.native import _core
from pcbench.registration.advice import align_coarsely
from pcbench.registration.quality import MAX_OFF_SURFACE_SHARE, MIN_EXTENT, MIN_POINTS, Fit, Quality, assess
from pcbench.registration.result import NO_CONVERGENCE
from pcbench.registration.target import Target
from pcbench.registration.weighted_pairs import WeightedPairs, weigh

_INITIAL_DISTANCE_SHARE = 0.1  # initial maximum correspondence distance as a share of the extent
_SCALE_RANGE = (0.5, 2.0)  # relative to the initial scale: outside, the refinement has collapsed
_MIN_NEAR_SHARE = 0.01  # share of the sample that must lie within the maximum correspondence distance


@dataclass(frozen=True)
class IcpSettings:
    """Registration method: coarse-to-fine ICP. The defaults are those of `icp` on the command line.

    Attributes:
        residuals: `plane` (to the reference's tangent planes) or `point` (to its points; less accurate; `icp-point`).
        with_scale: whether the scale is refined too (`similarity`); it must be nearly right at the start.
        max_correspondence_distance: initial maximum distance of correspondences, in the reference's unit. None: a tenth
            of the reference's extent. It narrows to three point spacings of the reference.
        max_iterations: maximum iterations of each of the two stages.
        max_sample: maximum number of candidate points, evenly spread, in the fine stage. The default gives millimetre
            accuracy within seconds.

    Raises:
        InputError: a value is not usable.
    """

    residuals: Literal["plane", "point"] = "plane"
    with_scale: bool = False
    max_correspondence_distance: float | None = None
    max_iterations: int = 100
    max_sample: int = 30_000

    def __post_init__(self) -> None:
        if self.residuals not in ("plane", "point"):
            raise InputError(f"expected the residuals `plane` or `point`, got {self.residuals!r}")
        if not isinstance(self.with_scale, bool):
            raise InputError(f"expected with_scale as True or False, got {self.with_scale!r}")
        if self.with_scale and self.residuals == "point":
            raise InputError("expected residuals `plane` with with_scale=True: with `point` the scale would shrink")
        distance = self.max_correspondence_distance
        if distance is not None and not (
            isinstance(distance, int | float | np.number) and np.isfinite(distance) and distance > 0
        ):
            raise InputError(f"expected a positive max_correspondence_distance, got {distance!r}")
        for name, least in (("max_iterations", 1), ("max_sample", MIN_POINTS)):
            value = getattr(self, name)
            if not isinstance(value, int | np.integer) or isinstance(value, bool) or value < least:
                raise InputError(f"expected {name} as an integer of at least {least}, got {value!r}")

    @property
    def text(self) -> str:
        """Method name as on the command line, followed by the values that differ from the defaults."""
        name = "similarity" if self.with_scale else "icp-point" if self.residuals == "point" else "icp"
        default = IcpSettings()
        numbers = ("max_correspondence_distance", "max_iterations", "max_sample")
        changed = [
            f"{number}={getattr(self, number)}"
            for number in numbers
            if getattr(self, number) != getattr(default, number)
        ]
        return f"{name} ({', '.join(changed)})" if changed else name


def align(
    target: Target,
    points: FloatArray,
    settings: IcpSettings,
    initial: Similarity | None = None,
    *,
    may_be_far: bool = True,
) -> Fit:
    """Register points to a target by coarse-to-fine ICP; both are relative to one local origin.

    The maximum correspondence distance narrows first. Then a Tukey kernel is used whose width follows the residuals. A
    robust kernel from the start would use only the pairs that already fit, and shrink the basin of convergence. A slow
    start that uses all pairs finds large motions, but may slide partly overlapping clouds onto each other. It is
    therefore tried only if the fast start leaves points off the reference's surface, and only if `may_be_far`. If the
    geometry does not observe some motion, the fit is repeated with this motion constrained to zero: noise must not move
    the pose.

    Args:
        target: reference.
        points: (N, 3) candidate points minus the reference's local origin.
        settings: residuals, scale and limits.
        initial: initial pose between local coordinates; its scale stays unless the scale is solved for.
        may_be_far: whether the slow start is tried too.

    Raises:
        RegistrationError: there are too few points, the clouds do not overlap, or the scale collapsed.
    """
    if initial is not None:
        # Apply the initial pose first: the points are then in the reference's unit, and the motion is small.
        fit = align(target, initial.apply(points), settings, may_be_far=may_be_far)
        return fit._replace(T_local=fit.T_local @ initial)
    problem = _Problem.of(target, points, settings)
    starts = (_FAST_START, _SLOW_START) if may_be_far else (_FAST_START,)
    start, fit = _best_start(problem, starts)
    unobservable = fit.quality.unobservable
    if unobservable.shape[1] and settings.residuals == "plane":
        try:
            constrained = _fit_and_assess(problem, start, unobservable)
        except RegistrationError:
            constrained = fit
        # Use the constrained fit only if it fits as well: a motion that the pairs support is not noise.
        free_quality, constrained_quality = fit.quality, constrained.quality
        fits_as_well = constrained_quality.rmse <= 1.05 * free_quality.rmse
        if fits_as_well and constrained_quality.overlap >= 0.98 * free_quality.overlap:
            fit = constrained
    if not fit.converged:
        text = f"ICP did not converge within {fit.iterations} iterations: check the aligned clouds"
        warnings = (*fit.quality.warnings, Notice(NO_CONVERGENCE, text))
        fit = fit._replace(quality=fit.quality._replace(warnings=warnings))
    return fit


def refine(target: Target, points: FloatArray, settings: IcpSettings, initial: Similarity) -> Similarity:
    """Refine a pose by the fast start of `align`, without quality assessment: for screening many initial poses.

    Args:
        target: reference.
        points: (N, 3) candidate points minus the reference's local origin.
        settings: residuals, scale and limits.
        initial: initial pose between local coordinates.

    Raises:
        RegistrationError: see `align`.
    """
    problem = _Problem.of(target, initial.apply(points), settings)
    return _run_both_stages(problem, _FAST_START, np.zeros((7 if settings.with_scale else 6, 0))).T @ initial


class _Start(NamedTuple):
    """How the maximum correspondence distance of the coarse stage narrows."""

    narrowing_factor: float  # per iteration
    kept_share: float  # share of the nearest pairs used while it narrows


_FAST_START, _SLOW_START = _Start(0.7, 0.9), _Start(0.95, 1.0)


class _Schedule(NamedTuple):
    """Maximum correspondence distance of one stage, which narrows from `first` to `final`."""

    first: float
    final: float
    start: _Start


class _Problem(NamedTuple):
    """Inputs that all attempts share."""

    target: Target
    coarse_sample: Index  # candidate points of the coarse stage
    sample: Index  # candidate points of the fine stage
    settings: IcpSettings

    @classmethod
    def of(cls, target: Target, points: FloatArray, settings: IcpSettings) -> _Problem:
        surface, remedy = target.surface, "use --register points:FILE, matrix:FILE or none"
        if len(points) < MIN_POINTS or len(surface) < MIN_POINTS:
            raise RegistrationError(
                f"expected at least {MIN_POINTS} points in each cloud for ICP, got {len(points)} and {len(surface)}:"
                f" {remedy}"
            )
        extent, side = target.extent, target.coarse_side
        if extent < MIN_EXTENT:
            raise RegistrationError(f"expected a reference with a nonzero extent, got an extent of {extent:.3g}")
        start = max(extent / 500, target.spacing)
        coarse_sample = Index(points[voxel_downsample(points, side)])
        sample = Index(points[voxel_downsample_to(points, settings.max_sample, start=start)])
        positions = min(len(coarse_sample), len(sample))
        if min(positions, len(target.coarse)) < MIN_POINTS:
            raise RegistrationError(
                f"expected points at {MIN_POINTS} or more distinct positions in each cloud for ICP, got {positions} in"
                f" the candidate and {len(target.coarse)} in the reference ({side:.3g} apart): {remedy}"
            )
        return cls(target, coarse_sample, sample, settings)

    def coarse_schedule(self, start: _Start) -> _Schedule:
        limit = self.settings.max_correspondence_distance
        first = _INITIAL_DISTANCE_SHARE * self.target.extent if limit is None else limit
        return _Schedule(first, min(2 * self.target.coarse_side, limit or np.inf), start)

    def fine_schedule(self) -> _Schedule:
        limit = self.settings.max_correspondence_distance or np.inf
        final = max(3 * self.target.spacing, 1e-9 * self.target.extent)
        return _Schedule(min(1.5 * self.target.coarse_side, limit), min(final, limit), _FAST_START)


def _best_start(problem: _Problem, starts: tuple[_Start, ...]) -> tuple[_Start, Fit]:
    """Return the best fit and its start; later starts run only if the first leaves points off the surface."""
    free = np.zeros((7 if problem.settings.with_scale else 6, 0))
    fits: list[tuple[_Start, Fit]] = []
    failures: list[RegistrationError] = []
    for start in starts:
        try:
            fits.append((start, _fit_and_assess(problem, start, free)))
        except RegistrationError as failure:
            failures.append(failure)
        else:
            if fits[-1][1].quality.off_surface <= MAX_OFF_SURFACE_SHARE:
                break
    if not fits:
        raise failures[0]
    return max(fits, key=lambda start_and_fit: _merit(start_and_fit[1].quality))


def _merit(quality: Quality) -> float:
    return quality.overlap - quality.off_surface


def _fit_and_assess(problem: _Problem, start: _Start, constrained: FloatArray) -> Fit:
    """Run both stages from the identity and assess the result.

    Args:
        problem: shared inputs.
        start: how the coarse stage narrows.
        constrained: (6 or 7, C) orthonormal motions that are constrained to zero.
    """
    target, plane = problem.target, problem.settings.residuals == "plane"
    icp_result = _run_both_stages(problem, start, constrained)
    with_scale = problem.settings.with_scale
    quality = assess(target, problem.sample, icp_result.T, plane=plane, with_scale=with_scale, hint=icp_result.hint)
    return Fit(icp_result.T, quality, icp_result.iterations, icp_result.converged)


class _IcpResult(NamedTuple):
    """Result of the iterations."""

    T: Similarity
    iterations: int
    converged: bool
    hint: IntArray | None  # reference points closest to the sample, where the next search starts


def _run_both_stages(problem: _Problem, start: _Start, constrained: FloatArray) -> _IcpResult:
    """Run both stages; return the result of the fine stage, with the iterations of both."""
    target, settings = problem.target, problem.settings
    # Outliers within a large distance shrink the candidate: keep the scale fixed at first, unless all pairs are used.
    rigid = settings.with_scale and start.kept_share < 1 and not constrained.shape[1]
    coarse = (replace(settings, with_scale=False), np.zeros((6, 0))) if rigid else (settings, constrained)
    T = Similarity.identity()
    closest = target.surface.index.query(problem.sample.points)
    if closest.distances.max() <= rounding_bound(problem.sample.points, np.zeros(3)):
        return _IcpResult(T, 0, True, closest.indices)  # a candidate on the reference stays exactly where it is
    stages = (target.coarse, problem.coarse_sample), (target.surface, problem.sample)
    first = _iterate(*stages[0], T, *coarse, problem.coarse_schedule(start), target.extent)
    second = _iterate(*stages[1], first.T, settings, constrained, problem.fine_schedule(), target.extent)
    return second._replace(iterations=first.iterations + second.iterations)


def _iterate(
    target: Surface,
    sample: Index,
    T: Similarity,
    settings: IcpSettings,
    constrained: FloatArray,
    schedule: _Schedule,
    extent: float,
) -> _IcpResult:
    """Iterate Gauss-Newton on re-matched pairs until the update is below the noise of the estimate.

    Args:
        target: reference, or its coarse version.
        sample: candidate points before T.
        T: initial pose.
        settings: residuals, scale and iterations.
        constrained: (6 or 7, C) orthonormal motions that are constrained to zero.
        schedule: maximum correspondence distances.
        extent: extent of the reference.
    """
    max_distance = schedule.first
    previous = np.inf
    hint: IntArray | None = None
    for iteration in range(1, settings.max_iterations + 1):
        annealing = max_distance > schedule.final
        moved, nearest = target.index.nearest_of_moved(sample, T.matrix, hint)
        hint = nearest.indices
        pairs = weigh(target, moved, nearest, max_distance, robust=not annealing, kept_share=schedule.start.kept_share)
        total = float(pairs.weights.sum())
        if pairs.near_count < max(MIN_POINTS, _MIN_NEAR_SHARE * len(sample)) or total < 6:
            raise RegistrationError(
                f"the candidate does not overlap the reference: {pairs.near_count} of {len(sample)} sampled points"
                f" lie within {max_distance:.3g} of it. Check that both clouds use the same unit and coordinate system;"
                f" {align_coarsely()}"
            )
        if settings.residuals == "point":
            delta, size = _point_step(target, pairs)
        else:
            delta, size = _plane_step(target, pairs, constrained, with_scale=settings.with_scale)
        T = delta @ T
        if settings.with_scale and not _SCALE_RANGE[0] < T.scale < _SCALE_RANGE[1]:
            raise RegistrationError(
                f"the scale left {_SCALE_RANGE} (got {T.scale:.3g}): `similarity` only refines a scale that is nearly"
                " right; give an initial one with --register points:FILE or matrix:FILE"
            )
        tolerance = max(0.05 * pairs.sigma / np.sqrt(total), 1e-12 * extent)
        # Matches keep flipping at the noise level, so lack of progress also ends the iteration.
        if not annealing and (size < tolerance or (size > 0.5 * previous and size < 20 * tolerance)):
            return _IcpResult(T, iteration, True, hint)
        previous = size if not annealing else np.inf
        max_distance = max(schedule.final, schedule.start.narrowing_factor * max_distance)
    return _IcpResult(T, settings.max_iterations, False, hint)


def _plane_step(
    target: Surface, pairs: WeightedPairs, constrained: FloatArray, *, with_scale: bool
) -> tuple[Similarity, float]:
    """Compute one Gauss-Newton step of sum w (n . (dT p - q))^2 (Chen & Medioni 1992), about the pairs' centre.

    The step has no component along the constrained directions: the normal equations are solved in their complement,
    which is least squares under the equality constraints `constrained.T @ motion = 0` (see `degeneracy`).
    """
    hessian, gradient, center = np.empty((7, 7)), np.empty(7), np.empty(3)
    normals = target.compute_normals(pairs.indices)
    radius = _core.plane_system(
        pairs.moved, normals, pairs.indices, pairs.residuals, pairs.weights, hessian, gradient, center
    )
    size = 7 if with_scale else 6
    free = np.eye(size) - constrained @ constrained.T
    # The pseudo-inverse also ignores motions that the pairs do not fix at all (such as sliding along an exact plane).
    inverse = np.linalg.pinv(free @ hessian[:size, :size] @ free, rcond=1e-10, hermitian=True)
    motion = -inverse @ (free @ gradient[:size])
    rotation = _rotation(motion[:3] / radius)
    scale = float(np.exp(np.clip(motion[6] / radius, -0.05, 0.05))) if with_scale else 1.0
    delta = Similarity(rotation, center + motion[3:6] - scale * rotation @ center, scale)
    return delta, float(np.linalg.norm(motion))


def _point_step(target: Surface, pairs: WeightedPairs) -> tuple[Similarity, float]:
    """Compute the best rigid motion of the weighted pairs (Besl & McKay 1992)."""
    pairs = pairs.take(pairs.weights > 0)
    closest_points = target.points[pairs.indices]
    delta = fit_similarity(pairs.moved, closest_points, with_scale=False, weights=pairs.weights)
    size = np.sqrt(np.mean(np.square(delta.apply(pairs.moved) - pairs.moved).sum(axis=1)))
    return delta, float(size)


def _rotation(vector: FloatArray) -> FloatArray:
    """Return the rotation matrix of a rotation vector (Rodrigues)."""
    angle = float(np.linalg.norm(vector))
    if angle < 1e-300:
        return np.eye(3)
    x, y, z = vector / angle
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    rotation: FloatArray = np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * (k @ k)
    return rotation
