"""Registration methods to compare: ours, and those of other libraries if they are installed."""

import importlib.util
import os
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from pcbench import register
from pcbench.errors import RegistrationError
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.transform import Similarity
from pcbench.studies.stress.methods import Lengths, open3d_features

MAX_DISTANCES = (20.0, 6.0, 2.0)
VOXEL, FEATURE_VOXEL = 0.5, 2.0
MIN_MATCHED_SHARE = 0.3  # of the candidate, for a peer's result to count as confident


class MethodResult(NamedTuple):
    """Result of a method: a transform candidate -> reference, and whether the method is confident in it."""

    transform: Similarity | None
    confident: bool


Method = Callable[[FloatArray, FloatArray], MethodResult]


def pcbench_method(method: str) -> Method:
    """Return one of our methods."""

    def run(reference: FloatArray, candidate: FloatArray) -> MethodResult:
        try:
            result = register(reference, candidate, method)
        except RegistrationError:
            return MethodResult(None, False)
        return MethodResult(result.T_reference_candidate, result.converged is True and not result.warnings)

    return run


def open3d_method(kind: str) -> Method:
    """Return one of Open3D's ICP variants, coarse to fine."""
    from open3d import geometry, utility
    from open3d.pipelines import registration as o3d

    def run(reference: FloatArray, candidate: FloatArray) -> MethodResult:
        clouds = []
        for points in (reference, candidate):
            cloud = geometry.PointCloud(utility.Vector3dVector(points)).voxel_down_sample(VOXEL)
            cloud.estimate_normals(geometry.KDTreeSearchParamKNN(20))
            clouds.append(cloud)
        T, fitness = np.eye(4), 0.0
        for max_distance in MAX_DISTANCES:
            criteria = o3d.ICPConvergenceCriteria(max_iteration=60)
            if kind == "GICP":
                estimator = o3d.TransformationEstimationForGeneralizedICP()
                result = o3d.registration_generalized_icp(clouds[1], clouds[0], max_distance, T, estimator, criteria)
            else:
                # A robust kernel from the start would keep only what fits already, so the last distance alone has it.
                robust = kind == "Tukey" and max_distance == MAX_DISTANCES[-1]
                estimator = o3d.TransformationEstimationPointToPlane(*([o3d.TukeyLoss(0.3)] if robust else []))
                result = o3d.registration_icp(clouds[1], clouds[0], max_distance, T, estimator, criteria)
            T, fitness = result.transformation, result.fitness
        return MethodResult(_rigid(T), fitness >= MIN_MATCHED_SHARE)

    return run


def small_gicp_method(kind: str) -> Method:
    """Return one of small_gicp's methods, coarse to fine."""
    import small_gicp

    def run(reference: FloatArray, candidate: FloatArray) -> MethodResult:
        threads = len(os.sched_getaffinity(0))
        target, tree = small_gicp.preprocess_points(reference, VOXEL, num_threads=threads)
        source, _ = small_gicp.preprocess_points(candidate, VOXEL, num_threads=threads)
        T, result = np.eye(4), None
        for max_distance in MAX_DISTANCES:
            options = {"init_T_target_source": T, "max_correspondence_distance": max_distance, "num_threads": threads}
            if kind == "VGICP":
                voxels = small_gicp.GaussianVoxelMap(max_distance / 2)
                voxels.insert(target)
                result = small_gicp.align(voxels, source, init_T_target_source=T, num_threads=threads)
            else:
                result = small_gicp.align(target, source, tree, registration_type=kind, max_iterations=60, **options)
            T = result.T_target_source
        return MethodResult(
            _rigid(T), bool(result.converged) and result.num_inliers >= MIN_MATCHED_SHARE * source.size()
        )

    return run


def register_with_kiss(reference: FloatArray, candidate: FloatArray) -> MethodResult:
    """Run KISS-Matcher with its defaults, then our ICP."""
    import kiss_matcher

    matcher = kiss_matcher.KISSMatcher(kiss_matcher.KISSMatcherConfig(FEATURE_VOXEL))
    with _no_output():
        solution = matcher.estimate([*candidate.astype(np.float32)], [*reference.astype(np.float32)])
    if matcher.get_num_final_inliers() < 5:
        return MethodResult(None, False)
    initial_transform = _rigid(_matrix(solution.rotation, solution.translation))
    refined = pcbench_method("icp")(reference, initial_transform.apply(candidate))
    return MethodResult(None if refined.transform is None else refined.transform @ initial_transform, refined.confident)


def feature_method(solver: str) -> Method:
    """Return Open3D's FPFH with RANSAC or FGR and the parameters of its tutorial, then its point-to-plane ICP."""

    def run(reference: FloatArray, candidate: FloatArray) -> MethodResult:
        result = open3d_features(reference, candidate, solver, 0, Lengths(VOXEL, FEATURE_VOXEL, MAX_DISTANCES))
        return MethodResult(result.T_reference_candidate, not result.doubtful)

    return run


def refinements() -> dict[str, Method]:
    """Return the methods that refine an initial pose."""
    methods = {name: pcbench_method(name) for name in ("icp", "icp-point", "similarity")}
    if importlib.util.find_spec("open3d"):
        methods |= {
            "Open3D plane": open3d_method("plane"),
            "Open3D plane, Tukey": open3d_method("Tukey"),
            "Open3D GICP": open3d_method("GICP"),
        }
    if importlib.util.find_spec("small_gicp"):
        methods |= {
            "small_gicp plane": small_gicp_method("PLANE_ICP"),
            "small_gicp GICP": small_gicp_method("GICP"),
            "small_gicp VGICP": small_gicp_method("VGICP"),
        }
    return methods


def global_methods() -> dict[str, Method]:
    """Return the methods that need no initial pose."""
    methods = {name: pcbench_method(name) for name in ("global", "global-similarity")}
    if importlib.util.find_spec("kiss_matcher"):
        methods["KISS-Matcher, our ICP"] = register_with_kiss
    if importlib.util.find_spec("open3d"):
        methods |= {"Open3D FPFH, RANSAC": feature_method("RANSAC"), "Open3D FPFH, FGR": feature_method("FGR")}
    return methods


def _matrix(rotation: FloatArray, translation: FloatArray) -> FloatArray:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, np.asarray(translation).ravel()
    return matrix


def _rigid(matrix: FloatArray) -> Similarity:
    u, _, vt = np.linalg.svd(np.asarray(matrix)[:3, :3])  # some rotations have single precision only
    return Similarity(u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt, np.asarray(matrix)[:3, 3])


class _no_output:
    """Silences the process's standard output, which KISS-Matcher writes to."""

    def __enter__(self) -> None:
        self.stdout, null = os.dup(1), os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, 1)
        os.close(null)

    def __exit__(self, *error: object) -> None:
        os.dup2(self.stdout, 1)
        os.close(self.stdout)
