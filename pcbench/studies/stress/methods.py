"""Registration methods behind one call: ours, and those of other libraries if they are installed.

Other libraries run coarse to fine with the parameters of their examples, scaled to the scene: voxels of one spacing of
the reference, and maximum correspondence distances of 10, 3 and 1 % of the extent. They report no doubt: a
result counts as doubtful if it has not converged, or matches less than 30 % of the candidate (KISS-Matcher: fewer than
5 inliers, the rule of its example).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from pcbench.errors import RegistrationError
from pcbench.extras import require
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.neighbors import Index
from pcbench.geometry.sampling import median_spacing
from pcbench.geometry.transform import Similarity
from pcbench.registration import register
from pcbench.studies.stress.scenes import extent_of
from pcbench.studies.stress.subject import GLOBAL, LOCAL, StressMethod, by_name

_MAX_DISTANCE_SHARES = (0.1, 0.03, 0.01)  # maximum correspondence distances over the extent
_FEATURE_SHARE = 0.015  # voxel of features over the extent
_MIN_SPACINGS = 2.0  # the shortest maximum distance and the voxel of features are at least this many spacings
_MIN_MATCHED_SHARE = 0.3
_MIN_KISS_INLIERS = 5
_MAX_ITERATIONS = 60
LOW_FITNESS, NOT_CONVERGED, FEW_INLIERS = "low-fitness", "no-convergence", "few-inliers"  # codes of other libraries


@dataclass(frozen=True)
class PoseResult:
    """Result of a registration method.

    Attributes:
        T_reference_candidate: pose; None if the method refuses.
        doubtful: whether the method says that the pose may be wrong.
        codes: codes of all warnings.
        message: reason of a refusal, in one line.
    """

    T_reference_candidate: Similarity | None
    doubtful: bool = False
    codes: tuple[str, ...] = ()
    message: str = ""


Register = Callable[[FloatArray, FloatArray, int], PoseResult]


@dataclass(frozen=True)
class Lengths:
    """Parameters of other libraries, in the clouds' unit."""

    voxel: float
    feature_voxel: float
    max_distances: tuple[float, ...]

    @classmethod
    def of(cls, reference: FloatArray) -> Lengths:
        """Return parameters that are scaled to a reference (N, 3)."""
        spacing, extent = median_spacing(Index(reference)), extent_of(reference)
        shortest = _MIN_SPACINGS * spacing
        distances = tuple(max(shortest, share * extent) for share in _MAX_DISTANCE_SHARES)
        return cls(spacing, max(shortest, _FEATURE_SHARE * extent), distances)


def _ours(method: str) -> Register:
    def run(reference: FloatArray, candidate: FloatArray, _: int) -> PoseResult:
        try:
            registration = register(reference, candidate, method)
        except RegistrationError as error:
            return PoseResult(None, doubtful=True, message=" ".join(str(error).split()))
        codes = tuple(notice.code for notice in registration.warnings)
        return PoseResult(registration.T_reference_candidate, registration.doubtful, codes)

    return run


def _open3d_icp(kind: str) -> Register:
    def run(reference: FloatArray, candidate: FloatArray, _: int) -> PoseResult:
        o3d = require("open3d.pipelines.registration")
        lengths = Lengths.of(reference)
        fixed, moving = (_open3d_cloud(points, lengths.voxel) for points in (reference, candidate))
        criteria = o3d.ICPConvergenceCriteria(max_iteration=_MAX_ITERATIONS)
        T, result = np.eye(4), None
        for distance in lengths.max_distances:
            if kind == "GICP":
                estimator = o3d.TransformationEstimationForGeneralizedICP()
                result = o3d.registration_generalized_icp(moving, fixed, distance, T, estimator, criteria)
            else:
                estimator = o3d.TransformationEstimationPointToPlane()
                result = o3d.registration_icp(moving, fixed, distance, T, estimator, criteria)
            T = result.transformation
        return _judged(T, result.fitness if result is not None else 0.0)

    return run


