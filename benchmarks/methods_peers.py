"""Clouds by COLMAP with its own defaults and by OpenCV, as reconstructors: the peers of `methods.py`.

COLMAP's dense stereo needs CUDA; on a processor its path from photographs to a cloud ends with the sparse points.
OpenCV matches pairs of images: each photograph with the one that shares the most of COLMAP's points at a moderate
angle, by semi-global matching (Hirschmuller 2008).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench import Cloud
from pcbench.extras import import_problem
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cameras import Camera
from pcbench.plugins import Reconstruction
from pcbench.scenes import Scene
from reconstructors.sfm.mapping import posed_model
from reconstructors.sfm.model import cameras_of

if TYPE_CHECKING:
    import pycolmap

SGBM_BLOCK_PX = 5
_ANGLES_DEG = 3.0, 30.0  # between the rays of a pair's common points
_MAX_STRETCH = 3.0  # sides of rectified images over the longer side of the photograph
_HALF_PIXEL = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])  # OpenCV counts from the centre of the first pixel
_DEPTH_QUANTILES, _DEPTH_MARGIN = (0.01, 0.99), 1.2  # of COLMAP's points: the range of depths that is searched


@dataclass(frozen=True)
class Colmap:
    """Sparse points of COLMAP, all settings but the number of threads at their defaults.

    poses: `given` triangulates points from the scene's cameras, `solve` solves for cameras and points.
    """

    poses: str = "given"

    @classmethod
    def missing(cls) -> str | None:
        """Return what keeps COLMAP from running on this machine, if anything."""
        return import_problem("pycolmap")

    def reconstruct(self, scene: Scene, workspace: Path) -> Reconstruction:
        """Reconstruct sparse points from photographs at the scene's working size."""
        model = colmap_model(scene, workspace, solve=self.poses == "solve")
        points = np.array([point.xyz for point in model.points3D.values()])
        gauge = "arbitrary" if self.poses == "solve" else "georeferenced"
        return Reconstruction(Cloud(points), gauge, cameras_of(model))


@dataclass(frozen=True)
class OpenCvPairs:
    """Points of OpenCV's semi-global matching in pairs of photographs, of all pairs together.

    Depths whose match in the other image leads elsewhere are left out (`disp12MaxDiff`), as are small regions.
    """

    @classmethod
    def missing(cls) -> str | None:
        """Return what keeps OpenCV or COLMAP from running on this machine, if anything."""
        return import_problem("pycolmap", "cv2")

    def reconstruct(self, scene: Scene, workspace: Path) -> Reconstruction:
        """Match each photograph with its best partner, with the given cameras."""
        import cv2

        cv2.setNumThreads(1)
        model = colmap_model(scene, workspace, solve=False)
        seen = _points_of_images(model)
        clouds = []
        for first in sorted(seen):
            if (second := _partner(first, seen, scene)) is not None:
                common = np.stack([seen[first][point] for point in seen[first].keys() & seen[second].keys()])
                clouds.append(match_pair(scene, first, second, common))
        return Reconstruction(Cloud(np.concatenate(clouds)), "georeferenced", scene.cameras)


def colmap_model(scene: Scene, workspace: Path, *, solve: bool) -> pycolmap.Reconstruction:
    """Return COLMAP's model of a scene: features, exhaustive matches, then mapping or triangulation, one thread."""
    import pycolmap

    pycolmap.logging.minloglevel = pycolmap.logging.Level.ERROR
    images, database, output = workspace / "images", workspace / "database.db", workspace / "sparse"
    output.mkdir(exist_ok=True)
    scene.write_images(images)
    extraction, matching = pycolmap.FeatureExtractionOptions(), pycolmap.FeatureMatchingOptions()
    extraction.num_threads = matching.num_threads = 1
    reader = pycolmap.ImageReaderOptions()
    if not solve:  # COLMAP removes distortion of known cameras where it verifies matches
        camera = next(iter(scene.cameras.values())).intrinsics
        reader.camera_model = "OPENCV"
        reader.camera_params = ",".join(
            map(repr, map(float, (camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion)))
        )
    one = pycolmap.CameraMode.SINGLE
    pycolmap.extract_features(
        database,
        images,
        camera_mode=one,
        reader_options=reader,
        extraction_options=extraction,
        device=pycolmap.Device.cpu,
    )
    pycolmap.match_exhaustive(database, matching_options=matching, device=pycolmap.Device.cpu)
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = 1
    if solve:
        models = pycolmap.incremental_mapping(database, images, output, options)
        return max(models.values(), key=lambda model: model.num_reg_images())
    return pycolmap.triangulate_points(posed_model(database, scene), database, images, output, options=options)


