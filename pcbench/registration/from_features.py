"""Registration from nothing: poses from features, each refined and then compared with everything both clouds show.

A wrong pose reported with confidence is the failure that counts. Flat ground fits flat ground in a thousand poses, so
overlap and residuals say little. What counts is agreement: where the clouds meet, do surfaces of *all* directions lie
on each other, seen from both sides? And does no clearly different pose fit about as well?
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pcbench.errors import InputError, Notice, RegistrationError
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.neighbors import Index
from pcbench.geometry.normals import Surface, estimate_normals
from pcbench.geometry.transform import Similarity
from pcbench.geometry.voxels import cell_means, cells, robust_extent, voxel_downsample, voxel_downsample_to
from pcbench.registration.correspondences import RUNG, Pairs, apart, likely_poses, matched
from pcbench.registration.icp import IcpSettings, align
from pcbench.registration.quality import Fit, assess_given
from pcbench.registration.result import AMBIGUOUS, NO_CONVERGENCE, WEAK_EVIDENCE
from pcbench.registration.target import Target, local_origin

_CELLS = 15_000  # of the larger cloud, when features are compared: a second's work
_COARSER = 1.6  # what finer cells do not find, coarser ones may
_RUNGS = 7  # up and down: what either cloud covers may differ by 3.6 times a side
_MAX_POSES = 8  # from each comparison of features
_MAX_REFINED, _MAX_TURNED = 6, 3  # the most promising ones of those, and of the best one turned around
_MAX_POINTS = 300_000  # of a cloud that are looked at
_MAX_VARIATION = 0.12  # surface variation of what lies on a surface; edges have less, strays in the air more
_MAX_SAMPLE = 3_000  # points that a pose is refined and judged by
_MIN_POINTS = 100  # of either cloud
_MIN_MET = 0.05  # share of either cloud that has to meet the other, and
_MIN_MET_POINTS = 20  # of its sample
_MIN_COSINE = 0.85  # between normals that agree
_MIN_AGREEMENT, _MIN_SURE_AGREEMENT = 0.45, 0.5  # refused, warned of; other cities on one street grid reach 0.4
_MIN_RIVAL = 0.8  # of the best pose's agreement


@dataclass(frozen=True)
class FeatureSettings:
    """A registration method: from any pose, by matching features; then ICP. `global` on the command line.

    Attributes:
        with_scale: whether the scale is found too (`global-similarity`).
    """

    with_scale: bool = False

    def __post_init__(self) -> None:
        if not isinstance(self.with_scale, bool):
            raise InputError(f"expected with_scale as True or False, got {self.with_scale!r}")

    @property
    def text(self) -> str:
        """As on the command line."""
        return "global-similarity" if self.with_scale else "global"


def align_by_features(target: Target, points: FloatArray, settings: FeatureSettings, origin: FloatArray) -> Fit:
    """The pose of points (N, 3), which may lie anywhere, on a target; both are about one local origin.

    Args:
        target: the reference.
        points: (N, 3) of the candidate, minus the reference's local origin.
        settings: whether the scale is found too.
        origin: (3,) the local origin, which messages add again.

    Raises:
        MissingExtra: KISS-Matcher is not installed.
        RegistrationError: there are too few points, or no pose has the evidence.
    """
    _check_size(target, points)
    icp = IcpSettings(with_scale=settings.with_scale)
    middle = local_origin(Cloud(points))  # turning what is far away costs digits
    local = points - middle
    judge = _Judge(_View(target.surface.points), _View(local), icp)
    poses = judge.refined(judge.promising(judge.hypotheses(), _MAX_REFINED))
    if poses:  # what is symmetric looks the same turned around
        turned = [poses[0] @ turn for turn in _turns(judge.candidate.sample)]
        poses = judge.best_first(poses + judge.refined(judge.promising(turned, _MAX_TURNED)))
    if not poses or judge.agreement(poses[0]) < _MIN_AGREEMENT:
        why = f"of the best one only {judge.agreement(poses[0]):.0%} agrees" if poses else "none could be refined"
        raise RegistrationError(
            f"no pose of the candidate fits the reference ({why}): they show different scenes, overlap too little, or"
            " differ in scale (--register global-similarity). Align them coarsely first (--register points:FILE or"
            " matrix:FILE)"
        )
    # What does not meet the reference would only pull at a pose that starts right.
    start = poses[0]
    refined = align(target, local[judge.meets(start, local)], icp, start, may_be_far=False)
    pose = refined.T_local
    agreement = judge.agreement(pose)
    warnings = [notice for notice in refined.quality.warnings if notice.code == NO_CONVERGENCE]
    if agreement < _MIN_SURE_AGREEMENT:
        text = f"the evidence for this pose is weak: only {agreement:.0%} of what meets agrees"
        warnings.append(Notice(WEAK_EVIDENCE, text))
    rivals = [other for other in poses if judge.differ(other, pose) and judge.agreement(other) > _MIN_RIVAL * agreement]
    if rivals:
        away = apart(rivals[0], pose, judge.candidate.sample)
        rows = _unshifted(rivals[0], middle).about(origin).matrix[:3]
        text = (
            f"ambiguous: {agreement:.0%} of what meets agrees, but {judge.agreement(rivals[0]):.0%} does with the"
            f" candidate {away:.3g} away ({'; '.join(' '.join(f'{v:.6g}' for v in row) for row in rows)})"
        )
        warnings.append(Notice(AMBIGUOUS, text))
    # The whole candidate is judged, not only the part that ICP was given.
    quality = assess_given(target, points, _unshifted(pose, middle), origin, settings.text).quality
    quality = quality._replace(warnings=(*quality.warnings, *warnings))
    return Fit(_unshifted(pose, middle), quality, refined.iterations, refined.converged)


def _check_size(target: Target, points: FloatArray) -> None:
    if min(len(points), len(target.surface)) < _MIN_POINTS:
        raise RegistrationError(
            f"expected at least {_MIN_POINTS} points in each cloud to register from nothing, got {len(points)} and"
            f" {len(target.surface)}: use --register points:FILE, matrix:FILE or none"
        )
    for name, some in (("reference", target.surface.points), ("candidate", points)):
        if len(cells(some, robust_extent(some) / 1000 or 1.0).first) < _MIN_POINTS:
            raise RegistrationError(
                f"expected the {name}'s points at {_MIN_POINTS} places at least to register from nothing: use"
                " --register points:FILE, matrix:FILE or none"
            )


class _View:
    """A cloud as means over small cells, where noise and density hardly show; and an even sample of those.

    Attributes:
        points: those of them that lie on surfaces.
        side: of the cells that features are compared with, such that there are about 15,000.
        surface, target: the means over cells of a third of that.
        sample, normals, weights: (S, 3), (S, 3), (S,) of the surface; every direction of normals weighs about the same.
        reach: distance up to which another cloud meets it: 24 times how rough the surface is, 1 to 2.5 cells.
    """

    def __init__(self, points: FloatArray) -> None:
        points = points[:: max(1, len(points) // _MAX_POINTS)]
        flat = estimate_normals(Index(points)).variation < _MAX_VARIATION
        self.points = points = points[flat] if np.count_nonzero(flat) >= _MIN_POINTS else points
        self.side = _cell_side(points, min(_CELLS, len(points) // 2))
        self.surface = Surface(Index(cell_means(points, self.side / 3)))
        self.target = Target(self.surface)
        which = voxel_downsample_to(self.surface.points, _MAX_SAMPLE, start=self.side)
        self.sample, self.normals = self.surface.points[which], self.surface.normals(which)
        nearest = self.surface.index.query(self.sample, k=min(10, len(self.surface))).indices[:, -1]
        steps = np.einsum("ni,ni->n", self.surface.points[nearest] - self.sample, self.normals)
        rough = 1.4826 * float(np.median(np.abs(steps)))
        self.reach = float(np.clip(24 * rough, self.side, 2.5 * self.side))  # farther off, anything meets anything
        # Flat ground is most of many scenes, and fits itself anywhere: it must not outvote the walls.
        directions = cells(self.normals, 0.5, np.full(3, -1.25))
        self.weights: FloatArray = 1 / (directions.counts[directions.of_point] + len(which) / 20)


class _Judge:
    """What two views say about a pose. Lengths are in the reference's unit unless they are counted in cells."""

    def __init__(self, reference: _View, candidate: _View, icp: IcpSettings) -> None:
        self.reference, self.candidate, self.icp = reference, candidate, icp

    def hypotheses(self) -> list[Similarity]:
        """Poses that features speak for; with scale, at each rung of a ladder about the ratio of the extents."""
        if self.icp.with_scale:
            ratio = robust_extent(self.reference.points) / robust_extent(self.candidate.points)
            tried = [(ratio * RUNG**rung, _COARSER) for rung in range(-_RUNGS, _RUNGS + 1)]
        else:
            tried = [(1.0, 1.0), (1.0, _COARSER)]
        sides = [coarser * self.side(scale) for scale, coarser in tried]
        clouds = [
            Pairs(
                cell_means(self.candidate.points, side / scale) * (scale / side),
                cell_means(self.reference.points, side) / side,
            )
            for (scale, _), side in zip(tried, sides, strict=True)
        ]
        poses = []
        for (scale, _), side, pairs in zip(tried, sides, matched(clouds), strict=True):
            for pose in likely_poses(pairs, _MAX_POSES, with_scale=self.icp.with_scale):
                poses.append(Similarity(pose.rotation, side * pose.translation, scale * pose.scale))
        return poses

    def side(self, scale: float) -> float:
        """Of cells that are as coarse as either cloud needs."""
        return max(self.reference.side, scale * self.candidate.side)

    def reach(self, scale: float) -> float:
        return max(self.reference.reach, scale * self.candidate.reach)

    def meets(self, pose: Similarity, points: FloatArray, reaches: float = 2.0) -> NDArray[np.bool_]:
        """Which of the candidate's points (N, 3) have the reference within some reaches."""
        return self.reference.surface.index.query(pose.apply(points)).distances < reaches * self.reach(pose.scale)

    def agreement(self, pose: Similarity, reaches: float = 1.0) -> float:
        """Share of what lies within `reaches` of the other cloud that also lies in its surface, the mean of both ways.

        In it: within an eighth of that of the tangent plane, and of its direction. 0 where the clouds hardly meet.
        """
        reach = reaches * self.reach(pose.scale)
        back = pose.inverse()
        moved = pose.apply(self.candidate.sample), pose.apply_normals(self.candidate.normals)
        forth = _agreement(*moved, self.candidate.weights, self.reference.surface, reach)
        moved = back.apply(self.reference.sample), back.apply_normals(self.reference.normals)
        return (forth + _agreement(*moved, self.reference.weights, self.candidate.surface, reach / pose.scale)) / 2

    def promising(self, poses: list[Similarity], count: int) -> list[Similarity]:
        """The `count` different poses that agree best while they are still rough."""
        ordered = sorted(poses, key=lambda pose: -self.agreement(pose, reaches=4.0))
        return self._different(ordered)[:count]

    def best_first(self, poses: list[Similarity]) -> list[Similarity]:
        return self._different(sorted(poses, key=lambda pose: -self.agreement(pose)))

    def refined(self, poses: list[Similarity]) -> list[Similarity]:
        """The different poses that ICP makes of these, the best first; those that it refuses are left out."""
        results = []
        for pose in poses:
            try:
                for reaches in (4.0, 2.0):
                    near = self.candidate.sample[self.meets(pose, self.candidate.sample, reaches)]
                    pose = align(self.reference.target, near, self.icp, pose, may_be_far=False).T_local
            except (InputError, RegistrationError):  # nothing to fit there
                continue
            results.append(pose)
        return self.best_first(results)

    def differ(self, a: Similarity, b: Similarity) -> bool:
        """Whether two poses put the candidate clearly elsewhere: by 3 reaches."""
        return apart(a, b, self.candidate.sample) > 3 * self.reach(max(a.scale, b.scale))

    def _different(self, poses: Iterable[Similarity]) -> list[Similarity]:
        kept: list[Similarity] = []
        for pose in poses:
            if all(self.differ(pose, other) for other in kept):
                kept.append(pose)
        return kept


