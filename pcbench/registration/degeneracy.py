"""Observability: which motions the geometry determines, from the information matrix of the pairs, and how well.

A plane can slide in itself and a pipe can turn about its axis without changing any residual. ICP then returns a pose
that the noise determines. Such directions are found as by Gelfand, Ikemoto, Rusinkiewicz & Levoy 2003 ("Geometrically
stable sampling for the ICP algorithm"): from the eigenvectors of the 6x6 information matrix of point-to-plane pairs
whose coordinates are centred and divided by their radius. Zhang, Kaess & Singh 2016 ("On degeneracy of
optimization-based state estimation problems", ICRA) then drop the update along eigenvectors with small eigenvalues
(solution remapping). `icp` does this as an equality constraint, like Tuna et al. 2024 ("X-ICP: Localizability-aware
LiDAR registration for robust localization in extreme environments", IEEE T-RO 40): the normal equations are solved in
the complement of the constrained directions, which stay the same through all iterations.

Two points differ from those papers. No eigenvalue threshold needs tuning: a direction is observable if its information
exceeds three times its standard error, estimated from its scatter over the scene. And normals are estimated twice from
disjoint neighbours, because the noise of a single estimate looks like information about sliding.

The scale needs a second criterion. On a nearly planar scene, such as a facade with recesses, only the few pairs at
edges inform about it. Closest points at edges are biased: this bias cancels for a translation, but adds up for the
scale, and shrinks the candidate by several per cent. So a scale that so few pairs determine keeps its initial value.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pcbench.errors import Notice
from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.neighbors import Index
from pcbench.geometry.normals import Surface, plane_normals
from pcbench.geometry.voxels import cells
from pcbench.registration.motion import MotionFrame, PoseCovariance
from pcbench.registration.result import SCALE_MISSING, UNOBSERVABLE, WEAKLY_OBSERVABLE
from pcbench.registration.weighted_pairs import WeightedPairs

_NORMAL_NEIGHBORS = 20
_MAX_INFORMING_PAIRS = 10_000  # pairs used for the information matrix
_TILES_PER_SIDE = 8  # tiles of the bootstrap along the scene's longest side
# Fine tiles for the scatter of the information. Most points of a scan lie in a few of the bootstrap's tiles, too few to
# estimate the scatter. Errors of normals are correlated over less than a fine tile.
_FINE_TILES_PER_SIDE = 24
_REPLICATES = 400
_MAX_STEP_RATIO = 4.5  # of a replicate's motion to the median one: three standard deviations along one direction
# A motion is weakly observable if its sigma exceeds the spacing and the residuals: it then changes distances between
# points. From the smaller share on, other poses may fit as well, so that the pose is tested by restarts.
_MIN_WEAK_SIGMA_SHARE, _MIN_TESTED_SIGMA_SHARE = 1.0, 0.3
# Information about the scale per pair that the other motions leave: measured 0.002 to 0.007 for flat facades with
# recesses, whose scale is biased, and 0.019 to 0.9 for buildings, streets, rooms, hills and objects.
_MIN_SCALE_INFORMATION = 0.01
_MIN_RIGID_PART = 0.3  # of an unobservable motion; a smaller part beside the scale is an error of the eigenvectors
_MIN_SCALE_SIGNIFICANCE = 5  # standard deviations before a missing scale is reported


class Observability(NamedTuple):
    """Observability of the motions: rotation (3), translation (3) and, with scale, the log-scale.

    All motions are lengths at the pairs' RMS radius about their weighted centre.
    """

    eigenvalues: tuple[float, ...]  # of the information matrix per pair, ascending
    weakest_sigma: float | None  # predicted standard deviation along the weakest direction; None: unobservable
    unobservable: FloatArray  # (6 or 7, U) orthonormal directions that the geometry does not fix
    covariance: PoseCovariance  # of the observable motions
    is_weak: bool  # whether some motion is known so badly that other poses may fit as well
    warnings: tuple[Notice, ...]


def observability(target: Surface, pairs: WeightedPairs, *, with_scale: bool) -> Observability:
    """Determine which motions of the candidate the pairs fix, and how well they fix the weakest.

    Estimated normals are noisy, and noise looks like information about sliding. So each normal is estimated twice, from
    two disjoint halves of its neighbours: the product of the two is free of that bias. The scatter of the product over
    spatial tiles shows whether the remaining information differs from zero.

    Args:
        target: reference surface that the pairs' indices refer to.
        pairs: pairs with positive weights.
        with_scale: whether the scale is one of the motions.
    """
    size = 7 if with_scale else 6
    step = max(1, len(pairs.weights) // _MAX_INFORMING_PAIRS)
    side = float(np.ptp(pairs.moved, axis=0).max()) / _TILES_PER_SIDE
    tile = cells(pairs.moved, side or 1.0).of_point
    tiles = int(tile.max()) + 1
    sample, sample_tile = pairs.take(slice(None, None, step)), tile[::step]
    frame = MotionFrame.of(pairs.moved, pairs.weights)
    a, b = (frame.jacobian(sample.moved, normals) for normals in _split_normals(target.index, sample.indices))
    weight = np.bincount(sample_tile, sample.weights, tiles)
    total = weight.sum()
    residual = float(np.sqrt((pairs.weights * pairs.residuals**2).sum() / pairs.weights.sum()))
    information = _sums_by_tile(sample_tile, a, b * sample.weights[:, None], tiles)
    by_tile = information[:, :size, :size]
    values, vectors = np.linalg.eigh(by_tile.sum(axis=0) / total)

    # Standard error of each direction's information from its scatter over fine tiles.
    fine = cells(sample.moved, side * _TILES_PER_SIDE / _FINE_TILES_PER_SIDE or 1.0).of_point
    fine_weight = np.bincount(fine, sample.weights)
    informs = _sums_by_tile(fine, a[:, :size], b[:, :size] * sample.weights[:, None], len(fine_weight))
    shares = np.einsum("ik,tij,jk->tk", vectors, informs, vectors, optimize=False)
    error = np.sqrt(np.square(shares - values * fine_weight[:, None]).sum(axis=0)) / total
    observable = (values > np.maximum(3 * error, 1e-9)) & (np.count_nonzero(fine_weight) > 1)
    eigenvalues, unobservable = tuple(float(v) for v in values), vectors[:, ~observable]
    open_rigid = unobservable if with_scale else np.vstack([unobservable, np.zeros((1, unobservable.shape[1]))])
    fixes_scale = _scale_information(information.sum(axis=0) / total, open_rigid) > _MIN_SCALE_INFORMATION
    if with_scale and not fixes_scale:
        unobservable = _with_scale_motion(unobservable)
    curvature = _sums_by_tile(sample_tile, a, b * _tukey_slope(sample)[:, None], tiles) * step
    normals = target.normals(pairs.indices)
    weighted_rows = frame.jacobian(pairs.moved, normals) * (pairs.weights * pairs.residuals)[:, None]
    gradient = np.stack([np.bincount(tile, column, tiles).astype(np.float64) for column in weighted_rows.T], axis=1)
    matrix = _observable_covariance(curvature[:, :size, :size], gradient[:, :size], unobservable)
    covariance = PoseCovariance(frame, matrix, unobservable)
    if not observable.all():
        motions = " and ".join(_describe_motion(vector) for vector in unobservable.T)
        notice = Notice(UNOBSERVABLE, f"the geometry does not fix {motions}: scores along it are meaningless")
        return Observability(eigenvalues, None, unobservable, covariance, False, (notice,))
    if with_scale and not fixes_scale:
        text = "the geometry weakly constrains the scale: only few pairs inform about it, and they are biased"
        return Observability(eigenvalues, None, unobservable, covariance, True, (Notice(WEAKLY_OBSERVABLE, text),))

    weakest, direction = covariance.weakest
    warnings = []
    if not with_scale and fixes_scale:
        # Gauss-Newton steps: if a scale is missing, residuals are large and the robust cost is nearly flat.
        remaining_motion, of_motion = _bootstrap(step * information, gradient)
        min_motion = _MIN_SCALE_SIGNIFICANCE * np.sqrt(of_motion[6, 6])
        if abs(remaining_motion[6]) > max(min_motion, 0.5 * residual, 1e-9 * frame.radius):
            factor = np.exp(remaining_motion[6] / frame.radius)
            text = f"the pairs indicate a scale of about {factor:.5g}: use --register similarity to solve for it"
            warnings.append(Notice(SCALE_MISSING, text))
    ratio = weakest / (max(target.spacing, residual) or np.inf)
    if ratio > _MIN_WEAK_SIGMA_SHARE:
        text = f"the geometry weakly constrains {_describe_motion(direction)} (predicted sigma {weakest:.3g})"
        warnings.append(Notice(WEAKLY_OBSERVABLE, text))
    is_weak = ratio > _MIN_TESTED_SIGMA_SHARE
    return Observability(eigenvalues, weakest, unobservable, covariance, is_weak, tuple(warnings))


def _scale_information(information: FloatArray, unobservable: FloatArray) -> float:
    """Return the information (7, 7) about the scale that the other observable motions do not explain.

    Args:
        information: information matrix per pair.
        unobservable: (7, U) orthonormal motions that the pairs do not fix, and that are kept.
    """
    free = _complement(unobservable)
    scale = free[6]
    variance = float(scale @ np.linalg.pinv(free.T @ information @ free, hermitian=True) @ scale)
    return 1 / variance if variance > 0 else 0.0


def _with_scale_motion(unobservable: FloatArray) -> FloatArray:
    """Return an orthonormal basis (7, V) of the unobservable motions and the scale, which comes last."""
    rigid = unobservable.copy()
    rigid[6] = 0
    basis, sizes, _ = np.linalg.svd(rigid, full_matrices=False)
    return np.hstack([basis[:, sizes > _MIN_RIGID_PART], np.eye(7)[:, 6:]])


def _complement(basis: FloatArray) -> FloatArray:
    """Return an orthonormal basis (K, K - U) of the motions orthogonal to those of a basis (K, U)."""
    return np.linalg.svd(basis, full_matrices=True)[0][:, basis.shape[1] :]


def _observable_covariance(curvature: FloatArray, gradient: FloatArray, unobservable: FloatArray) -> FloatArray:
    """Return the bootstrap covariance (K, K) of the motions that the geometry fixes, zero along the others."""
    size = len(unobservable)
    free = _complement(unobservable)
    if not free.shape[1]:
        return np.zeros((size, size))
    of_tiles = np.einsum("ki,tkl,lj->tij", free, curvature, free, optimize=False)
    covariance: FloatArray = free @ _bootstrap(of_tiles, gradient @ free)[1] @ free.T
    return covariance


def _bootstrap(curvature: FloatArray, gradient: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the median remaining motion (K,) of the pairs, and its covariance (K, K).

    Spatial tiles are resampled (Bayesian bootstrap, Rubin 1981) instead of pairs: neighbouring residuals are
    correlated, and a closed form that assumes independence underestimates sigma several times. Each replicate is one
    Newton step from per-tile curvatures (T, K, K) and gradients (T, K) of the robust cost.
    """
    weights = np.random.default_rng(0).exponential(size=(_REPLICATES, len(gradient)))
    hessians = np.einsum("rt,tij->rij", weights, curvature, optimize=False)
    steps = -np.linalg.solve(hessians, np.einsum("rt,ti->ri", weights, gradient, optimize=False)[:, :, None])[:, :, 0]
    motion: FloatArray = np.median(steps, axis=0)
    steps -= motion
    # A replicate without the only tile that fixes a motion says nothing about its error: its step is shortened.
    sizes = np.linalg.norm(steps, axis=1)
    longest = _MAX_STEP_RATIO * float(np.median(sizes))
    steps *= (longest / np.maximum(sizes, longest or 1.0))[:, None]
    return motion, np.einsum("ri,rj->ij", steps, steps, optimize=False) / len(steps)


