"""Bringing a candidate onto the reference: ICP that is robust, says how sure it is, and says when it is not.

Coordinates are recentred first, so that large offsets cost no digits. A registration is a result, never a bare
matrix: residual, overlap, convergence and the direction that the geometry fixes worst come with it.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pcbench.errors import InputError, RegistrationError
from pcbench.geometry.arrays import FloatArray, IntArray, bounds
from pcbench.geometry.cloud import Cloud, as_cloud
from pcbench.geometry.neighbors import Index, Matches
from pcbench.geometry.normals import Surface, plane_normals
from pcbench.geometry.transform import Similarity, fit_similarity, read_matrix
from pcbench.geometry.voxels import cell_means, cells, robust_extent, voxel_downsample, voxel_downsample_to
from pcbench.native import _core

METHODS = ("icp", "icp-point", "similarity", "global", "global-similarity", "points:FILE", "matrix:FILE", "none")

_SAMPLE = 30_000  # candidate points a fine iteration looks at: enough for millimetres, few enough for seconds
_ITERATIONS = 100  # a stage
_START = 0.1  # of the extent: the first gate
_FEWEST = 10  # points that ICP wants of either cloud
_SCALE_RANGE = (0.5, 2.0)  # a refinement that leaves it has collapsed
_NORMAL_NEIGHBORS = 20
_SMALLEST = 1e-150  # extent: squares of less are lost
_INFORMANTS = 10_000  # pairs that are asked what the geometry fixes
_TILES_ALONG = 8  # the scene: of the bootstrap
_REPLICATES = 400
_CLEAR = 5  # standard deviations before a scale is said to be missing
_ON_REFERENCE = 5  # spacings of the reference: a candidate point nearer than that lies on it
_NEAR = 0.05  # of the extent: where a point has its counterpart, if there is one
_MOST_BESIDE = 0.25  # of the candidate, near the reference but not on it, before that is said


class CheckPoint(NamedTuple):
    """A named pair that took no part in the fit, and its distance after it."""

    name: str
    error: float


@dataclass(frozen=True, eq=False)
class Registration:
    """How the candidate was brought onto the reference, and how far that can be trusted.

    Attributes:
        method: as asked for.
        T_reference_candidate: maps candidate to reference coordinates.
        T_local: the same motion between coordinates from which the local origin was subtracted; free of the
            rounding that large translations bring.
        rmse: root mean square of the residuals (to the tangent plane; for `icp-point` to the point) of an even sample
            of the candidate's points that lie on the reference, Tukey-weighted, in the clouds' unit.
        overlap: share of the evenly thinned candidate that lies on the reference: within 5 of its median spacings.
        iterations: of both stages; 0 where nothing was iterated.
        converged: whether the last update was below the noise; None where nothing was iterated.
        information_eigenvalues: of the information matrix of the inliers' point-to-plane pairs per pair, ascending;
            points are centred and divided by their RMS radius, so that rotation and translation share a unit.
        weakest_sigma: predicted standard deviation of the worst-fixed motion, as a displacement at the RMS radius in
            the clouds' unit, by a bootstrap over tiles of an eighth of the scene; too small by up to two thirds where
            errors are alike over more than half a tile. None where the geometry does not fix it.
        check_points: pairs that were not used for the fit.
        warnings: what the user should know before reading any score.
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
    check_points: tuple[CheckPoint, ...] = ()
    warnings: tuple[str, ...] = field(default_factory=tuple)


