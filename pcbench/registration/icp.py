"""ICP that is robust, coarse to fine, and says how sure it is.

Point to plane (Chen & Medioni 1992) or point to point (Besl & McKay 1992), both with Tukey's biweight at the end. What
the geometry does not fix is found (see `degeneracy`), and no motion is made along it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np

from pcbench.errors import InputError, Notice, RegistrationError
from pcbench.geometry.arrays import FloatArray, IntArray, rounding_of
from pcbench.geometry.neighbors import Index
from pcbench.geometry.normals import Surface
from pcbench.geometry.transform import Similarity, fit_similarity
from pcbench.geometry.voxels import voxel_downsample, voxel_downsample_to
from pcbench.native import _core
from pcbench.registration.advice import align_coarsely
from pcbench.registration.quality import MAX_OFF_SURFACE, MIN_EXTENT, MIN_POINTS, Fit, Quality, assess
from pcbench.registration.result import NO_CONVERGENCE
from pcbench.registration.target import Target
from pcbench.registration.weighted_pairs import WeightedPairs, weigh

_FIRST_DISTANCE = 0.1  # of the extent: the first maximum correspondence distance
_SCALE_RANGE = (0.5, 2.0)  # of the initial scale: a refinement that leaves it has collapsed
_MIN_NEAR = 0.01  # share of the sample that has to lie within the maximum correspondence distance


@dataclass(frozen=True)
class IcpSettings:
    """A registration method: coarse-to-fine ICP. The defaults are those of `icp` on the command line.

    Attributes:
        residuals: `plane` (to the reference's tangent planes) or `point` (to its points: less exact; `icp-point`).
        with_scale: whether the scale is refined too (`similarity`); it has to be nearly right at the start.
        max_correspondence_distance: pairs farther apart never count, in the reference's unit. None: a tenth of the
            reference's extent. From the first iteration's it narrows to three spacings of the reference.
        max_iterations: of each of the two stages.
        max_sample: candidate points, evenly spread, that an iteration of the fine stage looks at: enough for
            millimetres, few enough for seconds.

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
            raise InputError("expected residuals `plane` where the scale is solved for: with `point` it would shrink")
        distance = self.max_correspondence_distance
        if distance is not None and not (
            isinstance(distance, int | float | np.number) and np.isfinite(distance) and distance > 0
        ):
            raise InputError(f"expected a positive max_correspondence_distance, got {distance!r}")
        for name, least in (("max_iterations", 1), ("max_sample", MIN_POINTS)):
            value = getattr(self, name)
            if not isinstance(value, int | np.integer) or isinstance(value, bool) or value < least:
                raise InputError(f"expected {name} as a whole number of at least {least}, got {value!r}")

    @property
    def text(self) -> str:
        """As on the command line, followed by the numbers that differ from the defaults."""
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
    """Coarse-to-fine ICP of points to a target, both about one local origin.

    The maximum correspondence distance narrows, then a Tukey kernel whose width follows the residuals decides.
    Robustness is annealed: a robust kernel from the start keeps only what already fits and shrinks the basin. A start
    that keeps all pairs and narrows slowly finds large motions, but slides clouds that overlap in part onto each other:
    it has its turn where the quick one leaves points beside the reference, if they `may_be_far` at all. Where the
    geometry turns out not to observe some motion, the fit is made again constrained not to make it: noise must not move
    the pose.

    Args:
        target: the reference.
        points: (N, 3) of the candidate, minus the reference's local origin.
        settings: residuals, scale and the few numbers.
        initial: the pose to start from, between local coordinates; its scale stays unless the scale is solved for.
        may_be_far: whether the slow start is tried too.

    Raises:
        RegistrationError: there are too few points, the clouds do not overlap, or the scale collapsed.
    """
    if initial is not None:
        # Moved first, the points are in the reference's unit, and what ICP finds is small and well conditioned.
        fit = align(target, initial.apply(points), settings, may_be_far=may_be_far)
        return fit._replace(T_local=fit.T_local @ initial)
    problem = _Problem.of(target, points, settings)
    starts = (_QUICK, _SLOW) if may_be_far else (_QUICK,)
    start, fit = _best_start(problem, starts)
    unobservable = fit.quality.unobservable
    if unobservable.shape[1] and settings.residuals == "plane":
        try:
            constrained = _attempt(problem, start, unobservable)
        except RegistrationError:  # then it is not to be constrained
            constrained = fit
        # Constrained only where nothing speaks against it: a motion that the pairs do want is not noise.
        before, after = fit.quality, constrained.quality
        if after.rmse <= 1.05 * before.rmse and after.overlap >= 0.98 * before.overlap:
            fit = constrained
    if not fit.converged:
        text = f"ICP did not converge within {fit.iterations} iterations: check the aligned clouds"
        warnings = (*fit.quality.warnings, Notice(NO_CONVERGENCE, text))
        fit = fit._replace(quality=fit.quality._replace(warnings=warnings))
    return fit


def refine(target: Target, points: FloatArray, settings: IcpSettings, initial: Similarity) -> Similarity:
    """The quick start of `align` alone, and nothing said of its result: for many poses of which few are kept.

    Raises:
        RegistrationError: as `align`.
    """
    problem = _Problem.of(target, initial.apply(points), settings)
    return _both_stages(problem, _QUICK, np.zeros((7 if settings.with_scale else 6, 0))).T @ initial


class _Start(NamedTuple):
    """How the maximum correspondence distance of the coarse stage narrows."""

    narrowing: float  # what it is multiplied by from iteration to iteration
    kept: float  # share of the nearest pairs that count while it narrows


_QUICK, _SLOW = _Start(0.7, 0.9), _Start(0.95, 1.0)


class _Schedule(NamedTuple):
    """The maximum correspondence distance of one stage: it narrows from `first` to `final`."""

    first: float
    final: float
    start: _Start


class _Problem(NamedTuple):
    """What all attempts share."""

    target: Target
    coarse_sample: Index  # of the candidate
    sample: Index
    settings: IcpSettings

    @classmethod
    def of(cls, target: Target, points: FloatArray, settings: IcpSettings) -> _Problem:
        surface, elsewhere = target.surface, "use --register points:FILE, matrix:FILE or none"
        if len(points) < MIN_POINTS or len(surface) < MIN_POINTS:
            raise RegistrationError(
                f"expected at least {MIN_POINTS} points in each cloud for ICP, got {len(points)} and {len(surface)}:"
                f" {elsewhere}"
            )
        extent, side = target.extent, target.coarse_side
        if extent < MIN_EXTENT:
            raise RegistrationError(f"expected a reference with an extent to register to, got one of {extent:.3g}")
        start = max(extent / 500, target.spacing)
        coarse_sample = Index(points[voxel_downsample(points, side)])
        sample = Index(points[voxel_downsample_to(points, settings.max_sample, start=start)])
        places = min(len(coarse_sample), len(sample))
        if min(places, len(target.coarse)) < MIN_POINTS:
            raise RegistrationError(
                f"expected points at {MIN_POINTS} places at least in each cloud for ICP, got {places} in the candidate"
                f" and {len(target.coarse)} in the reference (places {side:.3g} apart): {elsewhere}"
            )
        return cls(target, coarse_sample, sample, settings)

    def coarse_schedule(self, start: _Start) -> _Schedule:
        limit = self.settings.max_correspondence_distance
        first = _FIRST_DISTANCE * self.target.extent if limit is None else limit
        return _Schedule(first, min(2 * self.target.coarse_side, limit or np.inf), start)

    def fine_schedule(self) -> _Schedule:
        limit = self.settings.max_correspondence_distance or np.inf
        final = max(3 * self.target.spacing, 1e-9 * self.target.extent)
        return _Schedule(min(1.5 * self.target.coarse_side, limit), min(final, limit), _QUICK)


def _best_start(problem: _Problem, starts: tuple[_Start, ...]) -> tuple[_Start, Fit]:
    """The better of the fits from each start; the later ones only where the first leaves points off the surface."""
    free = np.zeros((7 if problem.settings.with_scale else 6, 0))
    fits: list[tuple[_Start, Fit]] = []
    failures: list[RegistrationError] = []
    for start in starts:
        try:
            fits.append((start, _attempt(problem, start, free)))
        except RegistrationError as failure:
            failures.append(failure)
        else:
            if fits[-1][1].quality.off_surface <= MAX_OFF_SURFACE:
                break
    if not fits:
        raise failures[0]
    return max(fits, key=lambda found: _merit(found[1].quality))


def _merit(quality: Quality) -> float:
    return quality.overlap - quality.off_surface


def _attempt(problem: _Problem, start: _Start, constrained: FloatArray) -> Fit:
    """Both stages from the identity, and what is to be said of the result.

    Args:
        constrained: (6 or 7, C) orthonormal motions that are not to be made.
    """
    target, plane = problem.target, problem.settings.residuals == "plane"
    end = _both_stages(problem, start, constrained)
    with_scale = problem.settings.with_scale
    quality = assess(target, problem.sample, end.T, plane=plane, with_scale=with_scale, hint=end.hint)
    return Fit(end.T, quality, end.iterations, end.converged)


class _End(NamedTuple):
    """Where iterations ended."""

    T: Similarity
    iterations: int
    converged: bool
    hint: IntArray | None  # the reference's points that the sample's were nearest to: the next search starts there


def _both_stages(problem: _Problem, start: _Start, constrained: FloatArray) -> _End:
    """The fine stage's end, with the iterations of both."""
    target, settings = problem.target, problem.settings
    # Strays within a large distance shrink the candidate: its scale stands still at first, unless all pairs are kept.
    rigid = settings.with_scale and start.kept < 1 and not constrained.shape[1]
    coarse = (replace(settings, with_scale=False), np.zeros((6, 0))) if rigid else (settings, constrained)
    T = Similarity.identity()
    there = target.surface.index.query(problem.sample.points)
    if there.distances.max() <= rounding_of(problem.sample.points, np.zeros(3)):
        return _End(T, 0, True, there.indices)  # what lies on the reference stays where it is, to the last digit
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
) -> _End:
    """Gauss-Newton on re-matched pairs until the update is below the noise of the estimate.

    Args:
        target: the reference, or its coarse version.
        sample: the candidate's points, before T.
        T: the pose to start from.
        settings: residuals, scale and iterations.
        constrained: (6 or 7, C) orthonormal motions that are not to be made.
        schedule: of the maximum correspondence distance.
        extent: of the reference.
    """
    max_distance = schedule.first
    previous = np.inf
    hint: IntArray | None = None
    for iteration in range(1, settings.max_iterations + 1):
        annealing = max_distance > schedule.final
        moved, nearest = target.index.nearest_of_moved(sample, T.matrix, hint)
        hint = nearest.indices
        pairs = weigh(target, moved, nearest, max_distance, robust=not annealing, kept=schedule.start.kept)
        total = float(pairs.weights.sum())
        if pairs.near < max(MIN_POINTS, _MIN_NEAR * len(sample)) or total < 6:
            raise RegistrationError(
                f"the candidate does not overlap the reference: {pairs.near} of {len(sample)} sampled points"
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
                f"the scale left {_SCALE_RANGE} (got {T.scale:.3g}): `similarity` refines a scale that is nearly right;"
                " give a first one with --register points:FILE or matrix:FILE"
            )
        tolerance = max(0.05 * pairs.sigma / np.sqrt(total), 1e-12 * extent)
        # Matches flip for ever at the level of the noise: no further progress also ends it.
        if not annealing and (size < tolerance or (size > 0.5 * previous and size < 20 * tolerance)):
            return _End(T, iteration, True, hint)
        previous = size if not annealing else np.inf
        max_distance = max(schedule.final, schedule.start.narrowing * max_distance)
    return _End(T, settings.max_iterations, False, hint)


