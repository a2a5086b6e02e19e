"""Converts a COLMAP model to pcbench's types: cameras, a cloud, and its quality."""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np

from pcbench.errors import ReconstructionError
from pcbench.geometry.cameras import Camera
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.transform import Similarity
from pcbench.io.colmap_model import intrinsics_from_colmap
from reconstructors.sfm.features import NoPointsError

Refine = Literal["all", "focal", "distortion", "none"]  # intrinsics to solve for


def check_written(folder: Path) -> None:
    """Check that a binary model was written completely: COLMAP ignores a full disk.

    Args:
        folder: Folder of the model.

    Raises:
        ReconstructionError: A file is missing or truncated.
    """
    try:
        for name, read_entry in _ENTRY_ENDS.items():
            data = (folder / name).read_bytes()
            (count,) = struct.unpack_from("<Q", data)
            offset = 8
            for _ in range(count):
                offset = read_entry(data, offset)
            if offset > len(data):
                raise ValueError("truncated")
    except (OSError, ValueError, struct.error) as error:
        raise truncated_output_error(folder) from error


def _end_of_image(data: bytes, offset: int) -> int:
    """Return the end of an image: id, pose and camera; zero-terminated name; x, y and point of each feature."""
    name_end = data.index(b"\0", offset + 64) + 1
    return name_end + 8 + 24 * int(struct.unpack_from("<Q", data, name_end)[0])


def _end_of_point(data: bytes, offset: int) -> int:
    """Return the end of a point: id, position, colour and error; image and feature of each track element."""
    return offset + 51 + 8 * int(struct.unpack_from("<Q", data, offset + 43)[0])


# End of an entry of each file of a model. Each camera is its own rig here, and has at least three parameters.
_ENTRY_ENDS: dict[str, Callable[[bytes, int], int]] = {
    "cameras.bin": lambda data, offset: offset + 24 + 8 * 3,
    "images.bin": _end_of_image,
    "points3D.bin": _end_of_point,
    "rigs.bin": lambda data, offset: offset + 16,
    "frames.bin": lambda data, offset: offset + 84,
}


def truncated_output_error(path: Path) -> ReconstructionError:
    """Return the error for a file or folder that COLMAP truncated without an error."""
    return ReconstructionError(
        f"{path.name} could not be written completely: the disk is full or the file size is limited; free some space"
        " and run it again"
    )


def cameras_of(model: Any) -> dict[str, Camera]:
    """Return the registered cameras by image name, sorted."""
    cameras = {}
    for image in sorted(model.images.values(), key=lambda image: str(image.name)):
        if image.has_pose:
            camera, pose = model.cameras[image.camera_id], image.cam_from_world()
            intrinsics = intrinsics_from_colmap(
                camera.model_name, camera.width, camera.height, [float(v) for v in camera.params]
            )
            motion = Similarity(pose.rotation.matrix(), np.array(pose.translation))
            cameras[str(image.name)] = Camera(str(image.name), intrinsics, motion)
    return cameras


def cloud_of(model: Any, min_views: int, unit: str | None) -> tuple[Cloud, list[str]]:
    """Return the points observed by at least `min_views` images, in the order of their ids, and a note on the others.

    Args:
        model: pycolmap.Reconstruction.
        min_views: Minimum number of images per point.
        unit: Unit of the coordinates.

    Raises:
        NoPointsError: There are no such points.
    """
    all_points = [point for _, point in sorted(model.points3D.items())]
    views = np.array([_view_count(point) for point in all_points], dtype=np.int32)
    points = [point for point, n in zip(all_points, views, strict=True) if n >= min_views]
    if not all_points:
        raise NoPointsError(
            "no point is triangulated: no three images show the same place from positions that are far enough apart"
            " (1.5 degrees): take more images, from different positions"
        )
    if not points:
        raise NoPointsError(
            f"none of {len(all_points)} points is observed by {min_views} images: take more images, or use --set"
            " min_views=2"
        )
    left_out = len(all_points) - len(points)
    cloud = Cloud(
        np.array([point.xyz for point in points]),
        colors=np.array([point.color for point in points], dtype=np.uint8),
        attributes={
            "reprojection_error": np.array([point.error for point in points]),
            "track_length": views[views >= min_views],
        },
        unit=unit,
    )
    return cloud, [f"{left_out} points observed by fewer than {min_views} images are left out"] if left_out else []


def _view_count(point: Any) -> int:
    """Return the number of images that observe a point; a track may have two features in one image."""
    return len({element.image_id for element in point.track.elements})


def quality(model: Any) -> str:
    """Return reprojection error and track length for a note."""
    error, length = model.compute_mean_reprojection_error(), model.compute_mean_track_length()
    return f"mean reprojection error {error:.3f} px, mean track length {length:.2f}"


def largest_angle_deg(cameras: Mapping[str, Camera]) -> float:
    """Return the largest angle between a camera's viewing direction and the mean of all, in degrees."""
    directions = np.stack([camera.direction for camera in cameras.values()])
    mean = directions.mean(axis=0)
    cosines = directions @ mean / max(float(np.linalg.norm(mean)), 1e-12)
    return float(np.degrees(np.arccos(np.clip(cosines.min(), -1, 1))))