def open3d_features(
    reference: FloatArray, candidate: FloatArray, solver: str, seed: int, lengths: Lengths
) -> PoseResult:
    """Register by FPFH features with RANSAC or FGR and the parameters of Open3D's tutorial, then by its ICP.

    Args:
        reference: (N, 3) points of the reference.
        candidate: (M, 3) points of the candidate.
        solver: `RANSAC` or `FGR`.
        seed: random seed of Open3D.
        lengths: voxels and maximum correspondence distances.
    """
    o3d, utility = require("open3d.pipelines.registration"), require("open3d.utility")
    geometry = require("open3d.geometry")
    utility.random.seed(seed)
    v, clouds, features = lengths.feature_voxel, [], []
    for points in (candidate, reference):
        cloud = geometry.PointCloud(utility.Vector3dVector(points)).voxel_down_sample(v)
        cloud.estimate_normals(geometry.KDTreeSearchParamHybrid(2 * v, 30))
        clouds.append(cloud)
        features.append(o3d.compute_fpfh_feature(cloud, geometry.KDTreeSearchParamHybrid(5 * v, 100)))
    if solver == "FGR":
        options = o3d.FastGlobalRegistrationOption(maximum_correspondence_distance=0.5 * v)
        fit = o3d.registration_fgr_based_on_feature_matching(*clouds, *features, options)
    else:
        checkers = [
            o3d.CorrespondenceCheckerBasedOnEdgeLength(0.9),
            o3d.CorrespondenceCheckerBasedOnDistance(1.5 * v),
        ]
        fit = o3d.registration_ransac_based_on_feature_matching(
            *clouds,
            *features,
            True,
            1.5 * v,
            o3d.TransformationEstimationPointToPoint(False),
            3,
            checkers,
            o3d.RANSACConvergenceCriteria(100_000, 0.999),
        )
    moving, fixed = (_open3d_cloud(points, lengths.voxel) for points in (candidate, reference))
    plane = o3d.TransformationEstimationPointToPlane()
    result = o3d.registration_icp(moving, fixed, lengths.max_distances[-1], fit.transformation, plane)
    return _judged(result.transformation, result.fitness)


def _open3d_features(solver: str) -> Register:
    def run(reference: FloatArray, candidate: FloatArray, seed: int) -> PoseResult:
        return open3d_features(reference, candidate, solver, seed, Lengths.of(reference))

    return run


def _small_gicp(kind: str) -> Register:
    def run(reference: FloatArray, candidate: FloatArray, _: int) -> PoseResult:
        library = require("small_gicp")
        lengths = Lengths.of(reference)
        target, tree = library.preprocess_points(reference, lengths.voxel, num_threads=1)
        source, _tree = library.preprocess_points(candidate, lengths.voxel, num_threads=1)
        T, result = np.eye(4), None
        for distance in lengths.max_distances:
            result = library.align(
                target,
                source,
                tree,
                registration_type=kind,
                init_T_target_source=T,
                max_correspondence_distance=distance,
                max_iterations=_MAX_ITERATIONS,
                num_threads=1,
            )
            T = result.T_target_source
        share = 0.0 if result is None else result.num_inliers / max(1, source.size())
        return _judged(T, share, converged=result is not None and bool(result.converged))

    return run


def _fricp(reference: FloatArray, candidate: FloatArray, _: int) -> PoseResult:
    library = require("fricp_cpp")
    library.set_num_threads(1)
    lengths = Lengths.of(reference)
    fixed, moving = (_open3d_cloud(points, lengths.voxel) for points in (reference, candidate))
    fit = library.registration_icp(moving, fixed, init=np.eye(4), estimation_method="point_to_plane")
    evaluation = library.evaluate_registration(moving, fixed, lengths.max_distances[-1], fit.transformation)
    return _judged(fit.transformation, evaluation.fitness)