def _plane_step(
    target: Surface, pairs: WeightedPairs, constrained: FloatArray, *, with_scale: bool
) -> tuple[Similarity, float]:
    """One Gauss-Newton step of sum w (n . (dT p - q))^2 (Chen & Medioni 1992), about the pairs' centre.

    The step has no part along the constrained directions: the normal equations are solved in their complement, which
    is least squares under the equality constraints `constrained.T @ motion = 0` (see `degeneracy`).
    """
    hessian, gradient, center = np.empty((7, 7)), np.empty(7), np.empty(3)
    normals = target.with_normals_at(pairs.indices)
    radius = _core.plane_system(
        pairs.moved, normals, pairs.indices, pairs.residuals, pairs.weights, hessian, gradient, center
    )
    size = 7 if with_scale else 6
    free = np.eye(size) - constrained @ constrained.T
    # The pseudo-inverse also leaves alone what the pairs do not fix at all (an exact plane's sliding).
    inverse = np.linalg.pinv(free @ hessian[:size, :size] @ free, rcond=1e-10, hermitian=True)
    motion = -inverse @ (free @ gradient[:size])
    rotation = _rotation(motion[:3] / radius)
    scale = float(np.exp(np.clip(motion[6] / radius, -0.05, 0.05))) if with_scale else 1.0
    delta = Similarity(rotation, center + motion[3:6] - scale * rotation @ center, scale)
    return delta, float(np.linalg.norm(motion))


def _point_step(target: Surface, pairs: WeightedPairs) -> tuple[Similarity, float]:
    """The best rigid motion of the weighted pairs (Besl & McKay 1992)."""
    pairs = pairs.take(pairs.weights > 0)
    closest_points = target.points[pairs.indices]
    delta = fit_similarity(pairs.moved, closest_points, with_scale=False, weights=pairs.weights)
    size = np.sqrt(np.mean(np.square(delta.apply(pairs.moved) - pairs.moved).sum(axis=1)))
    return delta, float(size)


def _rotation(vector: FloatArray) -> FloatArray:
    """Rotation matrix of a rotation vector (Rodrigues)."""
    angle = float(np.linalg.norm(vector))
    if angle < 1e-300:
        return np.eye(3)
    x, y, z = vector / angle
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    rotation: FloatArray = np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * (k @ k)
    return rotation
