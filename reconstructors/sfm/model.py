"""What a model of COLMAP holds, in pcbench's types: cameras, a cloud, and how well it fits the images."""

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

Refine = Literal["all", "focal", "distortion", "none"]  # which intrinsics are solved for


def check_written(folder: Path) -> None:
    """Refuse a binary model that COLMAP could not write whole: it ignores a full disk and goes on.

    Raises:
        ReconstructionError: a file is missing or was cut short.
    """
    try:
        for name, read_entry in _ENTRIES.items():
            data = (folder / name).read_bytes()
            (count,) = struct.unpack_from("<Q", data)
            place = 8
            for _ in range(count):
                place = read_entry(data, place)
            if place > len(data):
                raise ValueError("truncated")
    except (OSError, ValueError, struct.error) as error:
        raise not_written(folder) from error


def _end_of_image(data: bytes, place: int) -> int:
    """Number, pose and camera; the name, which ends with a zero; x, y and point of each feature."""
    name_end = data.index(b"\0", place + 64) + 1
    return name_end + 8 + 24 * int(struct.unpack_from("<Q", data, name_end)[0])


def _end_of_point(data: bytes, place: int) -> int:
    """Number, place, colour and error; image and feature of each element of the track."""
    return place + 51 + 8 * int(struct.unpack_from("<Q", data, place + 43)[0])


# Where an entry of a file of a model ends. Every camera is a rig of its own here, and has three parameters at least.
_ENTRIES: dict[str, Callable[[bytes, int], int]] = {
    "cameras.bin": lambda data, place: place + 24 + 8 * 3,
    "images.bin": _end_of_image,
    "points3D.bin": _end_of_point,
    "rigs.bin": lambda data, place: place + 16,
    "frames.bin": lambda data, place: place + 84,
}


def not_written(path: Path) -> ReconstructionError:
    """The error for a file or folder that COLMAP has cut short without a word."""
    return ReconstructionError(
        f"{path.name} could not be written whole: the disk is full or the size of files is limited; make room and run"
        " it again"
    )


def cameras_of(model: Any) -> dict[str, Camera]:
    """The registered cameras by image name, sorted."""
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
    """The points that enough images show, in the order of their numbers, and a note on those left out.

    Raises:
        ReconstructionError: there are none.
    """
    everything = [point for _, point in sorted(model.points3D.items())]
    views = np.array([_views(point) for point in everything], dtype=np.int32)
    points = [point for point, n in zip(everything, views, strict=True) if n >= min_views]
    if not everything:
        raise ReconstructionError(
            "no point is triangulated: no three images show the same from places so far apart that depths can be told"
            " (1.5 degrees): take more images, from different places"
        )
    if not points:
        raise ReconstructionError(
            f"none of {len(everything)} points is shown by {min_views} images: take more images, or --set min_views=2"
        )
    left_out = len(everything) - len(points)
    cloud = Cloud(
        np.array([point.xyz for point in points]),
        colors=np.array([point.color for point in points], dtype=np.uint8),
        attributes={
            "reprojection_error": np.array([point.error for point in points]),
            "track_length": views[views >= min_views],
        },
        unit=unit,
    )
    return cloud, [f"{left_out} points of fewer than {min_views} images are left out"] if left_out else []


def _views(point: Any) -> int:
    """The number of images that show a point: a track may have two features in one image."""
    return len({element.image_id for element in point.track.elements})


def quality(model: Any) -> str:
    """Reprojection error and track length, for a note."""
    error, length = model.compute_mean_reprojection_error(), model.compute_mean_track_length()
    return f"mean reprojection error {error:.3f} px, mean track length {length:.2f}"


def largest_angle_deg(cameras: Mapping[str, Camera]) -> float:
    """Between any camera's direction and the mean of them, in degrees."""
    directions = np.stack([camera.direction for camera in cameras.values()])
    mean = directions.mean(axis=0)
    cosines = directions @ mean / max(float(np.linalg.norm(mean)), 1e-12)
    return float(np.degrees(np.arccos(np.clip(cosines.min(), -1, 1))))