def register(
    reference: Cloud | ArrayLike, candidate: Cloud | ArrayLike, method: str = "icp", *, target: Target | None = None
) -> Registration:
    """Register a candidate to a reference.

    Args:
        reference, candidate: clouds, or (N, 3) arrays.
        method: `icp` (point to plane), `icp-point`, `similarity` (point to plane with scale: a refinement),
            `global` or `global-similarity` (from nothing, then `icp` or `similarity`), `points:FILE`, `matrix:FILE` or
            `none`.
        target: of the reference's points minus `local_origin(reference)`, if the caller has one already.

    Raises:
        InputError: unknown method, unreadable file.
        RegistrationError: the clouds do not overlap, or the scale collapsed.
        MissingExtra: KISS-Matcher is not installed (`global`).
    """
    reference, candidate = as_cloud(reference), as_cloud(candidate)
    origin = local_origin(reference)
    target = target or Target(Surface(Index(reference.points - origin), given=reference.normals))
    points = candidate.points - origin
    if not isinstance(method, str):
        raise InputError(f"expected the registration as text, got {type(method).__name__}")
    kind, colon, path = method.partition(":")
    if kind in ("icp", "icp-point", "similarity") and not colon:
        result = _icp(target, points, origin, kind)
    elif method in ("global", "global-similarity"):
        from pcbench.registration.from_features import register_from_nothing  # it builds on this module

        result = register_from_nothing(target, points, origin, method)
    elif kind == "matrix" and path:
        result = _given(target, points, origin, method, read_matrix(path))
    elif kind == "points" and path:
        T, checks = fit_pairs(path)
        result = replace(_given(target, points, origin, method, T), check_points=checks)
    elif method == "none":
        result = _given(target, points, origin, method, Similarity.identity())
    else:
        raise InputError(f"unknown registration {method!r}: expected one of {', '.join(METHODS)}")
    if warning := _unit_warning(target.extent, points, result.T_local.scale):
        result = replace(result, warnings=(*result.warnings, warning))
    return result


class Target:
    """A reference to register candidates to: what does not depend on the candidate is computed once."""

    def __init__(self, surface: Surface) -> None:
        self.surface = surface

    @cached_property
    def extent(self) -> float:
        return robust_extent(self.surface.points)

    @property
    def spacing(self) -> float:
        return self.surface.spacing

    @cached_property
    def coarse_side(self) -> float:
        return max(self.extent / 75, self.spacing)

    @cached_property
    def coarse(self) -> Surface:
        """The surface, one mean point a cell of `coarse_side`."""
        return Surface(Index(cell_means(self.surface.points, self.coarse_side)))


def local_origin(cloud: Cloud) -> FloatArray:
    """The round point (3,) near a cloud's centre that is subtracted before anything is computed.

    Whole numbers, because subtracting them from coordinates on any binary grid is exact: a cloud at UTM coordinates
    and the same cloud at the origin become the same bits. For a cloud smaller than 1, multiples of a power of two.
    """
    lower, upper = cloud.bounds
    extent = float((upper - lower).max())
    step = 2.0 ** min(0, np.frexp(extent)[1] - 1) if extent > 0 else 2.0**-1000
    center: FloatArray = 0.5 * lower + 0.5 * upper
    return np.floor(center / step) * step if extent > 0 else center


class _Pairs(NamedTuple):
    """Weighted correspondences of one iteration; `residuals` are what is minimised."""

    moved: FloatArray  # (M, 3) candidate points in the reference frame
    indices: IntArray  # (M,) of the reference points they are matched with
    distances: FloatArray  # (M,) point to point
    residuals: FloatArray  # (M,) signed, along the reference's normals
    weights: FloatArray  # (M,) in [0, 1]
    near: int  # of them lie within the gate; the others weigh nothing
    sigma: float  # robust standard deviation of the residuals of those

    def take(self, which: NDArray[np.bool_] | slice) -> _Pairs:
        return _Pairs(
            self.moved[which],
            self.indices[which],
            self.distances[which],
            self.residuals[which],
            self.weights[which],
            self.near,
            self.sigma,
        )


