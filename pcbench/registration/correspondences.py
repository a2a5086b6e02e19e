"""Correspondences between clouds in any pose by KISS-Matcher's features (Lim et al. 2025), and poses from them.

Most of these correspondences are wrong. RANSAC (Fischler & Bolles 1981) over triples finds the poses that many of them
agree on. Several poses are returned: the correspondences alone do not show which of them is right, if any.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.children import Limits, run_script
from pcbench.errors import InputError, RegistrationError
from pcbench.extras import require
from pcbench.geometry.arrays import FloatArray, IntArray, bounds
from pcbench.geometry.transform import Similarity, fit_similarity
from pcbench.registration import kiss_child
from pcbench.scratch import scratch_folder

SCALE_STEP = 1.2  # features tolerate a scale error of about 10 %, so poses are searched within this factor

_MAX_TRIPLES = 1_000_000  # sampled; if 2 % of the pairs are right, about eight triples are
_TOLERANCE_CELLS = 2.0  # largest distance between means over differently placed cells of one surface
_MIN_SIDE_CELLS = 5.0  # smaller triangles determine the rotation poorly
_MAX_EVALUATIONS = 20_000_000  # poses times pairs: about one second
_MAX_POSES = 20_000  # few points form many triples, but not more different poses
_BLOCK_SIZE = 65_536  # poses times pairs evaluated at a time: fits into the processor's cache
_PROBE_COUNT = 12  # points at which poses are compared


class FeaturePairs(NamedTuple):
    """Corresponding points (N, 3) of the candidate and the reference, in cells."""

    candidate: FloatArray
    reference: FloatArray


def match_features(clouds: list[FeaturePairs]) -> list[FeaturePairs]:
    """Return the feature correspondences for each two clouds of cell means, in units of the cell side.

    KISS-Matcher turns normals towards the origin, so that features depend on it. Each cloud is therefore centred at its
    box: neither its unit nor its position changes the features.

    Args:
        clouds: candidate and reference points of each comparison, in cells.

    Raises:
        MissingExtra: KISS-Matcher is not installed.
        RegistrationError: KISS-Matcher failed.
    """
    arrays = {f"{name}{k}": part for k, two in enumerate(clouds) for name, part in two._asdict().items()}
    centers = {name: np.mean(bounds(part), axis=0) for name, part in arrays.items()}
    with scratch_folder() as folder:
        source, target = folder / "clouds.npz", folder / "pairs.npz"
        np.savez(source, **{name: part - centers[name] for name, part in arrays.items()})
        # One thread makes the matches reproducible; TBB and OpenMP both respect the CPU affinity.
        done = run_script(kiss_child.__file__, str(source), str(target), limits=Limits(one_cpu=True))
        if done.code:
            require("kiss_matcher")
            raise RegistrationError(f"KISS-Matcher failed: {done.last_error_line or f'exit code {done.code}'}")
        with np.load(target) as archive:
            pairs = {name: archive[name].astype(np.float64) + center for name, center in centers.items()}
    return [FeaturePairs(pairs[f"candidate{k}"], pairs[f"reference{k}"]) for k in range(len(clouds))]


def likely_poses(pairs: FeaturePairs, count: int, *, with_scale: bool) -> list[Similarity]:
    """Return at most `count` clearly different poses candidate -> reference, in cells, best supported first.

    Args:
        pairs: correspondences in cells.
        count: maximum number of poses.
        with_scale: whether to solve for the scale, within a factor `SCALE_STEP` of 1.
    """
    p, q = pairs
    if len(p) < 3:
        return []
    draws = min(_MAX_TRIPLES, len(p) ** 3)  # few points have fewer triples
    corners = np.random.default_rng(0).integers(0, len(p), (draws, 3))
    triples = _similar_triples(pairs, corners, SCALE_STEP if with_scale else 1.0)
    sides_p, sides_q = _side_lengths(p, triples), _side_lengths(q, triples)
    scales = sides_q.sum(axis=1) / sides_p.sum(axis=1) if with_scale else np.ones(len(triples))
    is_similar = (np.abs(sides_q - scales[:, None] * sides_p) < _TOLERANCE_CELLS).all(axis=1)
    is_similar &= np.abs(np.log(scales)) < np.log(SCALE_STEP)
    # Nearly straight triangles do not determine the rotation about their line.
    is_similar &= (sides_p.sum(axis=1) - 2 * sides_p.max(axis=1)) > 0.02 * sides_p.sum(axis=1)
    kept = np.flatnonzero(is_similar)[: min(_MAX_EVALUATIONS // len(p), _MAX_POSES)]
    triples, scales = triples[kept], scales[kept]
    rotations = np.einsum("nij,nkj->nik", _triangle_frames(q[triples]), _triangle_frames(p[triples]))
    linear = scales[:, None, None] * rotations
    shifts = q[triples].mean(axis=1) - np.einsum("nij,nj->ni", linear, p[triples].mean(axis=1))
    support = _support(pairs, linear, shifts)

    probes = p[:: -(-len(p) // _PROBE_COUNT)]
    moved = np.einsum("nij,mj->nmi", linear, probes) + shifts[:, None]
    poses: list[Similarity] = []
    is_candidate = support >= 4  # three agree with any pose through them
    for _ in range(20 * count):
        if not is_candidate.any() or len(poses) == count:
            break
        best = int(np.argmax(np.where(is_candidate, support, 0)))
        is_candidate &= np.square(moved - moved[best]).sum(axis=2).mean(axis=1) > (2 * _TOLERANCE_CELLS) ** 2
        pose = _refit(pairs, Similarity(rotations[best], shifts[best], float(scales[best])), with_scale=with_scale)
        if all(pose_distance(pose, other, probes) > 2 * _TOLERANCE_CELLS for other in poses):
            poses.append(pose)
    return poses


def pose_distance(a: Similarity, b: Similarity, points: FloatArray) -> float:
    """Return the RMS distance between points (N, 3) moved by two poses."""
    return float(np.sqrt(np.square(a.apply(points) - b.apply(points)).sum(axis=1).mean()))


def _similar_triples(pairs: FeaturePairs, triples: IntArray, factor: float) -> IntArray:
    """Return the triples whose sides are long, and equally long in both clouds up to a scale within `factor` of 1.

    The sides are tested one after the other: most triples fail at the first.
    """
    p, q = pairs
    for i, j in ((0, 1), (1, 2), (2, 0)):
        along_p, along_q = p[triples[:, j]] - p[triples[:, i]], q[triples[:, j]] - q[triples[:, i]]
        side_p, side_q = (np.sqrt(np.einsum("ni,ni->n", along, along)) for along in (along_p, along_q))
        kept = np.minimum(side_p, side_q) > _MIN_SIDE_CELLS
        kept &= (side_q < factor * side_p + _TOLERANCE_CELLS) & (side_q > side_p / factor - _TOLERANCE_CELLS)
        triples = triples[kept]
    return triples


def _side_lengths(points: FloatArray, triples: IntArray) -> FloatArray:
    """Return the lengths (T, 3) of the triangles' sides."""
    a, b, c = points[triples.T]
    return np.stack([np.linalg.norm(side, axis=1) for side in (b - a, c - b, a - c)], axis=1)


