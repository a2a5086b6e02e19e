"""Registration from any pose: poses from features, each refined and then compared with all of both clouds.

A wrong pose reported with confidence is the failure to avoid. Flat ground fits flat ground in a thousand poses, so
overlap and residuals are weak evidence. The evidence is agreement: where the clouds overlap, surfaces of *all*
directions must coincide, tested from candidate to reference and back. And no clearly different pose may fit about as
well.
"""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from pcbench.errors import InputError, Notice, RegistrationError
from pcbench.geometry.arrays import FloatArray, random_rows
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.neighbors import Index
from pcbench.geometry.normals import Surface, estimate_normals
from pcbench.geometry.order_statistics import robust_sigma
from pcbench.geometry.transform import Similarity
from pcbench.geometry.voxels import cell_means, cells, robust_extent, voxel_downsample, voxel_downsample_to
from pcbench.registration.contrast import CONFIDENT_CONTRAST, contrast
from pcbench.registration.correspondences import SCALE_STEP, FeaturePairs, likely_poses, match_features, pose_distance
from pcbench.registration.icp import fit_pose
from pcbench.registration.icp_settings import IcpSettings
from pcbench.registration.icp_stages import IcpProblem, refine
from pcbench.registration.quality import Fit, assess_given
from pcbench.registration.result import AMBIGUOUS, DOUBTFUL_POSE, NO_CONVERGENCE
from pcbench.registration.target import Target, local_origin
from pcbench.registration.turns import symmetry_turns
from pcbench.registration.unmatched import MAX_UNMATCHED_SHARE, unmatched_share

_FEATURE_CELL_COUNT = 15_000  # cells of the larger cloud for feature matching: about one second
_COARSE_CELL_FACTOR = 1.6  # coarser cells may find poses that finer cells miss
# Exponents of the scale steps tried, the likeliest first: the clouds' extents may differ by a factor of 3.6.
_SCALE_EXPONENTS = ((0, -1, 1), (-2, 2, -3, 3), (-4, 4, -5, 5, -6, 6, -7, 7))
_MAX_POSES = 8  # per feature comparison
_MAX_REFINED, _MAX_SYMMETRIC = 6, 3  # poses refined: the most promising, and turns of the best about its symmetry axes
_MAX_POINTS = 300_000  # points used of each cloud
_MAX_VARIATION = 0.12  # surface variation of points on a surface; edges and floating outliers have more
_MIN_SURFACE_SHARE = 0.6  # share of a cloud on surfaces, above which the other points are dropped as outliers and edges
_MIN_SEARCHED_SHARE = 0.4  # above which the surfaces are searched if no pose of all points has enough evidence
_MAX_SAMPLE_POINTS = 3_000  # points for refining and evaluating a pose
_MIN_POINTS = 100  # in each cloud
_MIN_OVERLAP = 0.05  # share of a cloud's sample that must overlap the other cloud
_MIN_OVERLAP_POINTS = 20  # points of the sample that must overlap the other cloud
_MIN_COSINE = 0.85  # between normals that agree
_SUFFICIENT_OVERLAP = 0.2  # share of a cloud that overlaps the other: a larger share is no stronger evidence
_MAX_EXPLAINED_SAMPLE = 10_000  # candidate points that a pose has to explain
_MIN_RIVAL_SHARE = 0.9  # share of the best pose's evidence that makes another pose a rival


@dataclass(frozen=True)
class FeatureSettings:
    """Registration method: from any pose by feature matching, then ICP. `global` on the command line.

    Attributes:
        with_scale: whether the scale is solved for too (`global-similarity`).
    """

    with_scale: bool = False

    files: ClassVar[tuple[()]] = ()

    def __post_init__(self) -> None:
        if not isinstance(self.with_scale, bool):
            raise InputError(f"expected with_scale as True or False, got {self.with_scale!r}")

    @property
    def text(self) -> str:
        """Method name as on the command line."""
        return "global-similarity" if self.with_scale else "global"