def _sums_by_tile(tile: IntArray, a: FloatArray, b: FloatArray, tiles: int) -> FloatArray:
    """Return the symmetrised sums (T, K, K) per tile of the outer products of the rows of a and b (M, K)."""
    size = a.shape[1]
    sums = np.empty((tiles, size, size))
    for i in range(size):
        for j in range(i + 1):
            product = 0.5 * (a[:, i] * b[:, j] + a[:, j] * b[:, i])
            sums[:, i, j] = sums[:, j, i] = np.bincount(tile, product, tiles)
    return sums


def _tukey_slope(pairs: WeightedPairs) -> FloatArray:
    """Return the derivative (M,) of w(r) r with respect to r, with Tukey's w = (1 - u)^2 and u = (r / width)^2."""
    root = np.sqrt(pairs.weights)
    slope: FloatArray = root * (5 * root - 4)  # (1 - u)(1 - 5 u)
    return slope


def _split_normals(index: Index, which: IntArray) -> tuple[FloatArray, FloatArray]:
    """Return two estimates of each normal from disjoint halves of the neighbours, with the same sign."""
    unique, inverse = np.unique(which, return_inverse=True)
    neighbors = index.query(index.points[unique], min(2 * _NORMAL_NEIGHBORS, len(index))).indices
    first = plane_normals(index.points, neighbors[:, 0::2]).directions
    second = plane_normals(index.points, neighbors[:, 1::2]).directions
    flip = np.einsum("ni,ni->n", first, second) < 0
    return first[inverse], np.where(flip[:, None], -second, second)[inverse]


def _describe_motion(vector: FloatArray) -> str:
    """Describe the largest component of a motion, with its axis."""
    parts = {"a rotation": vector[:3], "a translation": vector[3:6], "the scale": vector[6:]}
    name = max(parts, key=lambda part: float(np.linalg.norm(parts[part])))
    if name == "the scale":
        return name
    axis = parts[name] / np.linalg.norm(parts[name])
    where = "about" if name == "a rotation" else "along"
    return f"{name} {where} ({', '.join(f'{v:+.2f}' for v in axis * np.sign(axis[np.abs(axis).argmax()]))})"