def _icp(target: Target, points: FloatArray, origin: FloatArray, kind: str, *, may_be_far: bool = True) -> Registration:
    """Coarse to fine; the gate narrows, then a Tukey kernel whose width follows the residuals decides.

    Robustness is annealed: a robust kernel from the start keeps only what already fits and shrinks the basin. A start
    that keeps all pairs and narrows slowly finds large motions, but slides clouds that overlap in part onto each other:
    it has its turn where the quick one leaves points beside the reference, if they `may_be_far` at all. Where the
    geometry turns out not to fix some motion, the fit is made again with it held: noise must not move the pose.
    """
    surface = target.surface
    if len(points) < _FEWEST or len(surface) < _FEWEST:
        raise RegistrationError(
            f"expected at least {_FEWEST} points in each cloud for ICP, got {len(points)} and {len(surface)}: use"
            " --register points:FILE, matrix:FILE or none"
        )
    extent, spacing, coarse_side = target.extent, target.spacing, target.coarse_side
    if extent < _SMALLEST:
        raise RegistrationError(f"expected a reference with an extent to register to, got one of {extent:.3g}")
    coarse_sample = Index(points[voxel_downsample(points, coarse_side)])
    sample = Index(points[voxel_downsample_to(points, _SAMPLE, start=max(extent / 500, spacing))])
    with_scale = kind == "similarity"
    quick = _Gate(_START * extent, 2 * coarse_side, narrowing=0.7, kept=0.9)
    if min(len(coarse_sample), len(sample), len(target.coarse)) < _FEWEST:
        raise RegistrationError(
            f"expected points at {_FEWEST} places at least in each cloud for ICP, got"
            f" {min(len(coarse_sample), len(sample))} in the candidate and {len(target.coarse)} in the reference"
            f" (places {coarse_side:.3g} apart): use --register points:FILE, matrix:FILE or none"
        )
    fine = quick._replace(first=1.5 * coarse_side, final=max(3 * spacing, 1e-9 * extent))

    def attempt(start: _Gate, held: FloatArray) -> _Fit:
        # Strays make a wide gate shrink the candidate: its scale stands still at first, unless all pairs are kept.
        still = with_scale and start.kept < 1 and not held.shape[1]
        motions = ("icp", np.zeros((6, 0))) if still else (kind, held)
        T, first, _ = _iterate(target.coarse, coarse_sample, Similarity.identity(), *motions, gate=start, extent=extent)
        T, second, converged = _iterate(surface, sample, T, kind, held, gate=fine, extent=extent)
        quality = _assess(target, sample, T, plane=kind != "icp-point", with_scale=with_scale)
        return _Fit(start, T, first + second, converged, quality)

    fits: list[_Fit] = []
    failures: list[RegistrationError] = []
    for start in (quick, quick._replace(narrowing=0.95, kept=1.0)) if may_be_far else (quick,):
        try:
            fits.append(attempt(start, np.zeros((7 if with_scale else 6, 0))))
        except RegistrationError as failure:
            failures.append(failure)
        else:
            if fits[-1].quality.beside <= _MOST_BESIDE:
                break
    if not fits:
        raise failures[0]
    fit = max(fits, key=lambda fit: fit.quality.overlap - fit.quality.beside)
    if fit.quality.unfixed.shape[1] and kind != "icp-point":
        try:
            held = attempt(fit.start, fit.quality.unfixed)
        except RegistrationError:  # then it is not to be held
            held = fit
        # Held only where nothing speaks against it: a motion that the pairs do want is not noise.
        if held.quality.rmse <= 1.05 * fit.quality.rmse and held.quality.overlap >= 0.98 * fit.quality.overlap:
            fit = held
    _, T, iterations, converged, quality = fit
    if not converged:
        quality.warnings.append(f"ICP did not converge within {iterations} iterations: check the aligned clouds")
    return _registration(kind, T.about(origin), T, quality, iterations, converged)


class _Gate(NamedTuple):
    """Which pairs count: up to a distance that narrows from `first` to `final`."""

    first: float
    final: float
    narrowing: float  # what the distance is multiplied by from iteration to iteration
    kept: float  # share of the nearest pairs that count while it narrows


class _Fit(NamedTuple):
    start: _Gate
    T: Similarity
    iterations: int
    converged: bool
    quality: _Quality