def align_by_features(target: Target, points: FloatArray, settings: FeatureSettings, origin: FloatArray) -> Fit:
    """Register points (N, 3) in any pose to a target; both are relative to one local origin.

    Args:
        target: reference.
        points: (N, 3) candidate points minus the reference's local origin.
        settings: whether the scale is solved for too.
        origin: (3,) local origin, added again in messages.

    Raises:
        MissingExtra: KISS-Matcher is not installed.
        RegistrationError: there are too few points, or no pose has enough evidence.
    """
    _check_size(target, points)
    shift = local_origin(Cloud(points))  # rotating points far from the origin loses precision
    *attempts, last = _search_points(target.surface.points, points - shift)
    for parts in attempts:
        with suppress(RegistrationError):
            return _align_parts(parts, target, points, settings, origin, shift)
    return _align_parts(last, target, points, settings, origin, shift)


def _align_parts(
    parts: tuple[FloatArray, FloatArray],
    target: Target,
    points: FloatArray,
    settings: FeatureSettings,
    origin: FloatArray,
    shift: FloatArray,
) -> Fit:
    """Search with some points of both clouds, then refine and assess with all of them.

    Args:
        parts: points of the reference, and of the candidate minus `shift`, that the search uses.
        target: reference.
        points: (N, 3) candidate points minus the reference's local origin.
        settings: whether the scale is solved for too.
        origin: (3,) the reference's local origin.
        shift: (3,) local origin of `points`.

    Raises:
        MissingExtra: KISS-Matcher is not installed.
        RegistrationError: no pose has enough evidence.
    """
    icp, local = IcpSettings(with_scale=settings.with_scale), points - shift
    search = _PoseSearch(_CellCloud(parts[0]), _CellCloud(parts[1]), icp)
    poses = search.search()
    if not poses:
        raise _no_pose_error("none could be refined", settings)
    sample = random_rows(local, _MAX_EXPLAINED_SAMPLE)
    explained = [pose for pose in poses if unmatched_share(target, pose.apply(sample)) <= MAX_UNMATCHED_SHARE]
    poses = explained or poses  # a pose that leaves points unmatched is refused below
    # Full resolution may end at another pose than the cells: compare the pose that is returned.
    start, fit = poses[0], search.refine_full(poses[0], target, local)
    if len(poses) > 1 and search.evidence(fit.T_local) < search.evidence(poses[1]):
        other = search.refine_full(poses[1], target, local)
        if search.evidence(other.T_local) > search.evidence(fit.T_local):
            start, fit = poses[1], other
    pose = fit.T_local
    # Assess the complete candidate, not only the part that ICP used.
    quality = assess_given(target, points, _undo_shift(pose, shift), origin, settings.text, source="search").quality
    if quality.contrast is None:
        raise _no_pose_error("the best one overlaps it in too few points", settings)
    if (doubt := next((notice for notice in quality.warnings if notice.code == DOUBTFUL_POSE), None)) is not None:
        raise _no_pose_error(str(doubt), settings)
    warnings = [notice for notice in fit.quality.warnings if notice.code == NO_CONVERGENCE]
    rivals = [p for p in poses if p is not start and search.are_different(p, pose)]
    rivals = [p for p in rivals if search.evidence(p) > _MIN_RIVAL_SHARE * search.evidence(pose)]
    if rivals:
        distance = pose_distance(rivals[0], pose, search.candidate.sample)
        rows = _undo_shift(rivals[0], shift).about(origin).matrix[:3]
        text = (
            f"ambiguous: this pose has evidence {search.evidence(pose):.0%}, but another pose, which moves the"
            f" candidate by {distance:.3g}, has {search.evidence(rivals[0]):.0%}"
            f" ({'; '.join(' '.join(f'{v:.6g}' for v in row) for row in rows)})"
        )
        warnings.append(Notice(AMBIGUOUS, text))
    quality = quality._replace(warnings=(*quality.warnings, *warnings))
    return Fit(_undo_shift(pose, shift), quality, fit.iterations, fit.converged)


def _no_pose_error(why: str, settings: FeatureSettings) -> RegistrationError:
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
            f"expected at least {_MIN_POINTS} points in each cloud to register from any pose, got {len(points):,} in"
            f" the candidate and {len(target.surface):,} in the reference: use --register points:FILE, matrix:FILE or"
            " none"
        )
    for name, part in (("reference", target.surface.points), ("candidate", points)):
        if len(cells(part, robust_extent(part) / 1000 or 1.0).first) < _MIN_POINTS:
            raise RegistrationError(
                f"expected the {name}'s points at {_MIN_POINTS} or more distinct positions to register from any pose:"
                " use --register points:FILE, matrix:FILE or none"
            )


