"""Coarse-to-fine iterations of ICP: schedule of the correspondence distance, Gauss-Newton steps, convergence."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from pcbench.errors import RegistrationError
from pcbench.geometry.arrays import FloatArray, IntArray, random_rows, rounding_bound
from pcbench.geometry.neighbors import Index
from pcbench.geometry.normals import Surface
from pcbench.geometry.transform import Similarity, fit_similarity, rotation_from_vector
from pcbench.geometry.voxels import voxel_downsample, voxel_downsample_to
from pcbench.native import _core
from pcbench.registration.advice import align_coarsely
from pcbench.registration.icp_settings import IcpSettings
from pcbench.registration.target import MIN_EXTENT, Target
from pcbench.registration.weighted_pairs import MIN_POINTS, WeightedPairs, weigh

_INITIAL_DISTANCE_SHARE = 0.1  # initial maximum correspondence distance as a share of the extent
_SCALE_RANGE = (0.5, 2.0)  # relative to the initial scale: outside, the refinement has collapsed
MAX_RANDOM_SAMPLE = 10_000  # points of the random sample
_MIN_EIGENVALUE_SHARE = 1e-10  # of the largest eigenvalue: smaller ones are rounding
_MIN_NEAR_SHARE = 0.01  # share of the sample that must lie within the maximum correspondence distance


class Start(NamedTuple):
    """How the maximum correspondence distance of the coarse stage narrows."""

    narrowing_factor: float  # per iteration
    kept_share: float  # share of the nearest pairs used while it narrows


FAST_START, SLOW_START = Start(0.7, 0.9), Start(0.95, 1.0)


class DistanceSchedule(NamedTuple):
    """Maximum correspondence distance of one stage, which narrows from `first` to `final`."""

    first: float
    final: float
    start: Start


class IcpProblem(NamedTuple):
    """Inputs that all attempts share."""

    target: Target
    coarse_sample: Index  # candidate points of the coarse stage
    sample: Index  # candidate points of the fine stage
    random_sample: FloatArray  # candidate points for the assessment of the result
    settings: IcpSettings

    @classmethod
    def of(cls, target: Target, points: FloatArray, settings: IcpSettings) -> IcpProblem:
        """Prepare the samples of a candidate's points (N, 3).

        Raises:
            RegistrationError: there are too few points, or the reference has no extent.
        """
        surface, remedy = target.surface, "use --register points:FILE, matrix:FILE or none"
        if len(points) < MIN_POINTS or len(surface) < MIN_POINTS:
            raise RegistrationError(
                f"expected at least {MIN_POINTS} points in each cloud for ICP, got {len(points):,} in the candidate and"
                f" {len(surface):,} in the reference: {remedy}"
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
        return cls(target, coarse_sample, sample, random_rows(points, MAX_RANDOM_SAMPLE), settings)

    def coarse_schedule(self, start: Start) -> DistanceSchedule:
        """Return the schedule of the coarse stage."""
        limit = self.settings.max_correspondence_distance
        first = _INITIAL_DISTANCE_SHARE * self.target.extent if limit is None else limit
        return DistanceSchedule(first, min(2 * self.target.coarse_side, limit or np.inf), start)

    def fine_schedule(self) -> DistanceSchedule:
        """Return the schedule of the fine stage."""
        limit = self.settings.max_correspondence_distance or np.inf
        final = max(3 * self.target.spacing, 1e-9 * self.target.extent)
        return DistanceSchedule(min(1.5 * self.target.coarse_side, limit), min(final, limit), FAST_START)


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
    problem = IcpProblem.of(target, initial.apply(points), settings)
    return run_both_stages(problem, FAST_START, np.zeros((7 if settings.with_scale else 6, 0))).T @ initial


def refine_coarsely(target: Target, points: FloatArray, settings: IcpSettings, initial: Similarity) -> Similarity:
    """Refine the rotation and translation of a pose by the coarse stage of `refine` alone."""
    moved = Index(initial.apply(points))
    rigid = replace(settings, with_scale=False)  # outliers within a large distance shrink the candidate
    schedule = IcpProblem(target, moved, moved, moved.points, rigid).coarse_schedule(FAST_START)
    fit = _iterate(target.coarse, moved, Similarity.identity(), rigid, np.zeros((6, 0)), schedule, target.extent)
    return fit.T @ initial


class IcpResult(NamedTuple):
    """Result of the iterations."""

    T: Similarity
    iterations: int
    converged: bool
    hint: IntArray | None  # reference points closest to the sample, where the next search starts


def run_both_stages(problem: IcpProblem, start: Start, constrained: FloatArray) -> IcpResult:
    """Run both stages; return the result of the fine stage, with the iterations of both."""
    target, settings = problem.target, problem.settings
    # Outliers within a large distance shrink the candidate: keep the scale fixed at first, unless all pairs are used.
    rigid = settings.with_scale and start.kept_share < 1 and not constrained.shape[1]
    coarse = (replace(settings, with_scale=False), np.zeros((6, 0))) if rigid else (settings, constrained)
    T = Similarity.identity()
    closest = target.surface.index.query_index(problem.sample)
    if closest.distances.max() <= rounding_bound(problem.sample.points, np.zeros(3)):
        return IcpResult(T, 0, True, closest.indices)  # a candidate on the reference stays exactly where it is
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
    schedule: DistanceSchedule,
    extent: float,
) -> IcpResult:
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
    followed = target.index.follow(sample)
    for iteration in range(1, settings.max_iterations + 1):
        annealing = max_distance > schedule.final
        moved, nearest = followed.nearest(T.matrix)
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
                f"expected a scale between {_SCALE_RANGE[0]:g} and {_SCALE_RANGE[1]:g}, got {T.scale:.3g}:"
                " `similarity` only refines a scale that is nearly right; give an initial one with --register"
                " points:FILE or matrix:FILE"
            )
        tolerance = max(0.05 * pairs.sigma / np.sqrt(total), 1e-12 * extent)
        # Matches keep flipping at the noise level, so lack of progress also ends the iteration.
        if not annealing and (size < tolerance or (size > 0.5 * previous and size < 20 * tolerance)):
            return IcpResult(T, iteration, True, hint)
        previous = size if not annealing else np.inf
        max_distance = max(schedule.final, schedule.start.narrowing_factor * max_distance)
    return IcpResult(T, settings.max_iterations, False, hint)


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
    motion = -_pseudo_inverse(free @ hessian[:size, :size] @ free) @ (free @ gradient[:size])
    rotation = rotation_from_vector(motion[:3] / radius)
    scale = float(np.exp(np.clip(motion[6] / radius, -0.05, 0.05))) if with_scale else 1.0
    delta = Similarity(rotation, center + motion[3:6] - scale * rotation @ center, scale)
    return delta, float(np.linalg.norm(motion))


def _pseudo_inverse(matrix: FloatArray) -> FloatArray:
    """Return the pseudo-inverse of a symmetric matrix, which ignores motions that the pairs do not fix at all.

    An exact plane does not fix sliding along it, for example. The operations are those of `numpy.linalg.pinv`, to the
    last bit, in a third of the time.
    """
    values, vectors = np.linalg.eigh(matrix)
    order = np.abs(values).argsort()[::-1]
    values, vectors = values[order], vectors.take(order, axis=1)
    sizes = np.abs(values)
    factors = np.divide(1, sizes, out=np.zeros_like(sizes), where=sizes > _MIN_EIGENVALUE_SHARE * sizes[0])
    inverse: FloatArray = (vectors * np.copysign(1.0, values)) @ (factors[:, None] * vectors.T)
    return inverse


def _point_step(target: Surface, pairs: WeightedPairs) -> tuple[Similarity, float]:
    """Compute the best rigid motion of the weighted pairs (Besl & McKay 1992)."""
    pairs = pairs.take(pairs.weights > 0)
    closest_points = target.points[pairs.indices]
    delta = fit_similarity(pairs.moved, closest_points, with_scale=False, weights=pairs.weights)
    size = np.sqrt(np.mean(np.square(delta.apply(pairs.moved) - pairs.moved).sum(axis=1)))
    return delta, float(size)