def _iterate(
    target: Surface,
    sample: Index,
    T: Similarity,
    kind: str,
    held: FloatArray,
    *,
    gate: _Gate,
    extent: float,
) -> tuple[Similarity, int, bool]:
    """Gauss-Newton on re-matched pairs until the update is below the noise of the estimate.

    Args:
        held: (6 or 7, H) orthonormal motions that are not to be made.
    """
    radius = gate.first
    previous = np.inf
    hint: IntArray | None = None  # where the last search ended: the next one starts there
    for iteration in range(1, _ITERATIONS + 1):
        annealing = radius > gate.final
        moved, nearest = target.index.nearest_of_moved(sample, T.matrix, hint)
        hint = nearest.indices
        pairs = _weigh(target, moved, nearest, radius, robust=not annealing, kept=gate.kept)
        total = float(pairs.weights.sum())
        if pairs.near < max(_FEWEST, 0.01 * len(sample)) or total < 6:
            raise RegistrationError(
                f"the candidate does not overlap the reference: {pairs.near} of {len(sample)} sampled points"
                f" lie within {radius:.3g} of it. Align it coarsely first (--register points:FILE or matrix:FILE),"
                " and check that both clouds use the same unit and coordinate system"
            )
        if kind == "icp-point":
            delta, size = _point_step(target, pairs)
        else:
            delta, size = _plane_step(target, pairs, held, with_scale=kind == "similarity")
        T = delta @ T
        if kind == "similarity" and not _SCALE_RANGE[0] < T.scale < _SCALE_RANGE[1]:
            raise RegistrationError(
                f"the scale left {_SCALE_RANGE} (got {T.scale:.3g}): `similarity` refines a scale that is nearly right;"
                " give a first one with --register points:FILE or matrix:FILE"
            )
        tolerance = max(0.05 * pairs.sigma / np.sqrt(total), 1e-12 * extent)
        # Matches flip for ever at the level of the noise: no further progress also ends it.
        if not annealing and (size < tolerance or (size > 0.5 * previous and size < 20 * tolerance)):
            return T, iteration, True
        previous = size if not annealing else np.inf
        radius = max(gate.final, gate.narrowing * radius)
    return T, _ITERATIONS, False


def _weigh(
    target: Surface, moved: FloatArray, nearest: Matches, gate: float, *, robust: bool, kept: float = 1.0
) -> _Pairs:
    """Tukey's biweight where robust, its width following the residuals; else 1 for the share `kept` of near pairs."""
    distances, indices = nearest
    normals = target.with_normals_at(indices)
    residuals, weights = np.empty(len(moved)), np.empty(len(moved))
    near, sigma = _core.weigh(moved, distances, target.points, indices, normals, gate, robust, kept, residuals, weights)
    return _Pairs(moved, indices, distances, residuals, weights, near, sigma)


def _plane_step(target: Surface, pairs: _Pairs, held: FloatArray, *, with_scale: bool) -> tuple[Similarity, float]:
    """One Gauss-Newton step of sum w (n . (dT p - q))^2 (Chen & Medioni 1992), about the pairs' centre."""
    hessian, gradient, center = np.empty((7, 7)), np.empty(7), np.empty(3)
    normals = target.with_normals_at(pairs.indices)
    radius = _core.plane_system(
        pairs.moved, normals, pairs.indices, pairs.residuals, pairs.weights, hessian, gradient, center
    )
    size = 7 if with_scale else 6
    free = np.eye(size) - held @ held.T
    # The pseudo-inverse leaves alone what is held and what the pairs do not fix at all (an exact plane's sliding).
    inverse = np.linalg.pinv(free @ hessian[:size, :size] @ free, rcond=1e-10, hermitian=True)
    motion = -inverse @ (free @ gradient[:size])
    rotation = _rotation(motion[:3] / radius)
    scale = float(np.exp(np.clip(motion[6] / radius, -0.05, 0.05))) if with_scale else 1.0
    delta = Similarity(rotation, center + motion[3:6] - scale * rotation @ center, scale)
    return delta, float(np.linalg.norm(motion))