def _agreement(points: FloatArray, normals: FloatArray, weights: FloatArray, surface: Surface, reach: float) -> float:
    """Share, by weight, of points within reach of a surface that lie in it and have its direction."""
    distances, closest = surface.index.query(points)
    near = distances < reach
    if np.count_nonzero(near) < max(_MIN_MET_POINTS, _MIN_MET * len(points)):
        return 0.0
    tangent = surface.normals(closest)
    off = np.abs(np.einsum("ni,ni->n", points - surface.points[closest], tangent))
    level = np.abs(np.einsum("ni,ni->n", normals, tangent)) > _MIN_COSINE
    return float(weights[near & level & (off < reach / 8)].sum() / weights[near].sum())


def _cell_side(points: FloatArray, count: int) -> float:
    """Side of the cells of which points (N, 3) on surfaces fill about `count`."""
    side = robust_extent(points) / np.sqrt(count)
    for _ in range(5):
        side *= np.sqrt(len(voxel_downsample(points, side)) / count)
    return float(side)


def _turns(points: FloatArray) -> list[Similarity]:
    """Quarter and half turns about the principal axes of points (N, 3): the axes of whatever symmetry they have."""
    center = points.mean(axis=0)
    arms = points - center
    _, axes = np.linalg.eigh(np.einsum("ni,nj->ij", arms, arms))  # no BLAS: the same bits from any number of threads
    turns = []
    for axis in axes.T:
        x, y, z = axis
        k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        for rotation in (np.eye(3) + k + k @ k, np.eye(3) + 2 * k @ k, np.eye(3) - k + k @ k):
            turns.append(Similarity(rotation, center - rotation @ center))
    return turns


def _unshifted(pose: Similarity, middle: FloatArray) -> Similarity:
    """The pose for points from which `middle` was not subtracted."""
    return Similarity(pose.rotation, pose.translation - pose.linear @ middle, pose.scale)
