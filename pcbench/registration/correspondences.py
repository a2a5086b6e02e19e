"""Points of two clouds in any pose that look alike, by KISS-Matcher's features (Lim et al. 2025), and poses from them.

Most such pairs are wrong. Poses that many pairs agree on are found by RANSAC (Fischler & Bolles 1981) over triples.
Several are kept: which of them is right, and whether one is, the pairs alone do not tell.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.children import Limits, run_script
from pcbench.errors import InputError, RegistrationError
from pcbench.extras import require
from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.transform import Similarity, fit_similarity
from pcbench.registration import kiss_child
from pcbench.scratch import scratch_folder

RUNG = 1.2  # features stand a tenth more or less of scale, so poses are looked for within this factor

_TRIPLES = 1_000_000  # drawn; with 2 % of the pairs right, eight of them are
_TOLERANCE = 2.0  # cells; means over differently placed cells of one surface stand that far apart at most
_MIN_SIDE = 5.0  # cells; smaller triangles say little about the rotation
_EVALUATIONS = 20_000_000  # poses times pairs: a second's work
_MAX_POSES = 20_000  # few points make many triples, but no more different ones
_AT_A_TIME = 65_536  # of those: what fits into a processor's cache
_PROBES = 12


class FeaturePairs(NamedTuple):
    """Points (N, 3) of the candidate and of the reference, in cells."""

    candidate: FloatArray
    reference: FloatArray


def matched(clouds: list[FeaturePairs]) -> list[FeaturePairs]:
    """Pairs of points that look alike, for each two clouds of cell means in units of the cells' side.

    Raises:
        MissingExtra: KISS-Matcher is not installed.
        RegistrationError: it failed.
    """
    with scratch_folder() as folder:
        source, target = folder / "clouds.npz", folder / "pairs.npz"
        arrays = {f"{name}{k}": part for k, two in enumerate(clouds) for name, part in two._asdict().items()}
        np.savez(source, **arrays)
        # One thread gives the same matches every time: TBB and OpenMP both count the CPUs they may use.
        done = run_script(kiss_child.__file__, str(source), str(target), limits=Limits(one_cpu=True))
        if done.code:
            require("kiss_matcher")
            raise RegistrationError(f"KISS-Matcher failed: {done.last_words or f'exit code {done.code}'}")
        with np.load(target) as found:
            both = [
                [found[f"{name}{k}"].astype(np.float64) for name in FeaturePairs._fields] for k in range(len(clouds))
            ]
    return [FeaturePairs(*two) for two in both]


def likely_poses(pairs: FeaturePairs, count: int, *, with_scale: bool) -> list[Similarity]:
    """At most `count` clearly different poses candidate -> reference, in cells, those that most pairs agree on first.

    With scale, of one within `RUNG` of 1.
    """
    p, q = pairs
    if len(p) < 3:
        return []
    draws = min(_TRIPLES, len(p) ** 3)  # of few points there are no more
    triples = _alike(pairs, np.random.default_rng(0).integers(0, len(p), (draws, 3)), RUNG if with_scale else 1.0)
    sides_p, sides_q = _sides(p, triples), _sides(q, triples)
    scales = sides_q.sum(axis=1) / sides_p.sum(axis=1) if with_scale else np.ones(len(triples))
    alike = (np.abs(sides_q - scales[:, None] * sides_p) < _TOLERANCE).all(axis=1)
    alike &= np.abs(np.log(scales)) < np.log(RUNG)
    # Nearly straight triangles leave the turn about them open.
    alike &= (sides_p.sum(axis=1) - 2 * sides_p.max(axis=1)) > 0.02 * sides_p.sum(axis=1)
    kept = np.flatnonzero(alike)[: min(_EVALUATIONS // len(p), _MAX_POSES)]
    triples, scales = triples[kept], scales[kept]
    rotations = np.einsum("nij,nkj->nik", _frames(q[triples]), _frames(p[triples]))
    linear = scales[:, None, None] * rotations
    shifts = q[triples].mean(axis=1) - np.einsum("nij,nj->ni", linear, p[triples].mean(axis=1))
    support = _support(pairs, linear, shifts)

    probes = p[:: -(-len(p) // _PROBES)]
    moved = np.einsum("nij,mj->nmi", linear, probes) + shifts[:, None]
    poses: list[Similarity] = []
    left = support >= 4  # three agree with any pose through them
    for _ in range(20 * count):
        if not left.any() or len(poses) == count:
            break
        best = int(np.argmax(np.where(left, support, 0)))
        left &= np.square(moved - moved[best]).sum(axis=2).mean(axis=1) > (2 * _TOLERANCE) ** 2
        pose = _refined(pairs, Similarity(rotations[best], shifts[best], float(scales[best])), with_scale=with_scale)
        if all(apart(pose, other, probes) > 2 * _TOLERANCE for other in poses):
            poses.append(pose)
    return poses


def apart(a: Similarity, b: Similarity, points: FloatArray) -> float:
    """Root mean square distance between where two poses put points (N, 3)."""
    return float(np.sqrt(np.square(a.apply(points) - b.apply(points)).sum(axis=1).mean()))


def _alike(pairs: FeaturePairs, triples: IntArray, factor: float) -> IntArray:
    """The triples whose sides are long and about as long in both clouds, whatever the scale within `factor` of 1.

    Side by side: most triples fall with their first, and their other sides are never looked at.
    """
    p, q = pairs
    for i, j in ((0, 1), (1, 2), (2, 0)):
        along_p, along_q = p[triples[:, j]] - p[triples[:, i]], q[triples[:, j]] - q[triples[:, i]]
        side_p, side_q = (np.sqrt(np.einsum("ni,ni->n", along, along)) for along in (along_p, along_q))
        kept = np.minimum(side_p, side_q) > _MIN_SIDE
        kept &= (side_q < factor * side_p + _TOLERANCE) & (side_q > side_p / factor - _TOLERANCE)
        triples = triples[kept]
    return triples


def _sides(points: FloatArray, triples: IntArray) -> FloatArray:
    """Lengths (T, 3) of the triangles' sides."""
    a, b, c = points[triples.T]
    return np.stack([np.linalg.norm(side, axis=1) for side in (b - a, c - b, a - c)], axis=1)


