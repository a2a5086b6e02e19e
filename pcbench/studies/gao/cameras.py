"""Errors of solved cameras, and the deformation of the surface that they cause by themselves."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from pcbench.errors import InputError
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cameras import Camera
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.transform import robust_similarity
from pcbench.geometry.visibility import MIN_VISIBLE_VIEWS, in_frame
from pcbench.studies.gao.results import CameraErrors, SurfaceDeformation

_MAX_SURFACE_POINTS = 20_000  # sample of the surface whose deformation is computed
_MIN_EIGENVALUE_RATIO = 1e-4  # smallest to largest; below, the rays are too parallel to fix a point
_MIN_SURFACE_POINTS = 100
_ROUNDING_SHARE = 1e-6  # of the scene's extent; smaller position errors are rounding
_SAME_FRAME_SHARE = 0.1  # of the cameras' extent; larger median distances mean another frame
_OUTLIER_RATIO = 10.0  # to the median error; cameras with a larger error are outliers
_PROFILE_BINS = 8


def camera_errors(
    solved: Mapping[str, Camera], true: Mapping[str, Camera], surface: Cloud | None
) -> CameraErrors | None:
    """Measure the errors of solved cameras, matched by name.

    Returns None if fewer than three cameras are in both, or if they lie on a line.

    Args:
        solved: solved cameras by image name.
        true: true cameras by image name.
        surface: surface that they observe, optionally with normals; None skips its deformation.
    """
    names = sorted(set(solved) & set(true))
    if len(names) < 3:
        return None
    solved_positions = np.stack([solved[name].position for name in names])
    true_positions = np.stack([true[name].position for name in names])
    try:
        errors = np.linalg.norm(
            robust_similarity(solved_positions, true_positions).apply(solved_positions) - true_positions, axis=1
        )
    except InputError:
        return None
    focal = [solved[name].intrinsics.fx / true[name].intrinsics.fx for name in names]
    near = errors <= max(_OUTLIER_RATIO * float(np.median(errors)), _ROUNDING_SHARE * float(np.ptp(true_positions)))
    # An outlier agrees with no other camera: it contributes few points, which no method accepts.
    kept = {name: solved[name] for name, agrees in zip(names, near, strict=True) if agrees}
    return CameraErrors(
        solved=len(names),
        given=len(true),
        median=float(np.median(errors)),
        largest=float(errors.max()),
        focal_ratio=float(np.median(focal)),
        astray=len(names) - len(kept),
        surface=None if surface is None else camera_deformation(kept, true, surface),
    )


def cameras_in_cloud_frame(solved: Mapping[str, Camera], given: Mapping[str, Camera]) -> Mapping[str, Camera]:
    """Return the cameras that describe the scene in the frame of its clouds.

    These are the given ones if the solved ones are in the same frame, because solved cameras may have outliers, or if
    nothing was solved.
    """
    names = sorted(set(solved) & set(given))
    if not names:
        return solved or given
    given_positions = np.stack([given[name].position for name in names])
    distances = np.linalg.norm(np.stack([solved[name].position for name in names]) - given_positions, axis=1)
    return given if np.median(distances) < _SAME_FRAME_SHARE * float(np.ptp(given_positions, axis=0).max()) else solved


def camera_deformation(
    solved: Mapping[str, Camera], true: Mapping[str, Camera], surface: Cloud
) -> SurfaceDeformation | None:
    """Measure how solved cameras alone deform a surface, without matching errors and noise.

    Each point is projected with the true cameras and triangulated with the solved ones. Returns None if too few points
    are visible. Without normals, all three components of the displacement count.
    """
    rng = np.random.default_rng(0)
    sample = np.sort(rng.permutation(len(surface))[:_MAX_SURFACE_POINTS])
    points = surface.points[sample]
    triangulated, fixed = retriangulate(solved, true, points)
    if fixed.sum() < _MIN_SURFACE_POINTS:
        return None
    points, moved = points[fixed], (triangulated - points)[fixed]
    x, u = points - points.mean(axis=0), moved
    if surface.normals is None:
        x, u, n = np.repeat(x, 3, axis=0), np.repeat(u, 3, axis=0), np.tile(np.eye(3), (len(x), 1))
    else:
        n = surface.normals[sample][fixed]
    along = np.einsum("ni,ni->n", n, u)
    scale = float(np.abs(x).max()) or 1.0
    rigid = np.hstack([n, np.cross(x / scale, n)])  # n . (t + w x p) = n . t + w . (p x n)
    affine = np.hstack([n, (n[:, :, None] * x[:, None, :] / scale).reshape(len(n), 9)])
    motion = np.linalg.lstsq(rigid, along, rcond=None)[0]
    off = points - points.mean(axis=0)
    rise = (moved - motion[:3] - np.cross(motion[3:], off / scale))[:, 2]
    return SurfaceDeformation(
        moved=_rms(along - rigid @ motion),
        bent=_rms(along - affine @ np.linalg.lstsq(affine, along, rcond=None)[0]),
        with_distance=_profile(np.hypot(off[:, 0], off[:, 1]), rise),
        with_height=_profile(points[:, 2] - points[:, 2].min(), rise),
    )


def retriangulate(
    solved: Mapping[str, Camera], true: Mapping[str, Camera], points: FloatArray
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Project points (N, 3) with true cameras and triangulate the pixels with solved ones. Occlusion is ignored.

    Each triangulated point minimises the squared distances to its rays, weighted by inverse squared depth, which is
    close to the minimum of the reprojection errors.

    Returns:
        The triangulated points (N, 3), and whether each (N,) is fixed by at least three cameras.
    """
    matrix, vector = np.zeros((len(points), 3, 3)), np.zeros((len(points), 3))
    count = np.zeros(len(points), dtype=np.int64)
    for name in sorted(set(solved) & set(true)):
        rows = np.flatnonzero(in_frame(true[name], points))
        pixels, depths = true[name].project(points[rows])
        camera = solved[name]
        rays = camera.intrinsics.directions(pixels) @ camera.cam_from_world.rotation
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        across = (np.eye(3) - rays[:, :, None] * rays[:, None, :]) / np.square(depths)[:, None, None]
        matrix[rows] += across
        vector[rows] += across @ camera.position
        count[rows] += 1
    fixed = count >= MIN_VISIBLE_VIEWS
    smallest, largest = np.linalg.eigvalsh(matrix)[:, [0, 2]].T
    fixed &= smallest > _MIN_EIGENVALUE_RATIO * largest
    triangulated = points.copy()
    triangulated[fixed] = np.linalg.solve(matrix[fixed], vector[fixed][:, :, None])[:, :, 0]
    return triangulated, fixed


def _profile(along: FloatArray, values: FloatArray) -> tuple[tuple[float, float], ...]:
    """Return mean position and mean value in bins of equal counts (N,)."""
    bins = np.array_split(np.argsort(along, kind="stable"), _PROFILE_BINS)
    return tuple((float(along[rows].mean()), float(values[rows].mean())) for rows in bins)


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
