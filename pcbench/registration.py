"""Bringing a candidate onto the reference: ICP that is robust, says how sure it is, and says when it is not.

Coordinates are recentred first, so that large offsets cost no digits. A registration is a result, never a bare
matrix: residual, overlap, convergence and the direction that the geometry fixes worst come with it.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pcbench.cloud import Cloud, as_cloud
from pcbench.errors import InputError, RegistrationError
from pcbench.neighbors import FloatArray, Index, IntArray, Matches
from pcbench.normals import Surface, plane_normals
from pcbench.transform import Similarity, fit_similarity, read_matrix
from pcbench.voxels import cell_keys, cell_means, robust_extent, thin, thin_to

METHODS = ("icp", "icp-point", "similarity", "global", "global-similarity", "points:FILE", "matrix:FILE", "none")

_SAMPLE = 30_000  # candidate points a fine iteration looks at: enough for millimetres, few enough for seconds
_ITERATIONS = 60  # a stage
_FEWEST = 10  # points that ICP wants of either cloud
_SCALE_RANGE = (0.5, 2.0)  # a refinement that leaves it has collapsed
_NORMAL_NEIGHBORS = 20
_ON_REFERENCE = 5  # spacings of the reference: a candidate point nearer than that lies on it


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
        T_local: the same motion between coordinates from which the recentring origin was subtracted; free of the
            rounding that large translations bring.
        rmse: root mean square of the residuals (to the tangent plane; for `icp-point` to the point) of an even sample
            of the candidate's points that lie on the reference, Tukey-weighted, in the clouds' unit.
        overlap: share of the evenly thinned candidate that lies on the reference: within 5 of its median spacings.
        iterations: of both stages; 0 where nothing was iterated.
        converged: whether the last update was below the noise; None where nothing was iterated.
        information_eigenvalues: of the information matrix of the inliers' point-to-plane pairs per pair, ascending;
            points are centred and divided by their RMS radius, so that rotation and translation share a unit.
        weakest_sigma: predicted standard deviation of the worst-fixed motion, as a displacement at the RMS radius in
            the clouds' unit; None where the geometry does not fix it.
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
    reference: Cloud | ArrayLike, candidate: Cloud | ArrayLike, method: str = "icp", *, surface: Surface | None = None
) -> Registration:
    """Register a candidate to a reference.

    Args:
        reference, candidate: clouds, or (N, 3) arrays.
        method: `icp` (point to plane), `icp-point`, `similarity` (point to plane with scale: a refinement),
            `global` or `global-similarity` (from nothing, then `icp` or `similarity`), `points:FILE`, `matrix:FILE` or
            `none`.
        surface: of the reference's points minus `recentring(reference)`, if the caller has one already.

    Raises:
        InputError: unknown method, unreadable file.
        RegistrationError: the clouds do not overlap, or the scale collapsed.
        MissingExtra: KISS-Matcher is not installed (`global`).
    """
    reference, candidate = as_cloud(reference), as_cloud(candidate)
    origin = recentring(reference)
    surface = surface or Surface(Index(reference.points - origin), given=reference.normals)
    points = candidate.points - origin
    if not isinstance(method, str):
        raise InputError(f"expected the registration as text, got {type(method).__name__}")
    kind, colon, path = method.partition(":")
    if kind in ("icp", "icp-point", "similarity") and not colon:
        result = _icp(surface, points, origin, kind)
    elif method in ("global", "global-similarity"):
        from pcbench.global_registration import register_from_nothing  # it builds on this module

        result = register_from_nothing(surface, points, origin, method)
    elif kind == "matrix" and path:
        result = _given(surface, points, origin, method, read_matrix(path))
    elif kind == "points" and path:
        T, checks = _fit_pairs(path)
        result = replace(_given(surface, points, origin, method, T), check_points=checks)
    elif method == "none":
        result = _given(surface, points, origin, method, Similarity.identity())
    else:
        raise InputError(f"unknown registration {method!r}: expected one of {', '.join(METHODS)}")
    if warning := _unit_warning(surface.points, points, result.T_local.scale):
        result = replace(result, warnings=(*result.warnings, warning))
    return result


def recentring(cloud: Cloud) -> FloatArray:
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
    feet: FloatArray  # (M, 3) matched reference points
    normals: FloatArray  # (M, 3) of the reference at the feet
    indices: IntArray  # (M,) of the feet
    distances: FloatArray  # (M,) point to point
    residuals: FloatArray  # (M,) signed, along the normals
    weights: FloatArray  # (M,) in [0, 1]

    def take(self, which: NDArray[np.bool_] | slice) -> _Pairs:
        return _Pairs(
            self.moved[which],
            self.feet[which],
            self.normals[which],
            self.indices[which],
            self.distances[which],
            self.residuals[which],
            self.weights[which],
        )


def _icp(target: Surface, points: FloatArray, origin: FloatArray, kind: str) -> Registration:
    """Coarse to fine; the gate narrows, then a Tukey kernel whose width follows the residuals decides.

    Robustness is annealed: a robust kernel from the start keeps only what already fits and shrinks the basin. Where the
    geometry turns out not to fix some motion, all starts again with that motion held: noise must not move the pose.
    """
    if len(points) < _FEWEST or len(target) < _FEWEST:
        raise RegistrationError(
            f"expected at least {_FEWEST} points in each cloud for ICP, got {len(points)} and {len(target)}: use"
            " --register points:FILE, matrix:FILE or none"
        )
    extent = robust_extent(target.points)
    if extent == 0:
        raise RegistrationError("expected a reference with an extent to register to, got points at one place")
    spacing = _spacing(target.index)
    coarse_side = max(extent / 150, spacing)
    coarse = Surface(Index(cell_means(target.points, coarse_side)))
    coarse_sample = points[thin(points, coarse_side)]
    sample = points[thin_to(points, _SAMPLE, start=max(extent / 500, spacing))]
    with_scale = kind == "similarity"
    wide, narrow = (0.1 * extent, 2 * coarse_side), (3 * coarse_side, max(3 * spacing, 1e-9 * extent))

    def attempt(held: FloatArray) -> tuple[Similarity, int, bool, _Quality]:
        T, first, _ = _iterate(coarse, coarse_sample, Similarity.identity(), kind, held, gate=wide, extent=extent)
        T, second, converged = _iterate(target, sample, T, kind, held, gate=narrow, extent=extent)
        quality = _assess(target, sample, T, plane=kind != "icp-point", with_scale=with_scale, spacing=spacing)
        return T, first + second, converged, quality

    T, iterations, converged, quality = attempt(np.zeros((7 if with_scale else 6, 0)))
    if quality.unfixed.shape[1] and kind != "icp-point":
        held = attempt(quality.unfixed)
        # Held only where nothing speaks against it: a motion that the pairs do want is not noise.
        if held[3].rmse <= 1.05 * quality.rmse and held[3].overlap >= 0.98 * quality.overlap:
            T, iterations, converged, quality = held
    if not converged:
        quality.warnings.append(f"ICP did not converge within {iterations} iterations: check the aligned clouds")
    return _registration(kind, T.about(origin), T, quality, iterations, converged)


def _iterate(
    target: Surface,
    sample: FloatArray,
    T: Similarity,
    kind: str,
    held: FloatArray,
    *,
    gate: tuple[float, float],
    extent: float,
) -> tuple[Similarity, int, bool]:
    """Gauss-Newton on re-matched pairs until the update is below the noise of the estimate.

    Args:
        held: (6 or 7, H) orthonormal motions that are not to be made.
        gate: largest distance of a pair at first and in the end.
    """
    radius, final = gate
    previous = np.inf
    hint: IntArray | None = None  # where the last search ended: the next one starts there
    for iteration in range(1, _ITERATIONS + 1):
        annealing = radius > final
        moved = T.apply(sample)
        nearest = target.index.query(moved, hint=hint)
        hint = nearest.indices
        pairs = _weigh(target, moved, nearest, radius, robust=not annealing)
        if len(pairs.weights) < max(_FEWEST, 0.01 * len(sample)) or pairs.weights.sum() < 6:
            raise RegistrationError(
                f"the candidate does not overlap the reference: {len(pairs.weights)} of {len(sample)} sampled points"
                f" lie within {radius:.3g} of it. Align it coarsely first (--register points:FILE or matrix:FILE),"
                " and check that both clouds use the same unit and coordinate system"
            )
        if kind == "icp-point":
            delta, size = _point_step(pairs)
        else:
            delta, size = _plane_step(pairs, held, with_scale=kind == "similarity")
        T = delta @ T
        if kind == "similarity" and not _SCALE_RANGE[0] < T.scale < _SCALE_RANGE[1]:
            raise RegistrationError(
                f"the scale left {_SCALE_RANGE} (got {T.scale:.3g}): `similarity` refines a scale that is nearly right;"
                " give a first one with --register points:FILE or matrix:FILE"
            )
        sigma = _mad(pairs.residuals)
        tolerance = max(0.05 * sigma / np.sqrt(pairs.weights.sum()), 1e-12 * extent)
        # Matches flip for ever at the level of the noise: no further progress also ends it.
        if not annealing and (size < tolerance or (size > 0.5 * previous and size < 20 * tolerance)):
            return T, iteration, True
        previous = size if not annealing else np.inf
        # Never below what the pairs themselves spread: cutting into the noise would bias them.
        radius = max(final, min(0.7 * radius, radius)) if annealing else radius
    return T, _ITERATIONS, False


def _weigh(target: Surface, moved: FloatArray, nearest: Matches, radius: float, *, robust: bool) -> _Pairs:
    distances, indices = nearest
    near = distances <= radius
    moved, distances, indices = moved[near], distances[near], indices[near]
    feet, normals = target.points[indices], target.normals(indices)
    residuals = np.einsum("ni,ni->n", moved - feet, normals)
    if robust and len(residuals):
        # Tukey's biweight at 95 % efficiency; exact copies have residuals of nothing but rounding.
        width = 4.685 * max(_mad(residuals), 1e-12 * radius, np.finfo(float).tiny)
        weights = np.square(np.clip(1 - np.square(residuals / width), 0, None))
    else:
        # Trimmed: the worst tenth is dropped while the gate is still wide.
        limit = np.quantile(distances, 0.9) if len(distances) else 0.0
        weights = (distances <= limit).astype(np.float64)
    return _Pairs(moved, feet, normals, indices, distances, residuals, weights)


def _plane_step(pairs: _Pairs, held: FloatArray, *, with_scale: bool) -> tuple[Similarity, float]:
    """One Gauss-Newton step of sum w (n . (dT p - q))^2 (Chen & Medioni 1992), about the pairs' centre."""
    jacobian, center, radius = _jacobian(pairs, with_scale=with_scale)
    hessian = np.einsum("ni,n,nj->ij", jacobian, pairs.weights, jacobian, optimize=False)
    gradient = np.einsum("ni,n,n->i", jacobian, pairs.weights, pairs.residuals, optimize=False)
    free = np.eye(len(hessian)) - held @ held.T
    # The pseudo-inverse leaves alone what is held and what the pairs do not fix at all (an exact plane's sliding).
    motion = -np.linalg.pinv(free @ hessian @ free, rcond=1e-10, hermitian=True) @ (free @ gradient)
    rotation = _rotation(motion[:3] / radius)
    scale = float(np.exp(np.clip(motion[6] / radius, -0.05, 0.05))) if with_scale else 1.0
    delta = Similarity(rotation, center + motion[3:6] - scale * rotation @ center, scale)
    return delta, float(np.linalg.norm(motion))