def _kiss(reference: FloatArray, candidate: FloatArray, seed: int) -> PoseResult:
    """Run KISS-Matcher with its defaults, then Open3D's point-to-plane ICP."""
    library, o3d = require("kiss_matcher"), require("open3d.pipelines.registration")
    lengths = Lengths.of(reference)
    matcher = library.KISSMatcher(library.KISSMatcherConfig(lengths.feature_voxel))
    solution = matcher.estimate([*candidate.astype(np.float32)], [*reference.astype(np.float32)])
    if matcher.get_num_final_inliers() < _MIN_KISS_INLIERS:
        return PoseResult(None, doubtful=True, codes=(FEW_INLIERS,), message="fewer than 5 inliers")
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = solution.rotation, np.asarray(solution.translation).ravel()
    fixed, moving = (_open3d_cloud(points, lengths.voxel) for points in (reference, candidate))
    plane = o3d.TransformationEstimationPointToPlane()
    result = o3d.registration_icp(moving, fixed, lengths.max_distances[-1], T, plane)
    return _judged(result.transformation, result.fitness)


def _open3d_cloud(points: FloatArray, voxel: float) -> Any:
    geometry, utility = require("open3d.geometry"), require("open3d.utility")
    cloud = geometry.PointCloud(utility.Vector3dVector(points)).voxel_down_sample(voxel)
    cloud.estimate_normals(geometry.KDTreeSearchParamKNN(20))
    return cloud


def _judged(matrix: FloatArray, fitness: float, *, converged: bool = True) -> PoseResult:
    """Return another library's pose, doubtful if it matches too little or has not converged."""
    codes = (*(() if converged else (NOT_CONVERGED,)), *(() if fitness >= _MIN_MATCHED_SHARE else (LOW_FITNESS,)))
    if not np.isfinite(matrix).all():
        return PoseResult(None, doubtful=True, codes=codes, message="the pose is not finite")
    u, _, vt = np.linalg.svd(np.asarray(matrix)[:3, :3])  # some rotations have single precision only
    R = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    return PoseResult(Similarity(R, np.asarray(matrix)[:3, 3]), bool(codes), codes)


_O3D, _SG, _KISS, _FRICP = "open3d", "small_gicp", "kiss-matcher", "fricp-cpp"
METHODS: dict[str, StressMethod[Register]] = by_name(
    StressMethod("icp", _ours("icp"), scope=LOCAL),
    StressMethod("icp-point", _ours("icp-point"), scope=LOCAL, is_quick=False),
    StressMethod("similarity", _ours("similarity"), scope=LOCAL, is_quick=False),
    StressMethod("global", _ours("global"), modules=("kiss_matcher",), scope=GLOBAL),
    StressMethod(
        "global-similarity", _ours("global-similarity"), modules=("kiss_matcher",), scope=GLOBAL, is_quick=False
    ),
    StressMethod("Open3D plane", _open3d_icp("plane"), _O3D, ("open3d",), LOCAL),
    StressMethod("Open3D GICP", _open3d_icp("GICP"), _O3D, ("open3d",), LOCAL, is_quick=False),
    StressMethod("small_gicp plane", _small_gicp("PLANE_ICP"), _SG, ("small_gicp",), LOCAL),
    StressMethod("small_gicp GICP", _small_gicp("GICP"), _SG, ("small_gicp",), LOCAL),
    StressMethod("robust ICP", _fricp, _FRICP, ("fricp_cpp", "open3d"), LOCAL, is_quick=False),
    StressMethod("Open3D FGR", _open3d_features("FGR"), _O3D, ("open3d",), GLOBAL, is_quick=False),
    StressMethod("Open3D RANSAC", _open3d_features("RANSAC"), _O3D, ("open3d",), GLOBAL, is_quick=False),
    StressMethod("KISS-Matcher", _kiss, _KISS, ("kiss_matcher", "open3d"), GLOBAL, is_quick=False),
)