def _point_step(target: Surface, pairs: _Pairs) -> tuple[Similarity, float]:
    """The best rigid motion of the weighted pairs (Besl & McKay 1992)."""
    pairs = pairs.take(pairs.weights > 0)
    feet = target.points[pairs.indices]
    delta = fit_similarity(pairs.moved, feet, with_scale=False, weights=pairs.weights)
    size = np.sqrt(np.mean(np.square(delta.apply(pairs.moved) - pairs.moved).sum(axis=1)))
    return delta, float(size)


class _Arms(NamedTuple):
    """What motions are measured about and by: the pairs' weighted centre (3,) and their RMS radius."""

    center: FloatArray
    radius: float

    @classmethod
    def of(cls, pairs: _Pairs) -> _Arms:
        total = pairs.weights.sum()
        center = (pairs.moved * pairs.weights[:, None]).sum(axis=0) / total
        squares = np.square(pairs.moved - center).sum(axis=1)
        return cls(center, float(np.sqrt((squares * pairs.weights).sum() / total)) or 1.0)

    def jacobian(self, points: FloatArray, normals: FloatArray) -> FloatArray:
        """Rows (M, 7): residual change by rotation, translation and log-scale, as lengths at the radius."""
        arms = points - self.center
        growth = np.einsum("ni,ni->n", arms, normals)[:, None]
        return np.hstack([np.cross(arms, normals) / self.radius, normals, growth / self.radius])


class _Quality(NamedTuple):
    rmse: float
    overlap: float
    beside: float  # share of the points near the reference that do not lie on it
    eigenvalues: tuple[float, ...]
    weakest_sigma: float | None
    unfixed: FloatArray  # (6 or 7, U) orthonormal motions that the geometry does not fix
    warnings: list[str]


def _assess(target: Target, sample: Index, T: Similarity, *, plane: bool, with_scale: bool) -> _Quality:
    """Residual, overlap and what the geometry fixes, at a transform that is taken as it is."""
    surface, spacing = target.surface, target.spacing
    moved, nearest = surface.index.nearest_of_moved(sample, T.matrix)
    distances = nearest.distances
    # One distance for every method: were it to follow the fit, the worse the fit, the more would count as overlap.
    within = _ON_REFERENCE * spacing
    overlap = float(np.mean(distances <= within))
    # What the geometry fixes is asked of all pairs that the fit may have used, where density varies of far more.
    reach = np.clip(3 * _mad(distances[distances <= np.median(distances)]), 3 * spacing, 10 * spacing)
    gates = (within, reach) if len(surface) >= 3 and target.extent > _SMALLEST else ()
    weighed = [_weigh(surface, moved, nearest, gate, robust=True) for gate in gates]
    # A part that the reference does not have lies far from it; a wrong pose leaves points beside what they belong to.
    # Tangent planes bridge what the reference samples thinly, such as the gaps between a scanner's lines.
    near = distances <= max(_NEAR * target.extent, within)
    on_surface = (np.abs(weighed[0].residuals) if weighed else distances) <= within
    beside = 1 - float(np.mean(on_surface[near])) if near.any() else 1.0
    if not weighed or min(np.count_nonzero(pairs.weights) for pairs in weighed) < _FEWEST:
        rms = float(np.sqrt(np.mean(np.square(distances))))
        size = 7 if with_scale else 6
        return _Quality(
            rms, overlap, beside, (), None, np.zeros((size, 0)), ["too few points to say what the geometry fixes"]
        )
    on_it, pairs = (pairs.take(pairs.weights > 0) for pairs in weighed)
    errors = on_it.residuals if plane else on_it.distances
    rmse = float(np.sqrt((on_it.weights * errors**2).sum() / on_it.weights.sum()))
    typical = float(np.percentile(distances, 25))  # the quarter that fits best: partial overlap is no failure
    eigenvalues, weakest, unfixed, warnings = _information(surface, pairs, with_scale=with_scale)
    if overlap < 0.3:
        warnings.append(f"only {overlap:.0%} of the candidate lies on the reference")
    if beside > _MOST_BESIDE:
        warnings.append(
            f"{beside:.0%} of the candidate near the reference does not lie on it: a wrong alignment, outliers or"
            " changes"
        )
    if typical > 10 * spacing > 0:
        warnings.append(
            f"the candidate lies far off the reference (its nearest quarter by {typical:.3g}, {typical / spacing:.0f}"
            " times the reference's spacing): the registration may have failed"
        )
    return _Quality(rmse, overlap, beside, eigenvalues, weakest, unfixed, warnings)


