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
from pcbench.registration.contrast import SURE, contrast
from pcbench.registration.correspondences import RUNG, FeaturePairs, apart, likely_poses, matched
from pcbench.registration.icp import IcpSettings, align, refine
from pcbench.registration.quality import Fit, assess_given
from pcbench.registration.result import AMBIGUOUS, NO_CONVERGENCE
from pcbench.registration.target import Target, local_origin

_CELLS = 15_000  # of the larger cloud, when features are compared: a second's work
_COARSER = 1.6  # what finer cells do not find, coarser ones may
# Rungs up and down, the likeliest first: what either cloud covers may differ by 3.6 times a side.
_LADDER = ((0, -1, 1), (-2, 2, -3, 3), (-4, 4, -5, 5, -6, 6, -7, 7))
_MAX_POSES = 8  # from each comparison of features
_MAX_REFINED, _MAX_TURNED = 6, 3  # the most promising ones of those, and of the best one turned around
_MAX_POINTS = 300_000  # of a cloud that are looked at
_MAX_VARIATION = 0.12  # surface variation of what lies on a surface; edges have less, strays in the air more
_MIN_FLAT = 0.6  # share of a cloud on surfaces, for it to be taken for strays and edges what is not
_MAX_SAMPLE = 3_000  # points that a pose is refined and judged by
_MIN_POINTS = 100  # of either cloud
_MIN_MET = 0.05  # share of either cloud that has to meet the other, and
_MIN_MET_POINTS = 20  # of its sample
_MIN_COSINE = 0.85  # between normals that agree
_ENOUGH_MET = 0.2  # share of a cloud that meets the other: more of it is no more evidence
_MIN_CONTRAST = 0.7  # below it a pose is refused
_MIN_RIVAL = 0.9  # of the best pose's evidence


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
    seen = _on_surfaces(target.surface.points, local)
    judge = _Judge(_View(seen[0]), _View(seen[1]), icp)
    poses = judge.found()
    if not poses:
        raise _nothing_fits("none could be refined", settings)
    # Full resolution may end elsewhere than the views: the pose that is returned is the one that is compared.
    start, fit = poses[0], judge.finished(poses[0], target, local)
    if len(poses) > 1 and judge.evidence(fit.T_local) < judge.evidence(poses[1]):
        other = judge.finished(poses[1], target, local)
        if judge.evidence(other.T_local) > judge.evidence(fit.T_local):
            start, fit = poses[1], other
    pose = fit.T_local
    # The whole candidate is judged, not only the part that ICP was given.
    quality = assess_given(target, points, _unshifted(pose, middle), origin, settings.text).quality
    if quality.contrast is None or quality.contrast < _MIN_CONTRAST:
        raise _nothing_fits(
            f"moving away from the best one costs {max(quality.contrast or 0, 0):.0%} of what it should", settings
        )
    warnings = [notice for notice in fit.quality.warnings if notice.code == NO_CONVERGENCE]
    rivals = [p for p in poses if p is not start and judge.differ(p, pose)]
    rivals = [p for p in rivals if judge.evidence(p) > _MIN_RIVAL * judge.evidence(pose)]
    if rivals:
        away = apart(rivals[0], pose, judge.candidate.sample)
        rows = _unshifted(rivals[0], middle).about(origin).matrix[:3]
        text = (
            f"ambiguous: {judge.evidence(pose):.0%} speaks for this pose, but {judge.evidence(rivals[0]):.0%} for the"
            f" candidate {away:.3g} away ({'; '.join(' '.join(f'{v:.6g}' for v in row) for row in rows)})"
        )
        warnings.append(Notice(AMBIGUOUS, text))
    quality = quality._replace(warnings=(*quality.warnings, *warnings))
    return Fit(_unshifted(pose, middle), quality, fit.iterations, fit.converged)


def _nothing_fits(why: str, settings: FeatureSettings) -> RegistrationError:
    reasons = ["they show different scenes", "overlap too little"]
    if not settings.with_scale:
        reasons.append("differ in scale (--register global-similarity)")
    return RegistrationError(
        f"no pose of the candidate fits the reference ({why}): {', '.join(reasons[:-1])} or {reasons[-1]}. Align them"
        " coarsely first (--register points:FILE or matrix:FILE)"
    )


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


