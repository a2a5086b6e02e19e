"""Read OpenMVS scenes: `.mvs` files in the interface format ("MVSI"), written by OpenMVG and OpenMVS's importers.

After an identifier, a version and a reserved word come platforms (with cameras and poses), images, vertices (with the
images that observe them), their normals and their colours; all little-endian. A list is a count of 8 bytes and its
items. Of the rest (lines, a transform, a box) only the transform is checked. Pixel centres are at integers.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.errors import InputError
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cameras import Camera, Intrinsics, nearest_rotation
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.transform import Similarity
from pcbench.io.files import Fields, Warn, check_readable, errors_named, finite_cloud

_VERSIONS = range(1, 8)
_NO_POSE = 0xFFFFFFFF  # pose index of an image without a pose
_VIEW_SCORE_BYTES, _VIEW_BYTES = 24, 8  # sizes of items that are skipped
_CAMERA_MATRIX_BYTES = 21 * 8  # K, R, C
_MAX_ROTATION_ENTRY = 2.0  # entries of a rotation are at most 1


class OpenMvsScene(NamedTuple):
    """Cameras, named by their images as in the file, and the points of the scene; None if it has none."""

    cameras: tuple[Camera, ...]
    points: Cloud | None


def is_openmvs(path: Path) -> bool:
    """Return whether a file is an OpenMVS scene, by its extension."""
    return path.suffix.lower() == ".mvs"


def read_openmvs(path: Path, size_of: Callable[[str], tuple[int, int] | None], warn: Warn) -> OpenMvsScene:
    """Read the cameras and points of a scene in OpenMVS's interface format.

    Args:
        path: input file.
        size_of: function from an image name to (width, height), or None if there is no such image. It is needed for
            cameras without a size, whose intrinsics are relative to the longer side; their images are left out if they
            do not exist.
        warn: callback, called with one line per warning.

    Raises:
        InputError: the file is not a scene, has an unknown version or is truncated, or a pose is not a rotation. The
            message starts with the path.
    """
    with errors_named(path), np.errstate(all="ignore"):  # damaged numbers become infinite, and are refused
        check_readable(path)
        scene = _Reader(path.read_bytes()).scene(size_of, lambda text: warn(f"{path}: {text}"))
    return scene


class _MountedCamera(NamedTuple):
    """Camera on its platform. Without a size, width and height are 0 and K is relative to the longer side."""

    width: int
    height: int
    k: FloatArray
    rotation: FloatArray
    center: FloatArray

    def intrinsics(self, image: tuple[int, int] | None) -> Intrinsics | None:
        width, height, scale = self.width, self.height, 1.0
        if not (width and height):
            if image is None:
                return None
            width, height, scale = *image, float(max(image))
        k = scale * self.k
        if abs(k[0, 1]) > 1e-6 * k[0, 0]:
            raise InputError("expected intrinsics without skew: undistort the images first")
        return Intrinsics(width, height, k[0, 0], k[1, 1], k[0, 2] + 0.5, k[1, 2] + 0.5)


class _Platform(NamedTuple):
    cameras: list[_MountedCamera]
    poses: list[tuple[FloatArray, FloatArray]]  # rotation world -> platform (3, 3), centre (3,)


class _Image(NamedTuple):
    name: str
    platform: int
    camera: int
    pose: int


@dataclass
class _Reader:
    """Bytes of a file and the current offset."""

    data: bytes
    offset: int = 0
    version: int = 0

    def scene(self, size_of: Callable[[str], tuple[int, int] | None], warn: Warn) -> OpenMvsScene:
        identifier = self.data[:4]
        if identifier[:3] == b"MVS" and identifier != b"MVSI":
            raise InputError(
                "expected OpenMVS's interface format, got an OpenMVS project: save it with --archive-type -1"
            )
        if identifier != b"MVSI":
            raise InputError("expected an OpenMVS scene that starts with MVSI, got another format: export it again")
        self.offset = 4
        self.version, _ = self._take("<II")
        if self.version not in _VERSIONS:
            raise InputError(
                f"expected interface format version 1 to {_VERSIONS[-1]}, got {self.version}: export it again"
            )
        platforms = [self._platform() for _ in self._count(24)]
        images = [self._image() for _ in self._count(20)]
        points = self._points()
        if self._has_transform():
            warn("ignored the transform to other coordinates: cameras and points are read as stored")
        posed = [image for image in images if image.pose != _NO_POSE]
        if not posed:
            raise InputError("expected at least one image with a pose, got none: export the scene again")
        cameras = [camera for image in posed if (camera := _camera(image, platforms, size_of)) is not None]
        if not cameras:
            raise InputError(
                "expected cameras with a size, or their images; got neither, for example for"
                f" {posed[0].name!r}: use the images of these cameras"
            )
        if len(cameras) < len(posed):
            warn(
                f"left out {len(posed) - len(cameras)} of {len(posed)} cameras without a size, whose images are missing"
            )
        return OpenMvsScene(tuple(cameras), finite_cloud(points, warn) if len(points["points"]) else None)

    def _platform(self) -> _Platform:
        self._text()
        cameras = [self._mounted_camera() for _ in self._count(_CAMERA_MATRIX_BYTES)]
        poses = []
        for _ in self._count(12 * 8):
            numbers = np.array(self._take("<12d"))
            poses.append((numbers[:9].reshape(3, 3), numbers[9:]))
        return _Platform(cameras, poses)

    def _mounted_camera(self) -> _MountedCamera:
        self._text()
        if self.version > 3:
            self._text()  # band name
        width, height = self._take("<II")
        numbers = np.array(self._take("<21d"))
        return _MountedCamera(width, height, numbers[:9].reshape(3, 3), numbers[9:18].reshape(3, 3), numbers[18:])

    def _image(self) -> _Image:
        name = self._text()
        if self.version > 4:
            self._text()  # mask name
        image = _Image(name, *self._take("<III"))
        if self.version > 2:
            self._take("<I")
        if self.version > 6:
            self._take("<3f")
            self._skip(len(self._count(_VIEW_SCORE_BYTES)) * _VIEW_SCORE_BYTES)
        return image

    def _points(self) -> Fields:
        count = len(self._count(12 + 8))
        offsets, views = np.empty(count, np.int64), np.empty(count, np.int64)
        for k in range(count):
            offsets[k] = self.offset
            self._skip(12)
            views[k] = len(self._count(_VIEW_BYTES))
            self._skip(int(views[k]) * _VIEW_BYTES)
        columns = np.frombuffer(self.data, np.uint8)[offsets[:, None] + np.arange(12)].reshape(-1, 12)
        xyz = np.ascontiguousarray(columns).view("<f4").astype(np.float64)
        normals, colors = self._array("<f4", 3, count), self._array("u1", 3, count)
        return Fields(
            points=xyz,
            normals=None if normals is None else normals.astype(np.float64),
            colors=None if colors is None else np.ascontiguousarray(colors[:, ::-1]),  # stored as BGR
            attributes={"track_length": views},
        )

    def _array(self, dtype: str, columns: int, rows: int) -> NDArray[np.generic] | None:
        """Read a list of one item per point; return None if it is empty."""
        size = columns * np.dtype(dtype).itemsize
        count = len(self._count(size))
        if count not in (0, rows):
            raise InputError(f"expected {rows} normals and colours, one per point, got {count}: export it again")
        values = np.frombuffer(self.data, dtype, count * columns, self.offset).reshape(count, columns)
        self._skip(count * size)
        return values if count else None

    def _has_transform(self) -> bool:
        """Skip the lines, and return whether the scene has been transformed from other coordinates."""
        if self.version < 2:
            return False
        for _ in self._count(24 + 8):
            self._skip(24)
            self._skip(len(self._count(_VIEW_BYTES)) * _VIEW_BYTES)
        self._skip(len(self._count(12)) * 12)
        self._skip(len(self._count(3)) * 3)
        return not np.array_equal(np.array(self._take("<16d")).reshape(4, 4), np.eye(4))

    def _take(self, code: str) -> tuple[Any, ...]:
        start = self.offset
        self._skip(struct.calcsize(code))
        return struct.unpack_from(code, self.data, start)

    def _text(self) -> str:
        size = len(self._count(1))
        start = self.offset
        self._skip(size)
        try:
            return self.data[start : self.offset].decode()
        except UnicodeDecodeError:
            raise InputError("expected names in UTF-8, got other bytes: copy or export the file again") from None

    def _count(self, item: int) -> range:
        """Read the count of the list that follows, whose items have at least `item` bytes, as a range."""
        (count,) = self._take("<Q")
        if count * item > len(self.data) - self.offset:
            raise InputError(
                f"truncated: expected {count} items of at least {item} bytes from byte {self.offset} on, the file has"
                f" {len(self.data)} bytes: copy or export it again"
            )
        return range(count)

    def _skip(self, size: int) -> None:
        if self.offset + size > len(self.data):
            raise InputError(f"truncated: expected more than {len(self.data)} bytes: copy or export the file again")
        self.offset += size


def _camera(
    image: _Image, platforms: list[_Platform], size_of: Callable[[str], tuple[int, int] | None]
) -> Camera | None:
    """Return the camera of an image, from its camera and pose on a platform; None without a size."""
    with errors_named(f"image {image.name!r}"):
        try:
            platform = platforms[image.platform]
            mounted, (platform_rotation, center) = platform.cameras[image.camera], platform.poses[image.pose]
        except IndexError:
            raise InputError("its platform, camera or pose is not in the file: export it again") from None
        if not (np.abs([mounted.rotation, platform_rotation]) <= _MAX_ROTATION_ENTRY).all():
            raise InputError("expected rotation matrices for platform and camera, got others: export it again")
        intrinsics = mounted.intrinsics(size_of(image.name))
        rotation = nearest_rotation(mounted.rotation @ platform_rotation)
        translation = -rotation @ (platform_rotation.T @ mounted.center + center)
        if not np.isfinite(translation).all():
            raise InputError("expected a finite camera position: export the scene again")
    return None if intrinsics is None else Camera(image.name, intrinsics, Similarity(rotation, translation))