def _registration(
    method: str, T: Similarity, T_local: Similarity, quality: _Quality, iterations: int, converged: bool | None
) -> Registration:
    return Registration(
        method=method,
        T_reference_candidate=T,
        T_local=T_local,
        rmse=quality.rmse,
        overlap=quality.overlap,
        iterations=iterations,
        converged=converged,
        information_eigenvalues=quality.eigenvalues,
        weakest_sigma=quality.weakest_sigma,
        warnings=tuple(quality.warnings),
    )


def _information(
    target: Surface, pairs: _Pairs, *, with_scale: bool
) -> tuple[tuple[float, ...], float | None, FloatArray, list[str]]:
    """Eigenvalues of the information per pair, the weakest direction's sigma, what is not fixed, and warnings.

    Estimated normals are noisy, and noise looks like information about sliding. So each pair's normal is estimated
    twice, from two disjoint halves of the neighbours: the product of the two is free of that bias. Its scatter over
    spatial tiles says whether what remains differs from zero.
    """
    size = 7 if with_scale else 6
    step = max(1, len(pairs.weights) // _INFORMANTS)
    side = float(np.ptp(pairs.moved, axis=0).max()) / _TILES_ALONG
    tile = cells(pairs.moved, side or 1.0).of_point
    tiles = int(tile.max()) + 1
    some, of_some = pairs.take(slice(None, None, step)), tile[::step]
    arms = _Arms.of(pairs)
    a, b = (arms.jacobian(some.moved, normals) for normals in _split_normals(target.index, some.indices))
    weight = np.bincount(of_some, some.weights, tiles)
    total = weight.sum()
    residual = float(np.sqrt((pairs.weights * pairs.residuals**2).sum() / pairs.weights.sum()))
    with_growth = _sums_by_tile(of_some, a, b * some.weights[:, None], tiles)
    by_tile = with_growth[:, :size, :size]
    values, vectors = np.linalg.eigh(by_tile.sum(axis=0) / total)

    # Scatter of each direction's information over tiles.
    shares = np.einsum("ik,tij,jk->tk", vectors, by_tile, vectors, optimize=False)
    error = np.sqrt(np.square(shares - values * weight[:, None]).sum(axis=0)) / total
    fixed = (values > np.maximum(3 * error, 1e-9)) & (np.count_nonzero(weight) > 1)
    eigenvalues, unfixed = tuple(float(v) for v in values), vectors[:, ~fixed]
    if not fixed.all():
        motions = " and ".join(_describe_motion(vector) for vector in unfixed.T)
        return eigenvalues, None, unfixed, [f"the geometry does not fix {motions}: scores along it mean nothing"]

    curvature = _sums_by_tile(of_some, a, b * _tukey_slope(some)[:, None], tiles) * step
    normals = target.normals(pairs.indices)
    pull = arms.jacobian(pairs.moved, normals) * (pairs.weights * pairs.residuals)[:, None]
    gradient = np.stack([np.bincount(tile, column, tiles).astype(np.float64) for column in pull.T], axis=1)
    _, covariance = _bootstrap(curvature[:, :size, :size], gradient[:, :size])
    variances, directions = np.linalg.eigh(covariance)
    weakest, direction = float(np.sqrt(variances[-1])), directions[:, -1]
    warnings = []
    if not with_scale:
        # Steps of Gauss and Newton: where a scale is missing, residuals are large, and the robust cost nearly flat.
        wanted, covariance = _bootstrap(step * with_growth, gradient)
        if abs(wanted[6]) > max(_CLEAR * np.sqrt(covariance[6, 6]), 0.5 * residual, 1e-9 * arms.radius):
            factor = np.exp(wanted[6] / arms.radius)
            warnings.append(f"the pairs ask for a scale of about {factor:.5g}: --register similarity finds it")
    if weakest > 0.5 * residual:
        motion = _describe_motion(direction)
        warnings.append(f"the geometry hardly fixes {motion} (predicted sigma {weakest:.3g})")
    return eigenvalues, weakest, unfixed, warnings


def _bootstrap(curvature: FloatArray, gradient: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The motion (K,) that the pairs still ask for, and its covariance (K, K).

    The tiles of space are resampled (Bayesian bootstrap, Rubin 1981), not the pairs: neighbouring residuals are not
    independent, and a closed form that takes them so is over-confident several times. Each replicate is one Newton step
    from per-tile curvatures (T, K, K) and gradients (T, K) of the robust cost.
    """
    weights = np.random.default_rng(0).exponential(size=(_REPLICATES, len(gradient)))
    hessians = np.einsum("rt,tij->rij", weights, curvature, optimize=False)
    steps = -np.linalg.solve(hessians, np.einsum("rt,ti->ri", weights, gradient, optimize=False)[:, :, None])[:, :, 0]
    motion: FloatArray = np.median(steps, axis=0)
    steps -= motion
    return motion, np.einsum("ri,rj->ij", steps, steps, optimize=False) / len(steps)


def _sums_by_tile(tile: IntArray, a: FloatArray, b: FloatArray, tiles: int) -> FloatArray:
    """Symmetrised sums (T, K, K) of the outer products of the rows of a and b (M, K)."""
    size = a.shape[1]
    sums = np.empty((tiles, size, size))
    for i in range(size):
        for j in range(i + 1):
            product = 0.5 * (a[:, i] * b[:, j] + a[:, j] * b[:, i])
            sums[:, i, j] = sums[:, j, i] = np.bincount(tile, product, tiles)
    return sums


def _tukey_slope(pairs: _Pairs) -> FloatArray:
    """Derivative (M,) of the residuals' pull: of w(r) r with Tukey's w = (1 - u)^2, u = (r / width)^2."""
    root = np.sqrt(pairs.weights)
    slope: FloatArray = root * (5 * root - 4)  # (1 - u)(1 - 5 u)
    return slope


def _split_normals(index: Index, which: IntArray) -> tuple[FloatArray, FloatArray]:
    """Two estimates of each normal from disjoint halves of the neighbours, with one sign."""
    unique, inverse = np.unique(which, return_inverse=True)
    neighbors = index.query(index.points[unique], min(2 * _NORMAL_NEIGHBORS, len(index))).indices
    first = plane_normals(index.points, neighbors[:, 0::2]).directions
    second = plane_normals(index.points, neighbors[:, 1::2]).directions
    flip = np.einsum("ni,ni->n", first, second) < 0
    return first[inverse], np.where(flip[:, None], -second, second)[inverse]


def _describe_motion(vector: FloatArray) -> str:
    parts = {"a rotation": vector[:3], "a translation": vector[3:6], "the scale": vector[6:]}
    name = max(parts, key=lambda part: float(np.linalg.norm(parts[part])))
    if name == "the scale":
        return name
    axis = parts[name] / np.linalg.norm(parts[name])
    where = "about" if name == "a rotation" else "along"
    return f"{name} {where} ({', '.join(f'{v:+.2f}' for v in axis * np.sign(axis[np.abs(axis).argmax()]))})"


def _given(target: Target, points: FloatArray, origin: FloatArray, method: str, T: Similarity) -> Registration:
    """A transform from elsewhere, assessed like one of ours."""
    surface, local = target.surface, T.about(-origin)
    start = max(target.extent / 500, target.spacing)
    sample = Index(
        points[voxel_downsample_to(points, _SAMPLE, start=start)] if target.spacing > 0 else points[:_SAMPLE]
    )
    moved = local.apply(sample.points)
    lower, upper = bounds(surface.points)
    margin = 0.1 * float(np.linalg.norm(upper - lower))
    # Fewer than three points have no extent to overlap with.
    if len(surface) >= 3 and ((moved.min(axis=0) > upper + margin).any() or (moved.max(axis=0) < lower - margin).any()):
        raise RegistrationError(
            f"the candidate does not overlap the reference after --register {method}: their bounding boxes lie apart"
            f" (reference centre {_format(origin)}, candidate centre {_format(moved.mean(axis=0) + origin)})"
        )
    quality = _assess(target, sample, local, plane=True, with_scale=local.scale != 1)
    return _registration(method, T, local, quality, 0, None)


def fit_pairs(path: str) -> tuple[Similarity, tuple[CheckPoint, ...]]:
    """A similarity from a file of pairs: name, candidate x y z, reference x y z; names that end in * are checks."""
    try:
        lines = Path(path).read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "not a text file"
        raise InputError(f"{path}: cannot read the pairs: {reason}") from error
    names, rows = [], []
    for number, line in enumerate(lines, 1):
        words = line.split("#")[0].replace(",", " ").replace(";", " ").split()
        if not words:
            continue
        try:
            rows.append([float(word) for word in words[1:]])
        except ValueError:
            if not rows and number == 1:  # a header line
                continue
            raise InputError(f"{path}: line {number}: expected a name and six numbers, got {line.strip()!r}") from None
        if len(words) != 7 or not np.isfinite(rows[-1]).all():
            raise InputError(f"{path}: line {number}: expected a name and six finite numbers, got {line.strip()!r}")
        names.append(words[0])
    pairs = np.array(rows).reshape(-1, 6)
    check = np.array([name.endswith("*") for name in names], dtype=bool)
    try:
        T = fit_similarity(pairs[~check, :3], pairs[~check, 3:])
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    errors = np.linalg.norm(T.apply(pairs[:, :3]) - pairs[:, 3:], axis=1)
    return T, tuple(CheckPoint(n.rstrip("*"), float(e)) for n, e, c in zip(names, errors, check, strict=True) if c)


def _unit_warning(extent: float, candidate: FloatArray, scale: float) -> str | None:
    """A warning where the extents differ by a factor that looks like a unit."""
    ratio = scale * robust_extent(candidate) / (extent or np.inf)
    for factor, what in (
        (1000, "millimetres against metres"),
        (100, "centimetres against metres"),
        (1 / 0.3048, "feet against metres"),
        (1 / 0.0254, "inches against metres"),
    ):
        for expected, text in ((factor, what), (1 / factor, " against ".join(what.split(" against ")[::-1]))):
            # Extents of clouds of one scene agree to some per cent only where both cover all of it.
            if abs(np.log(ratio / expected) if ratio > 0 else np.inf) < 0.05:
                return f"the candidate's extent is {ratio:.4g} times the reference's: {text}?"
    return None


def _mad(values: FloatArray) -> float:
    """Robust standard deviation about zero: 1.4826 times the median absolute value."""
    return 1.4826 * float(np.median(np.abs(values))) if len(values) else 0.0


def _rotation(vector: FloatArray) -> FloatArray:
    """Rotation matrix of a rotation vector (Rodrigues)."""
    angle = float(np.linalg.norm(vector))
    if angle < 1e-300:
        return np.eye(3)
    x, y, z = vector / angle
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    rotation: FloatArray = np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * (k @ k)
    return rotation


def _format(point: FloatArray) -> str:
    return "(" + ", ".join(f"{v:.6g}" for v in point) + ")"