def _point_step(pairs: _Pairs) -> tuple[Similarity, float]:
    """The best rigid motion of the weighted pairs (Besl & McKay 1992)."""
    kept = pairs.weights > 0
    delta = fit_similarity(pairs.moved[kept], pairs.feet[kept], with_scale=False, weights=pairs.weights[kept])
    size = np.sqrt(np.mean(np.square(delta.apply(pairs.moved[kept]) - pairs.moved[kept]).sum(axis=1)))
    return delta, float(size)


def _jacobian(
    pairs: _Pairs, normals: FloatArray | None = None, *, with_scale: bool
) -> tuple[FloatArray, FloatArray, float]:
    """Rows (M, 6 or 7): residual change by rotation, translation and log-scale, all as lengths at the RMS radius."""
    normals = pairs.normals if normals is None else normals
    total = pairs.weights.sum()
    center = (pairs.moved * pairs.weights[:, None]).sum(axis=0) / total
    arms = pairs.moved - center
    radius = float(np.sqrt((np.square(arms).sum(axis=1) * pairs.weights).sum() / total)) or 1.0
    columns = [np.cross(arms, normals) / radius, normals]
    if with_scale:
        columns.append(np.einsum("ni,ni->n", arms, normals)[:, None] / radius)
    return np.hstack(columns), center, radius