class RectifiedPair(NamedTuple):
    """Two images whose rows are epipolar lines, as if taken by parallel cameras side by side.

    Attributes:
        images: grey values of both, with the same number of rows.
        rotation: (3, 3), from the world to the common frame of the two cameras; x is the direction of the baseline.
        position: (3,), of the first camera.
        focal, baseline: focal length in pixels, and distance between the cameras.
        centers: principal points, columns of the first and the second image, and the common row.
    """

    images: tuple[NDArray[np.uint8], NDArray[np.uint8]]
    rotation: FloatArray
    position: FloatArray
    focal: float
    baseline: float
    centers: tuple[float, float, float]

    @property
    def offset(self) -> float:
        """Disparity of a point at infinity, in pixels."""
        return self.centers[0] - self.centers[1]


def match_pair(scene: Scene, first: str, second: str, common: FloatArray) -> FloatArray:
    """Return the points (N, 3) of semi-global matching, at depths around those of common points (M, 3)."""
    import cv2

    pair = rectify(scene, first, second)
    depths = (common - pair.position) @ pair.rotation[2]
    near, far = np.quantile(depths, _DEPTH_QUANTILES) * [1 / _DEPTH_MARGIN, _DEPTH_MARGIN]
    lowest = int(np.floor(pair.focal * pair.baseline / far + pair.offset))
    highest = int(np.ceil(pair.focal * pair.baseline / near + pair.offset))
    matcher = cv2.StereoSGBM_create(
        minDisparity=lowest,
        numDisparities=-(-(highest - lowest) // 16) * 16,
        blockSize=SGBM_BLOCK_PX,
        P1=8 * SGBM_BLOCK_PX**2,
        P2=32 * SGBM_BLOCK_PX**2,
        disp12MaxDiff=1,
        preFilterCap=63,
        uniquenessRatio=10,
        speckleWindowSize=100,
        speckleRange=32,
    )
    disparity = matcher.compute(*pair.images).astype(np.float64) / 16
    rows, columns = np.nonzero((disparity >= lowest) & (pair.images[0] > 0))
    depth = pair.focal * pair.baseline / (disparity[rows, columns] - pair.offset)
    searched = (near <= depth) & (depth <= far)  # the range of disparities is a multiple of 16
    rows, columns, depth = rows[searched], columns[searched], depth[searched]
    x, _, y = pair.centers
    rays = np.column_stack([(columns + 0.5 - x) / pair.focal, (rows + 0.5 - y) / pair.focal, np.ones(len(rows))])
    return pair.position + (rays * depth[:, None]) @ pair.rotation


def rectify(scene: Scene, first: str, second: str) -> RectifiedPair:
    """Resample two images so that they look in the same direction, at right angles to their baseline."""
    import cv2

    cameras = scene.cameras[first], scene.cameras[second]
    baseline = cameras[1].position - cameras[0].position
    rotation, focal, borders = _common_frame(cameras)
    top = np.floor(min(border[:, 1].min() for border in borders))
    height = int(np.ceil(max(border[:, 1].max() for border in borders)) - top)
    images, columns = [], []
    for name, camera, border in zip((first, second), cameras, borders, strict=True):
        left = np.floor(border[:, 0].min())
        size = int(np.ceil(border[:, 0].max()) - left), height
        matrix = np.array([[focal, 0, -left], [0, focal, -top], [0, 0, 1]])
        lens = camera.intrinsics
        maps = cv2.initUndistortRectifyMap(
            lens.matrix - _HALF_PIXEL,
            np.array(lens.distortion),
            rotation @ camera.cam_from_world.rotation.T,
            matrix - _HALF_PIXEL,
            size,
            cv2.CV_32FC1,
        )
        gray = cv2.cvtColor(scene.read_image(name), cv2.COLOR_RGB2GRAY)
        images.append(cv2.remap(np.maximum(gray, 1), *maps, cv2.INTER_LINEAR))  # 0 is outside of the image
        columns.append(float(-left))
    width = max(image.shape[1] for image in images)
    first_image, second_image = (np.pad(image, ((0, 0), (0, width - image.shape[1]))) for image in images)
    centers = columns[0], columns[1], float(-top)
    return RectifiedPair(
        (first_image, second_image), rotation, cameras[0].position, focal, float(np.linalg.norm(baseline)), centers
    )


def _common_frame(cameras: Sequence[Camera]) -> tuple[FloatArray, float, list[FloatArray]]:
    """Return the frame of two rectified images: rotation (3, 3), focal length and borders in pixels."""
    x = cameras[1].position - cameras[0].position
    x = x / np.linalg.norm(x)
    z = cameras[0].direction + cameras[1].direction
    z = z - x * (x @ z)
    z /= np.linalg.norm(z)
    rotation = np.stack([x, np.cross(z, x), z])
    focal = float(np.mean([camera.intrinsics.fx for camera in cameras]))
    return rotation, focal, [focal * _border(camera, rotation) for camera in cameras]


def _border(camera: Camera, rotation: FloatArray) -> FloatArray:
    """Return the border of an image (N, 2) at depth 1 in a rotated frame; infinite where it is behind the plane."""
    rays = np.column_stack([camera.intrinsics.border, np.ones(len(camera.intrinsics.border))])
    x, y, depth = rotation @ camera.cam_from_world.rotation.T @ rays.T
    return np.stack([x, y], axis=1) / np.where(depth > 0, depth, 0.0)[:, None]


def _can_be_rectified(cameras: Sequence[Camera]) -> bool:
    """Return whether rectified images are not much larger: not for cameras of which one is before the other."""
    with np.errstate(divide="ignore", invalid="ignore"):
        borders = _common_frame(cameras)[2]
        sizes = [np.ptp(border, axis=0).max() for border in borders]
    return all(
        size <= _MAX_STRETCH * max(camera.intrinsics.width, camera.intrinsics.height)
        for size, camera in zip(sizes, cameras, strict=True)
    )


def _points_of_images(model: pycolmap.Reconstruction) -> dict[str, dict[int, FloatArray]]:
    """Return the points (3,) that each image sees, by their ids."""
    names = {number: str(image.name) for number, image in model.images.items()}
    seen: dict[str, dict[int, FloatArray]] = {name: {} for name in names.values()}
    for number, point in model.points3D.items():
        for element in point.track.elements:
            seen[names[element.image_id]][number] = np.array(point.xyz)
    return seen


def _partner(first: str, seen: dict[str, dict[int, FloatArray]], scene: Scene) -> str | None:
    """Return the image with the most common points seen from moderately different directions; None if there is none.

    Pairs that look along their baseline are left out, because they cannot be rectified.
    """
    counts = {}
    for second in seen:
        shared = seen[first].keys() & seen[second].keys()
        if second == first or not shared or not _can_be_rectified([scene.cameras[first], scene.cameras[second]]):
            continue
        points = np.stack([seen[first][number] for number in shared])
        rays = [points - scene.cameras[name].position for name in (first, second)]
        cosines = np.einsum("ni,ni->n", *(ray / np.linalg.norm(ray, axis=1, keepdims=True) for ray in rays))
        if _ANGLES_DEG[0] <= np.degrees(np.arccos(np.clip(np.median(cosines), -1, 1))) <= _ANGLES_DEG[1]:
            counts[second] = len(shared)
    return max(counts, key=lambda name: counts[name], default=None)