def _triangle_frames(corners: FloatArray) -> FloatArray:
    """Return a rotation (T, 3, 3) per triangle, with columns first side, in-plane normal of that side, plane normal.

    Each row of `corners` (T, 3, 3) is one corner.
    """
    a, b, c = corners.transpose(1, 0, 2)
    along = b - a
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    across = np.cross(along, c - a)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    return np.stack([along, np.cross(across, along), across], axis=2)


def _support(pairs: FeaturePairs, linear: FloatArray, shifts: FloatArray) -> IntArray:
    """Return the number of pairs that agree with each pose (T,)."""
    p, q = (np.ascontiguousarray(side.T, np.float32) for side in pairs)  # (3, N): single precision is enough for cells
    rows, offsets = linear.astype(np.float32), shifts.astype(np.float32)
    support = np.empty(len(rows), np.int64)
    step = max(1, _BLOCK_SIZE // p.shape[1])
    for k in range(0, len(rows), step):
        block = slice(k, k + step)
        squares: NDArray[np.float32] = np.zeros((len(rows[block]), p.shape[1]), np.float32)
        for axis in range(3):  # no BLAS: the result does not depend on the number of threads
            differences = offsets[block, axis, None] - q[axis]
            for column in range(3):
                differences += rows[block, axis, column, None] * p[column]
            squares += np.square(differences, out=differences)
        support[block] = np.count_nonzero(squares < _TOLERANCE_CELLS**2, axis=1)
    return support


def _refit(pairs: FeaturePairs, pose: Similarity, *, with_scale: bool) -> Similarity:
    """Return the pose refitted three times to the pairs that agree with it."""
    for _ in range(3):
        near = np.square(pose.apply(pairs.candidate) - pairs.reference).sum(axis=1) < _TOLERANCE_CELLS**2
        try:
            pose = fit_similarity(pairs.candidate[near], pairs.reference[near], with_scale=with_scale)
        except InputError:  # too few are left, or all lie on one line
            break
    return pose