def _frames(corners: FloatArray) -> FloatArray:
    """Rotations (T, 3, 3) whose columns are a triangle's first side, the normal to it in the plane, the plane's normal.

    `corners` (T, 3, 3) has a row a corner.
    """
    a, b, c = corners.transpose(1, 0, 2)
    along = b - a
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    across = np.cross(along, c - a)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    return np.stack([along, np.cross(across, along), across], axis=2)


def _support(pairs: FeaturePairs, linear: FloatArray, shifts: FloatArray) -> IntArray:
    """How many pairs agree with each pose (T,)."""
    p, q = (np.ascontiguousarray(side.T, np.float32) for side in pairs)  # (3, N): cells need no more digits
    rows, offsets = linear.astype(np.float32), shifts.astype(np.float32)
    support = np.empty(len(rows), np.int64)
    step = max(1, _AT_A_TIME // p.shape[1])
    for k in range(0, len(rows), step):
        some = slice(k, k + step)
        squares: NDArray[np.float32] = np.zeros((len(rows[some]), p.shape[1]), np.float32)
        for axis in range(3):  # no BLAS: the same bits from any number of threads
            apart = offsets[some, axis, None] - q[axis]
            for column in range(3):
                apart += rows[some, axis, column, None] * p[column]
            squares += np.square(apart, out=apart)
        support[some] = np.count_nonzero(squares < _TOLERANCE**2, axis=1)
    return support


def _refined(pairs: FeaturePairs, pose: Similarity, *, with_scale: bool) -> Similarity:
    """The pose fitted to the pairs that agree with it, three times over."""
    for _ in range(3):
        near = np.square(pose.apply(pairs.candidate) - pairs.reference).sum(axis=1) < _TOLERANCE**2
        try:
            pose = fit_similarity(pairs.candidate[near], pairs.reference[near], with_scale=with_scale)
        except InputError:  # too few are left, or all lie on one line
            break
    return pose
