"""Which motions the geometry observes, and how well: the information matrix, its weak directions, their uncertainty.

A plane can slide in itself and a pipe can turn about its axis without any residual noticing. ICP then returns a pose
that the noise has chosen. Such directions are found as Gelfand, Ikemoto, Rusinkiewicz & Levoy 2003 do ("Geometrically
stable sampling for the ICP algorithm"): by the eigenvectors of the 6x6 information matrix of point-to-plane pairs whose
coordinates are centred and divided by their radius. Zhang, Kaess & Singh 2016 ("On degeneracy of optimization-based
state estimation problems", ICRA) then leave the update along eigenvectors with small eigenvalues out (solution
remapping). `icp` does this in the form of an equality constraint, as Tuna et al. 2024 do ("X-ICP: Localizability-aware
LiDAR registration for robust localization in extreme environments", IEEE T-RO 40): the normal equations are solved in
the complement of the constrained directions, which stay the same through all iterations.

In two points this differs from those papers. No threshold on an eigenvalue has to be tuned: a direction counts as
observable where its information exceeds three times its own scatter over the scene. And normals are estimated twice
from disjoint neighbours, because the noise of one estimate looks like information about sliding.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pcbench.errors import Notice
from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.neighbors import Index
from pcbench.geometry.normals import Surface, plane_normals
from pcbench.geometry.voxels import cells
from pcbench.registration.result import SCALE_MISSING, UNOBSERVABLE, WEAKLY_OBSERVABLE
from pcbench.registration.weighted_pairs import WeightedPairs

_NORMAL_NEIGHBORS = 20
_MAX_INFORMING_PAIRS = 10_000  # that are asked what the geometry fixes
_TILES_ALONG = 8  # the scene: of the bootstrap
# Of what is observed: a scan has most of its points in few tiles of an eighth, too few to tell their scatter. Errors
# of normals are alike over less than a fine tile.
_FINE_TILES_ALONG = 24
_REPLICATES = 400
_MIN_WEAK = 0.3  # of the spacing and of the residuals: a motion that is known less well than that is hardly fixed
_MIN_SCALE_SIGNIFICANCE = 5  # standard deviations before a scale is said to be missing


class Observability(NamedTuple):
    """What pairs say about motions: rotation (3), translation (3) and, where there are seven, the log-scale.

    All are measured as lengths at the pairs' RMS radius about their weighted centre.
    """

    eigenvalues: tuple[float, ...]  # of the information matrix per pair, ascending
    weakest_sigma: float | None  # predicted standard deviation along the weakest direction; None: unobservable
    unobservable: FloatArray  # (6 or 7, U) orthonormal directions that the geometry does not fix
    warnings: tuple[Notice, ...]


def observability(target: Surface, pairs: WeightedPairs, *, with_scale: bool) -> Observability:
    """Which motions of the candidate the pairs determine, and how well the weakest of them.

    Estimated normals are noisy, and noise looks like information about sliding. So each pair's normal is estimated
    twice, from two disjoint halves of the neighbours: the product of the two is free of that bias. Its scatter over
    spatial tiles says whether what remains differs from zero.

    Args:
        target: the reference that the pairs' indices belong to.
        pairs: with weights above zero.
        with_scale: whether the scale is one of the motions.
    """
    size = 7 if with_scale else 6
    step = max(1, len(pairs.weights) // _MAX_INFORMING_PAIRS)
    side = float(np.ptp(pairs.moved, axis=0).max()) / _TILES_ALONG
    tile = cells(pairs.moved, side or 1.0).of_point
    tiles = int(tile.max()) + 1
    some, of_some = pairs.take(slice(None, None, step)), tile[::step]
    frame = _MotionFrame.of(pairs)
    a, b = (frame.jacobian(some.moved, normals) for normals in _split_normals(target.index, some.indices))
    weight = np.bincount(of_some, some.weights, tiles)
    total = weight.sum()
    residual = float(np.sqrt((pairs.weights * pairs.residuals**2).sum() / pairs.weights.sum()))
    with_growth = _sums_by_tile(of_some, a, b * some.weights[:, None], tiles)
    by_tile = with_growth[:, :size, :size]
    values, vectors = np.linalg.eigh(by_tile.sum(axis=0) / total)

    # Scatter of each direction's information over fine tiles.
    fine = cells(some.moved, side * _TILES_ALONG / _FINE_TILES_ALONG or 1.0).of_point
    fine_weight = np.bincount(fine, some.weights)
    informs = _sums_by_tile(fine, a[:, :size], b[:, :size] * some.weights[:, None], len(fine_weight))
    shares = np.einsum("ik,tij,jk->tk", vectors, informs, vectors, optimize=False)
    error = np.sqrt(np.square(shares - values * fine_weight[:, None]).sum(axis=0)) / total
    observable = (values > np.maximum(3 * error, 1e-9)) & (np.count_nonzero(fine_weight) > 1)
    eigenvalues, unobservable = tuple(float(v) for v in values), vectors[:, ~observable]
    if not observable.all():
        motions = " and ".join(_describe_motion(vector) for vector in unobservable.T)
        notice = Notice(UNOBSERVABLE, f"the geometry does not fix {motions}: scores along it mean nothing")
        return Observability(eigenvalues, None, unobservable, (notice,))

    curvature = _sums_by_tile(of_some, a, b * _tukey_slope(some)[:, None], tiles) * step
    normals = target.normals(pairs.indices)
    pull = frame.jacobian(pairs.moved, normals) * (pairs.weights * pairs.residuals)[:, None]
    gradient = np.stack([np.bincount(tile, column, tiles).astype(np.float64) for column in pull.T], axis=1)
    _, covariance = _bootstrap(curvature[:, :size, :size], gradient[:, :size])
    variances, directions = np.linalg.eigh(covariance)
    weakest, direction = float(np.sqrt(variances[-1])), directions[:, -1]
    warnings = []
    if not with_scale:
        # Steps of Gauss and Newton: where a scale is missing, residuals are large, and the robust cost nearly flat.
        wanted, covariance = _bootstrap(step * with_growth, gradient)
        sure = _MIN_SCALE_SIGNIFICANCE * np.sqrt(covariance[6, 6])
        if abs(wanted[6]) > max(sure, 0.5 * residual, 1e-9 * frame.radius):
            factor = np.exp(wanted[6] / frame.radius)
            text = f"the pairs ask for a scale of about {factor:.5g}: --register similarity finds it"
            warnings.append(Notice(SCALE_MISSING, text))
    if weakest > max(_MIN_WEAK * target.spacing, _MIN_WEAK * residual):
        text = f"the geometry hardly fixes {_describe_motion(direction)} (predicted sigma {weakest:.3g})"
        warnings.append(Notice(WEAKLY_OBSERVABLE, text))
    return Observability(eigenvalues, weakest, unobservable, tuple(warnings))


class _MotionFrame(NamedTuple):
    """What motions are measured about and by: the pairs' weighted centre (3,) and their RMS radius."""

    center: FloatArray
    radius: float

    @classmethod
    def of(cls, pairs: WeightedPairs) -> _MotionFrame:
        total = pairs.weights.sum()
        center = (pairs.moved * pairs.weights[:, None]).sum(axis=0) / total
        squares = np.square(pairs.moved - center).sum(axis=1)
        return cls(center, float(np.sqrt((squares * pairs.weights).sum() / total)) or 1.0)

    def jacobian(self, points: FloatArray, normals: FloatArray) -> FloatArray:
        """Rows (M, 7): residual change by rotation, translation and log-scale, as lengths at the radius."""
        arms = points - self.center
        growth = np.einsum("ni,ni->n", arms, normals)[:, None]
        return np.hstack([np.cross(arms, normals) / self.radius, normals, growth / self.radius])


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


def _tukey_slope(pairs: WeightedPairs) -> FloatArray:
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
    """The largest part of a motion in words, with its axis."""
    parts = {"a rotation": vector[:3], "a translation": vector[3:6], "the scale": vector[6:]}
    name = max(parts, key=lambda part: float(np.linalg.norm(parts[part])))
    if name == "the scale":
        return name
    axis = parts[name] / np.linalg.norm(parts[name])
    where = "about" if name == "a rotation" else "along"
    return f"{name} {where} ({', '.join(f'{v:+.2f}' for v in axis * np.sign(axis[np.abs(axis).argmax()]))})"