class _Quality(NamedTuple):
    rmse: float
    overlap: float
    eigenvalues: tuple[float, ...]
    weakest_sigma: float | None
    unfixed: FloatArray  # (6 or 7, U) orthonormal motions that the geometry does not fix
    warnings: list[str]


def _assess(
    target: Surface, sample: FloatArray, T: Similarity, *, plane: bool, with_scale: bool, spacing: float
) -> _Quality:
    """Residual, overlap and what the geometry fixes, at a transform that is taken as it is."""
    moved = T.apply(sample)
    nearest = target.index.query(moved)
    distances = nearest.distances
    # One distance for every method: were it to follow the fit, the worse the fit, the more would count as overlap.
    within = _ON_REFERENCE * spacing
    overlap = float(np.mean(distances <= within))
    pairs = _weigh(target, moved, nearest, within, robust=True) if len(target) >= 3 else None
    if pairs is None or np.count_nonzero(pairs.weights) < _FEWEST:
        rms = float(np.sqrt(np.mean(np.square(distances))))
        size = 7 if with_scale else 6
        return _Quality(rms, overlap, (), None, np.zeros((size, 0)), ["too few points to say what the geometry fixes"])
    pairs = pairs.take(pairs.weights > 0)
    errors = pairs.residuals if plane else pairs.distances
    rmse = float(np.sqrt((pairs.weights * errors**2).sum() / pairs.weights.sum()))
    # What the geometry fixes is asked of all pairs that the fit may have used, where density varies of far more.
    reach = np.clip(3 * _mad(distances[distances <= np.median(distances)]), 3 * spacing, 10 * spacing)
    pairs = _weigh(target, moved, nearest, reach, robust=True)
    pairs = pairs.take(pairs.weights > 0)
    typical = float(np.percentile(distances, 25))  # the quarter that fits best: partial overlap is no failure
    eigenvalues, weakest, unfixed, warnings = _information(target, pairs, with_scale=with_scale)
    if overlap < 0.3:
        warnings.append(f"only {overlap:.0%} of the candidate lies on the reference")
    if typical > 10 * spacing > 0:
        warnings.append(
            f"the candidate lies far off the reference (its nearest quarter by {typical:.3g}, {typical / spacing:.0f}"
            " times the reference's spacing): the registration may have failed"
        )
    return _Quality(rmse, overlap, eigenvalues, weakest, unfixed, warnings)


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
    spatial tiles says whether what remains differs from zero. Neighbouring residuals are not independent either:
    the number of pairs is reduced by the scatter of their tile means (effective sample size).
    """
    step = max(1, len(pairs.weights) // 10_000)
    pairs = pairs.take(slice(None, None, step))
    first, second = _split_normals(target.index, pairs.indices)
    a, _, _ = _jacobian(pairs, first, with_scale=with_scale)
    b, _, _ = _jacobian(pairs, second, with_scale=with_scale)
    size = float(np.ptp(pairs.moved, axis=0).max()) / 8
    _, tile = np.unique(cell_keys(pairs.moved, size or 1.0, pairs.moved.min(axis=0)), return_inverse=True)
    total = pairs.weights.sum()
    cross = np.einsum("ni,n,nj->ij", a, pairs.weights, b, optimize=False) / total
    values, vectors = np.linalg.eigh(0.5 * (cross + cross.T))

    # Scatter of each direction's information over tiles.
    share = np.einsum("ni,ik->nk", a, vectors) * np.einsum("ni,ik->nk", b, vectors) * pairs.weights[:, None]
    weight = np.bincount(tile, pairs.weights)
    by_tile = np.stack([np.bincount(tile, column) for column in share.T], axis=1)
    error = np.sqrt(np.square(by_tile - values * weight[:, None]).sum(axis=0)) / total
    fixed = (values > np.maximum(3 * error, 1e-9)) & (len(weight) > 1)

    sigma2 = (pairs.weights * pairs.residuals**2).sum() / total
    mean = (pairs.weights * pairs.residuals).sum() / total
    means = np.bincount(tile, pairs.weights * (pairs.residuals - mean)) / np.maximum(weight, 1e-300)
    expected = (sigma2 / np.maximum(weight, 1)).mean()
    inflation = max(1.0, float(np.mean(np.square(means)) / expected)) if expected > 0 else 1.0
    effective = total * step / inflation
    eigenvalues = tuple(float(v) for v in values)
    unfixed = vectors[:, ~fixed]
    if not fixed.all():
        motions = " and ".join(_describe_motion(vector) for vector in unfixed.T)
        return eigenvalues, None, unfixed, [f"the geometry does not fix {motions}: scores along it mean nothing"]
    weakest = float(np.sqrt(sigma2 / (effective * values[0])))
    warnings = []
    if weakest > 0.5 * np.sqrt(sigma2):
        motion = _describe_motion(vectors[:, 0])
        warnings.append(f"the geometry hardly fixes {motion} (predicted sigma {weakest:.3g})")
    return eigenvalues, weakest, unfixed, warnings


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


def _given(target: Surface, points: FloatArray, origin: FloatArray, method: str, T: Similarity) -> Registration:
    """A transform from elsewhere, assessed like one of ours."""
    local = T.about(-origin)
    spacing = _spacing(target.index)
    start = max(robust_extent(target.points) / 500, spacing)
    sample = points[thin_to(points, _SAMPLE, start=start)] if spacing > 0 else points[:_SAMPLE]
    moved = local.apply(sample)
    lower, upper = target.points.min(axis=0), target.points.max(axis=0)
    margin = 0.1 * float(np.linalg.norm(upper - lower))
    # Fewer than three points have no extent to overlap with.
    if len(target) >= 3 and ((moved.min(axis=0) > upper + margin).any() or (moved.max(axis=0) < lower - margin).any()):
        raise RegistrationError(
            f"the candidate does not overlap the reference after --register {method}: their bounding boxes lie apart"
            f" (reference centre {_format(origin)}, candidate centre {_format(moved.mean(axis=0) + origin)})"
        )
    quality = _assess(target, sample, local, plane=True, with_scale=local.scale != 1, spacing=spacing)
    return _registration(method, T, local, quality, 0, None)


def _fit_pairs(path: str) -> tuple[Similarity, tuple[CheckPoint, ...]]:
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


def _unit_warning(reference: FloatArray, candidate: FloatArray, scale: float) -> str | None:
    """A warning where the extents differ by a factor that looks like a unit."""
    ratio = scale * robust_extent(candidate) / (robust_extent(reference) or np.inf)
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


def _spacing(index: Index) -> float:
    """Median distance to the nearest other point, from an even sample."""
    if len(index) < 2:
        return 0.0
    which = np.arange(0, len(index), max(1, len(index) // 20_000))
    distances = index.query(index.points[which], k=2).distances[:, 1]
    positive = distances[distances > 0]  # duplicates say nothing about spacing
    return float(np.median(positive)) if len(positive) else 0.0


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