def _on_surfaces(reference: FloatArray, candidate: FloatArray) -> list[FloatArray]:
    """At most 300,000 points of each cloud, those on surfaces; all where much of a cloud is none, such as a wood."""
    clouds = [points[:: max(1, len(points) // _MAX_POINTS)] for points in (reference, candidate)]
    flat = [estimate_normals(Index(points)).variation < _MAX_VARIATION for points in clouds]
    if any(some.mean() < _MIN_FLAT or np.count_nonzero(some) < _MIN_POINTS for some in flat):
        return clouds
    return [points[some] for points, some in zip(clouds, flat, strict=True)]


class _View:
    """A cloud as means over small cells, where noise and density hardly show; and an even sample of those.

    Attributes:
        points: those that are looked at.
        side: of the cells that features are compared with, such that there are about 15,000.
        surface, target: the means over cells of a third of that.
        sample, normals, weights: (S, 3), (S, 3), (S,) of the surface; every direction of normals weighs about the same.
        reach: distance up to which another cloud meets it: 24 times how rough the surface is, 1 to 2.5 cells.
    """

    def __init__(self, points: FloatArray) -> None:
        self.points = points
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
        self._evidence: dict[bytes, float] = {}

    def found(self) -> list[Similarity]:
        """The different poses with evidence, the best first; no more are looked for where one leaves no doubt."""
        ratio = 1.0
        batches: list[list[tuple[int, float]]] = [[(0, _COARSER)], [(0, 1.0)]]
        if self.icp.with_scale:
            ratio = robust_extent(self.reference.points) / robust_extent(self.candidate.points)
            batches = [[(rung, _COARSER) for rung in rungs] for rungs in _LADDER]
        poses: list[Similarity] = []
        for batch in batches:
            rough = self.hypotheses([(ratio * RUNG**rung, coarser) for rung, coarser in batch])
            poses = self.best_first(poses + self.refined(self.promising(rough, _MAX_REFINED)))
            if poses and self.is_sure(poses[0]):
                break
        if poses:  # what is symmetric looks the same turned around
            turned = [poses[0] @ turn for turn in _turns(self.candidate.sample)]
            poses = self.best_first(poses + self.refined(self.promising(turned, _MAX_TURNED)))
        return [pose for pose in poses if self.evidence(pose) > 0]

    def hypotheses(self, tried: list[tuple[float, float]]) -> list[Similarity]:
        """Poses that features speak for, at each of some scales with cells that are coarser by a factor."""
        sides = [coarser * self.side(scale) for scale, coarser in tried]
        clouds = [
            FeaturePairs(
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

    def finished(self, pose: Similarity, target: Target, points: FloatArray) -> Fit:
        """ICP at full resolution. What does not meet the reference would only pull at a pose that starts right."""
        return align(target, points[self.meets(pose, points)], self.icp, pose, may_be_far=False)

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

    def contrast(self, pose: Similarity) -> float:
        """Of the candidate's sample on the reference's surface, see `contrast`; 0 where hardly anything meets."""
        surface, target = self.reference.surface, self.reference.target
        moved, reach = pose.apply(self.candidate.sample), self.reach(pose.scale)
        nearest = surface.index.query(moved)
        near = np.flatnonzero(nearest.distances < 2 * reach)
        if not len(near):
            return 0.0
        off = np.einsum("ni,ni->n", moved - surface.points[nearest.indices], surface.normals(nearest.indices))[near]
        sharp = contrast(
            surface,
            moved,
            nearest,
            near,
            sigma=1.4826 * float(np.median(np.abs(off))),
            spacing=target.spacing,
            extent=target.extent,
            with_scale=self.icp.with_scale,
        )
        return min(max(sharp.share, 0.0), 1.0) if sharp else 0.0

    def evidence(self, pose: Similarity) -> float:
        """How much speaks for a pose, 0 to 1: agreement, for as much as the pose is better than its surroundings.

        The least of 0 to 1 that meets counts, up to a fifth: a corner that agrees is no agreement of two clouds.
        """
        key = pose.matrix.tobytes()
        if key not in self._evidence:
            met = min(self.met(pose) / _ENOUGH_MET, 1.0)
            self._evidence[key] = met * self.agreement(pose) * self.contrast(pose)
        return self._evidence[key]

    def met(self, pose: Similarity) -> float:
        """Share of the candidate's sample, or of the reference's where that is larger, within a reach of the other."""
        forth = self.meets(pose, self.candidate.sample, 1.0).mean()
        back = self.candidate.surface.index.query(pose.inverse().apply(self.reference.sample)).distances
        return float(max(forth, (back < self.reach(pose.scale) / pose.scale).mean()))

    def is_sure(self, pose: Similarity) -> bool:
        return self.contrast(pose) > SURE and self.met(pose) > _ENOUGH_MET

    def promising(self, poses: list[Similarity], count: int) -> list[Similarity]:
        """The `count` different poses that agree best while they are still rough."""
        agreement = [self.agreement(pose, reaches=4.0) for pose in poses]
        ordered = [poses[k] for k in np.argsort(np.negative(agreement), kind="stable")]
        return self._different(ordered)[:count]

    def best_first(self, poses: list[Similarity]) -> list[Similarity]:
        return self._different(sorted(poses, key=lambda pose: -self.evidence(pose)))

    def refined(self, poses: list[Similarity]) -> list[Similarity]:
        """What ICP makes of poses; those that it refuses are left out."""
        results = []
        for pose in poses:
            try:
                for reaches in (4.0, 2.0):
                    near = self.candidate.sample[self.meets(pose, self.candidate.sample, reaches)]
                    pose = refine(self.reference.target, near, self.icp, pose)
            except (InputError, RegistrationError):  # nothing to fit there
                continue
            results.append(pose)
        return results

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
