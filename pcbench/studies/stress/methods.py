"""Registration methods behind one call: ours, and those of other libraries if they are installed.

Other libraries run coarse to fine with the parameters of their examples, scaled to the scene: voxels of one spacing of
the reference, and maximum correspondence distances of 10, 3 and 1 % of the extent. They report no doubt: a
result counts as doubtful if it has not converged, or matches less than 30 % of the candidate (KISS-Matcher: fewer than
5 inliers, the rule of its example).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any

import numpy as np

from pcbench.errors import InputError, RegistrationError
from pcbench.extras import LIBRARIES, installed_versions, require
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.neighbors import Index
from pcbench.geometry.sampling import median_spacing
from pcbench.geometry.transform import Similarity
from pcbench.registration import register
from pcbench.studies.stress.results import GLOBAL, LOCAL, REGISTRATION, MethodInfo, MissingMethod
from pcbench.studies.stress.scenes import extent_of

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
class RegistrationMethod:
    """A registration method of the study.

    Attributes:
        name: name in cells, tables and charts.
        scope: `local` or `global`.
        modules: modules that it needs; none for ours.
        quick: whether it is fast enough for the quick plan.
        run: function of reference (N, 3), candidate (M, 3) and seed.
    """

    name: str
    scope: str
    modules: tuple[str, ...]
    quick: bool
    run: Register
    library: str = "pcbench"

    def info(self) -> MethodInfo:
        """Return the description for results."""
        version = installed_versions([self.library]).get(self.library, "")
        return MethodInfo(self.name, REGISTRATION, self.scope, self.library, version)

    def missing(self) -> MissingMethod | None:
        """Return why the method cannot run, or None if its libraries are installed."""
        return missing_method(self.name, self.modules)


def missing_method(name: str, modules: Iterable[str]) -> MissingMethod | None:
    """Return a method with the first of its modules that is not installed, or None if all are."""
    for module in modules:
        if find_spec(module) is None:
            library = LIBRARIES[module]
            install = f"'pcbench[{library.extra}]'" if library.extra else library.name
            return MissingMethod(name, f"{library.name} is not installed: pip install {install}")
    return None


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
            found = register(reference, candidate, method)
        except RegistrationError as error:
            return PoseResult(None, doubtful=True, message=" ".join(str(error).split()))
        codes = tuple(notice.code for notice in found.warnings)
        return PoseResult(found.T_reference_candidate, found.doubtful, codes)

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
        found = o3d.registration_fgr_based_on_feature_matching(*clouds, *features, options)
    else:
        checkers = [
            o3d.CorrespondenceCheckerBasedOnEdgeLength(0.9),
            o3d.CorrespondenceCheckerBasedOnDistance(1.5 * v),
        ]
        found = o3d.registration_ransac_based_on_feature_matching(
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
    result = o3d.registration_icp(moving, fixed, lengths.max_distances[-1], found.transformation, plane)
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
    found = library.registration_icp(moving, fixed, init=np.eye(4), estimation_method="point_to_plane")
    evaluation = library.evaluate_registration(moving, fixed, lengths.max_distances[-1], found.transformation)
    return _judged(found.transformation, evaluation.fitness)


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
METHODS = {
    method.name: method
    for method in (
        RegistrationMethod("icp", LOCAL, (), True, _ours("icp")),
        RegistrationMethod("icp-point", LOCAL, (), False, _ours("icp-point")),
        RegistrationMethod("similarity", LOCAL, (), False, _ours("similarity")),
        RegistrationMethod("global", GLOBAL, ("kiss_matcher",), True, _ours("global")),
        RegistrationMethod("global-similarity", GLOBAL, ("kiss_matcher",), False, _ours("global-similarity")),
        RegistrationMethod("Open3D plane", LOCAL, ("open3d",), True, _open3d_icp("plane"), _O3D),
        RegistrationMethod("Open3D GICP", LOCAL, ("open3d",), False, _open3d_icp("GICP"), _O3D),
        RegistrationMethod("small_gicp plane", LOCAL, ("small_gicp",), True, _small_gicp("PLANE_ICP"), _SG),
        RegistrationMethod("small_gicp GICP", LOCAL, ("small_gicp",), True, _small_gicp("GICP"), _SG),
        RegistrationMethod("robust ICP", LOCAL, ("fricp_cpp", "open3d"), False, _fricp, _FRICP),
        RegistrationMethod("Open3D FGR", GLOBAL, ("open3d",), False, _open3d_features("FGR"), _O3D),
        RegistrationMethod("Open3D RANSAC", GLOBAL, ("open3d",), False, _open3d_features("RANSAC"), _O3D),
        RegistrationMethod("KISS-Matcher", GLOBAL, ("kiss_matcher", "open3d"), False, _kiss, _KISS),
    )
}


def check_names(names: Iterable[str], known: Iterable[str]) -> None:
    """Check the names of methods.

    Raises:
        InputError: a name is not known.
    """
    available = tuple(known)
    if unknown := [name for name in names if name not in available]:
        raise InputError(f"unknown method {unknown[0]!r}: expected one of {', '.join(available)}")