def _search_points(reference: FloatArray, candidate: FloatArray) -> list[tuple[FloatArray, FloatArray]]:
    """Return the points to search with, at most 300,000 per cloud, in the order of attempts.

    Points on surfaces are enough if most points lie on them. Otherwise all points come first, as in a forest; the
    surfaces come second, because the other points may be outliers.
    """
    clouds = [points[:: max(1, len(points) // _MAX_POINTS)] for points in (reference, candidate)]
    is_surface = [estimate_normals(Index(points)).variation < _MAX_VARIATION for points in clouds]
    everything = clouds[0], clouds[1]
    surfaces = clouds[0][is_surface[0]], clouds[1][is_surface[1]]
    share = min(part.mean() for part in is_surface)
    if share < _MIN_SEARCHED_SHARE or min(map(len, surfaces)) < _MIN_POINTS:
        return [everything]
    return [surfaces] if share >= _MIN_SURFACE_SHARE else [everything, surfaces]


class _CellCloud:
    """Cloud as means over small cells, which hide noise and density, and an even sample of these.

    Attributes:
        points: points used.
        side: side of the cells for feature matching; about 15,000 cells are occupied.
        surface: means over cells of a third of that side.
        target: `surface` as a registration target.
        sample: (S, 3) even sample of the surface.
        normals: (S, 3) normals of the sample.
        weights: (S,) weights of the sample, such that all directions of normals have about the same total weight.
        overlap_distance: distance up to which another cloud overlaps this one: 24 times the roughness, clamped to 1 to
            2.5 cell sides.
    """

    def __init__(self, points: FloatArray) -> None:
        self.points = points
        self.side = _cell_side(points, min(_FEATURE_CELL_COUNT, len(points) // 2))
        self.surface = Surface(Index(cell_means(points, self.side / 3)))
        self.target = Target(self.surface)
        which = voxel_downsample_to(self.surface.points, _MAX_SAMPLE_POINTS, start=self.side)
        self.sample, self.normals = self.surface.points[which], self.surface.normals(which)
        nearest = self.surface.index.query(self.sample, k=min(10, len(self.surface))).indices[:, -1]
        plane_offsets = np.einsum("ni,ni->n", self.surface.points[nearest] - self.sample, self.normals)
        roughness = robust_sigma(plane_offsets)
        # At larger distances any two clouds would overlap.
        self.overlap_distance = float(np.clip(24 * roughness, self.side, 2.5 * self.side))
        # Flat ground dominates many scenes and fits itself anywhere: it must not outweigh the walls.
        directions = cells(self.normals, 0.5, np.full(3, -1.25))
        self.weights: FloatArray = 1 / (directions.counts[directions.of_point] + len(which) / 20)


class _PoseSearch:
    """Search for the pose of a candidate on a reference.

    Lengths are in the reference's unit unless counted in cells.
    """

    def __init__(self, reference: _CellCloud, candidate: _CellCloud, icp: IcpSettings) -> None:
        self.reference, self.candidate, self.icp = reference, candidate, icp
        self._evidence: dict[bytes, float] = {}

    def search(self) -> list[Similarity]:
        """Return the different poses with evidence, the best first; stop early at a pose that is confident."""
        scale_ratio = 1.0
        batches: list[list[tuple[int, float]]] = [[(0, _COARSE_CELL_FACTOR)], [(0, 1.0)]]
        if self.icp.with_scale:
            scale_ratio = robust_extent(self.reference.points) / robust_extent(self.candidate.points)
            batches = [[(exponent, _COARSE_CELL_FACTOR) for exponent in exponents] for exponents in _SCALE_EXPONENTS]
        poses: list[Similarity] = []
        for batch in batches:
            proposed = self.propose_poses([(scale_ratio * SCALE_STEP**k, factor) for k, factor in batch])
            poses = self.sort_by_evidence(poses + self.refine_all(self.select_promising(proposed, _MAX_REFINED)))
            if poses and self.is_confident(poses[0]):
                break
        if poses:  # a symmetric cloud looks the same in turned poses
            symmetric_poses = [poses[0] @ turn for turn in symmetry_turns(self.candidate.sample)]
            poses = self.sort_by_evidence(
                poses + self.refine_all(self.select_promising(symmetric_poses, _MAX_SYMMETRIC))
            )
        return [pose for pose in poses if self.evidence(pose) > 0]

    def propose_poses(self, scales_and_factors: list[tuple[float, float]]) -> list[Similarity]:
        """Return poses supported by features, per scale and cell factor."""
        sides = [cell_factor * self.side(scale) for scale, cell_factor in scales_and_factors]
        clouds = [
            FeaturePairs(
                cell_means(self.candidate.points, side / scale) * (scale / side),
                cell_means(self.reference.points, side) / side,
            )
            for (scale, _), side in zip(scales_and_factors, sides, strict=True)
        ]
        poses = []
        for (scale, _), side, pairs in zip(scales_and_factors, sides, match_features(clouds), strict=True):
            for pose in likely_poses(pairs, _MAX_POSES, with_scale=self.icp.with_scale):
                poses.append(Similarity(pose.rotation, side * pose.translation, scale * pose.scale))
        return poses

    def refine_full(self, pose: Similarity, target: Target, points: FloatArray) -> Fit:
        """Run ICP at full resolution on the overlapping points; the others would only bias a pose that starts right."""
        problem = IcpProblem.of(target, pose.apply(points[self.is_near(pose, points)]), self.icp)
        fit = fit_pose(problem, may_be_far=False)
        return fit._replace(T_local=fit.T_local @ pose)

    def side(self, scale: float) -> float:
        """Return the side of cells that are coarse enough for both clouds."""
        return max(self.reference.side, scale * self.candidate.side)

    def overlap_distance(self, scale: float) -> float:
        """Return the distance up to which points of the two clouds overlap, in the reference's unit."""
        return max(self.reference.overlap_distance, scale * self.candidate.overlap_distance)

    def is_near(self, pose: Similarity, points: FloatArray, factor: float = 2.0) -> NDArray[np.bool_]:
        """Return which candidate points (N, 3) have the reference within `factor` overlap distances."""
        max_distance = factor * self.overlap_distance(pose.scale)
        return self.reference.surface.index.query(pose.apply(points)).distances < max_distance

    def agreement(self, pose: Similarity, factor: float = 1.0) -> float:
        """Share of overlapping points that lie in the other cloud's surface, averaged over both directions.

        A point overlaps within `factor` overlap distances. It lies in the surface if it is within an eighth of that
        from the tangent plane and its normal agrees. 0 if the clouds hardly overlap.
        """
        overlap_distance = factor * self.overlap_distance(pose.scale)
        inverse_pose = pose.inverse()
        moved = pose.apply(self.candidate.sample), pose.apply_normals(self.candidate.normals)
        candidate_to_reference = _agreement(*moved, self.candidate.weights, self.reference.surface, overlap_distance)
        moved = inverse_pose.apply(self.reference.sample), inverse_pose.apply_normals(self.reference.normals)
        distance = overlap_distance / pose.scale
        reference_to_candidate = _agreement(*moved, self.reference.weights, self.candidate.surface, distance)
        return (candidate_to_reference + reference_to_candidate) / 2

    def contrast(self, pose: Similarity) -> float:
        """Contrast of the candidate's sample on the reference (see `contrast`), in 0 to 1; 0 if hardly any overlap."""
        surface, target = self.reference.surface, self.reference.target
        moved, overlap_distance = pose.apply(self.candidate.sample), self.overlap_distance(pose.scale)
        nearest = surface.index.query(moved)
        near = np.flatnonzero(nearest.distances < 2 * overlap_distance)
        if not len(near):
            return 0.0
        pose_contrast = contrast(
            surface,
            moved,
            nearest,
            near,
            sigma=robust_sigma(surface.plane_offsets(moved, nearest.indices)[near]),
            spacing=target.spacing,
            extent=target.extent,
            with_scale=self.icp.with_scale,
        )
        return min(max(pose_contrast.share, 0.0), 1.0) if pose_contrast else 0.0

    def evidence(self, pose: Similarity) -> float:
        """Evidence for a pose, 0 to 1: agreement times contrast, reduced if the overlap is below a fifth.

        Agreement of a small corner is weak evidence for the alignment of the two clouds.
        """
        key = pose.matrix.tobytes()
        if key not in self._evidence:
            overlap = min(self.overlap(pose) / _SUFFICIENT_OVERLAP, 1.0)
            self._evidence[key] = overlap * self.agreement(pose) * self.contrast(pose)
        return self._evidence[key]

    def overlap(self, pose: Similarity) -> float:
        """Share of either sample, the larger, that lies within the overlap distance of the other cloud."""
        of_candidate = self.is_near(pose, self.candidate.sample, 1.0).mean()
        distances = self.candidate.surface.index.query(pose.inverse().apply(self.reference.sample)).distances
        return float(max(of_candidate, (distances < self.overlap_distance(pose.scale) / pose.scale).mean()))

    def is_confident(self, pose: Similarity) -> bool:
        """Return whether contrast and overlap leave no doubt about a pose."""
        return self.contrast(pose) > CONFIDENT_CONTRAST and self.overlap(pose) > _SUFFICIENT_OVERLAP

    def select_promising(self, poses: list[Similarity], count: int) -> list[Similarity]:
        """Return the `count` different poses that agree best before refinement."""
        agreement = [self.agreement(pose, factor=4.0) for pose in poses]
        ordered = [poses[k] for k in np.argsort(np.negative(agreement), kind="stable")]
        return self._distinct(ordered)[:count]

    def sort_by_evidence(self, poses: list[Similarity]) -> list[Similarity]:
        """Return the different poses, those with the most evidence first."""
        return self._distinct(sorted(poses, key=lambda pose: -self.evidence(pose)))

    def refine_all(self, poses: list[Similarity]) -> list[Similarity]:
        """Refine poses by ICP; drop those for which it fails."""
        results = []
        for pose in poses:
            try:
                for factor in (4.0, 2.0):
                    near = self.candidate.sample[self.is_near(pose, self.candidate.sample, factor)]
                    pose = refine(self.reference.target, near, self.icp, pose)
            except (InputError, RegistrationError):  # too few points to fit
                continue
            results.append(pose)
        return results

    def are_different(self, a: Similarity, b: Similarity) -> bool:
        """Return whether two poses move the candidate's points more than 3 overlap distances apart."""
        return pose_distance(a, b, self.candidate.sample) > 3 * self.overlap_distance(max(a.scale, b.scale))

    def _distinct(self, poses: Iterable[Similarity]) -> list[Similarity]:
        kept: list[Similarity] = []
        for pose in poses:
            if all(self.are_different(pose, other) for other in kept):
                kept.append(pose)
        return kept


def _agreement(
    points: FloatArray, normals: FloatArray, weights: FloatArray, surface: Surface, overlap_distance: float
) -> float:
    """Return the weighted share of points near a surface that lie in it and whose normals agree."""
    distances, closest = surface.index.query(points)
    near = distances < overlap_distance
    if np.count_nonzero(near) < max(_MIN_OVERLAP_POINTS, _MIN_OVERLAP * len(points)):
        return 0.0
    tangent = surface.normals(closest)
    plane_distances = np.abs(np.einsum("ni,ni->n", points - surface.points[closest], tangent))
    is_parallel = np.abs(np.einsum("ni,ni->n", normals, tangent)) > _MIN_COSINE
    return float(weights[near & is_parallel & (plane_distances < overlap_distance / 8)].sum() / weights[near].sum())


def _cell_side(points: FloatArray, count: int) -> float:
    """Return the side of cells of which points (N, 3) on surfaces occupy about `count`."""
    side = robust_extent(points) / np.sqrt(count)
    for _ in range(5):
        side *= np.sqrt(len(voxel_downsample(points, side)) / count)
    return float(side)


def _undo_shift(pose: Similarity, shift: FloatArray) -> Similarity:
    """Return the pose for points from which `shift` was not subtracted."""
    return Similarity(pose.rotation, pose.translation - pose.linear @ shift, pose.scale)
