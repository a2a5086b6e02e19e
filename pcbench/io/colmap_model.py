"""Cameras of a COLMAP sparse model: cameras and images, text or binary. Formats: colmap.github.io/format.html.

Its points are read by `pcbench.io.colmap`. Rigs and frames of newer models are not needed: every image has its pose.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from pcbench.errors import InputError
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cameras import Camera, Intrinsics
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.transform import Similarity
from pcbench.io.files import atomic_write
from pcbench.regular_files import has_entry, open_regular, read_bytes

# Name and number of parameters, by COLMAP's number of the model.
_MODELS = {
    0: ("SIMPLE_PINHOLE", 3),
    1: ("PINHOLE", 4),
    2: ("SIMPLE_RADIAL", 4),
    3: ("RADIAL", 5),
    4: ("OPENCV", 8),
}
_PARAMETERS = dict(_MODELS.values())


_MAX_MODEL_BYTES = 64 << 30  # of cameras or images, which hold every keypoint

MODEL_FILES = ("cameras.txt", "images.txt", "points3D.txt")  # that are written


def is_colmap_model(folder: Path) -> bool:
    """Whether a folder holds the cameras and images of a model, in text or binary."""
    return any(has_entry(folder / f"cameras{e}") and has_entry(folder / f"images{e}") for e in (".bin", ".txt"))


def read_colmap_cameras(folder: Path) -> tuple[Camera, ...]:
    """The cameras of the images of a COLMAP model, in the order of their names; binary files go before text.

    Raises:
        InputError: there is no model, it is damaged, a camera model is not supported, or a quaternion is no rotation;
            the message starts with the path.
    """
    binary = has_entry(folder / "cameras.bin") and has_entry(folder / "images.bin")
    names = ("cameras.bin", "images.bin") if binary else ("cameras.txt", "images.txt")
    intrinsics: dict[int, Intrinsics] = {}
    for name in names:
        path = folder / name
        try:
            data = read_bytes(path, _MAX_MODEL_BYTES)
            if name.startswith("cameras"):
                intrinsics = _binary_intrinsics(data) if binary else _text_intrinsics(data)
            else:
                cameras = _binary_images(data, intrinsics) if binary else _text_images(data, intrinsics)
        except FileNotFoundError:
            raise InputError(f"{path}: no such file: expected a COLMAP model (cameras and images)") from None
        except OSError as error:
            raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
        except InputError as error:
            raise InputError(f"{path}: {error}") from None
        except (ValueError, OverflowError) as error:
            raise InputError(f"{path}: expected a COLMAP model: {error}") from None
        except struct.error:
            raise InputError(f"{path}: truncated: copy or export the model again") from None
    if not cameras:
        raise InputError(f"{path}: expected at least one image, got a model without images")
    return tuple(sorted(cameras, key=lambda camera: camera.name))


def intrinsics_from_colmap(model: str, width: int, height: int, p: Sequence[float]) -> Intrinsics:
    """The intrinsics that a COLMAP camera's model and parameters mean.

    Raises:
        InputError: the model is none of those that `Intrinsics` holds, or the parameters are not as many as it has.
    """
    if model not in _PARAMETERS:
        known = ", ".join(_PARAMETERS)
        raise InputError(f"camera model {model} is not supported (only {known}): run COLMAP's image_undistorter first")
    if len(p) != _PARAMETERS[model]:
        raise InputError(f"expected {_PARAMETERS[model]} parameters of {model}, got {len(p)}")
    if model == "PINHOLE":
        return Intrinsics(width, height, p[0], p[1], p[2], p[3])
    if model == "OPENCV":
        return Intrinsics(width, height, p[0], p[1], p[2], p[3], (p[4], p[5], p[6], p[7]))
    k1, k2 = [*p[3:], 0.0, 0.0][:2]
    return Intrinsics(width, height, p[0], p[0], p[1], p[2], (k1, k2, 0.0, 0.0))


def _camera(name: str, number: int, pose: Sequence[float], intrinsics: Mapping[int, Intrinsics]) -> Camera:
    if number not in intrinsics:
        raise InputError(f"image {name} has camera {number}, which is not in the file of cameras")
    quaternion = np.array(pose[:4], dtype=np.float64)
    length = float(np.linalg.norm(quaternion))
    if not abs(length - 1) < 1e-3:
        raise InputError(f"image {name}: expected a rotation as a unit quaternion, got one of length {length:.6g}")
    return Camera(name, intrinsics[number], Similarity(_rotation(quaternion / length), np.array(pose[4:])))


def _text_intrinsics(data: bytes) -> dict[int, Intrinsics]:
    intrinsics = {}
    for line in data.decode().splitlines():
        words = line.split()
        if words and not words[0].startswith("#"):
            if len(words) < 5:
                raise ValueError(f"expected id, model, width, height, parameters; got {line.strip()[:60]!r}")
            values = [float(word) for word in words[4:]]
            intrinsics[int(words[0])] = intrinsics_from_colmap(words[1], int(words[2]), int(words[3]), values)
    return intrinsics


def _text_images(data: bytes, intrinsics: Mapping[int, Intrinsics]) -> list[Camera]:
    """Two lines an image: id, quaternion, translation, camera, name; then x, y, point triples, perhaps none."""
    cameras = []
    lines = iter(data.decode().splitlines())
    for line in lines:
        words = line.split(maxsplit=9)
        if not words or words[0].startswith("#"):
            continue
        if len(words) < 10:
            raise ValueError(f"expected id, qw qx qy qz, tx ty tz, camera, name; got {line.strip()[:60]!r}")
        cameras.append(_camera(words[9].strip(), int(words[8]), [float(w) for w in words[1:8]], intrinsics))
        # Without this line every second image would be taken for the points of the one before.
        if len(next(lines, "").split()) % 3:
            raise ValueError(f"expected a line of x, y, point triples (or an empty one) after image {words[9]!r}")
    return cameras


def _binary_intrinsics(data: bytes) -> dict[int, Intrinsics]:
    (count,) = struct.unpack_from("<Q", data)
    intrinsics, place = {}, 8
    for _ in range(count):
        number, model, width, height = struct.unpack_from("<iiQQ", data, place)
        if model not in _MODELS:
            raise InputError(f"camera model {model} is not supported: run COLMAP's image_undistorter first")
        name, parameters = _MODELS[model]
        values = struct.unpack_from(f"<{parameters}d", data, place + 24)
        intrinsics[number] = intrinsics_from_colmap(name, width, height, values)
        place += 24 + 8 * parameters
    return intrinsics


def _binary_images(data: bytes, intrinsics: Mapping[int, Intrinsics]) -> list[Camera]:
    (count,) = struct.unpack_from("<Q", data)
    cameras: list[Camera] = []
    place = 8
    for _ in range(count):
        _, *pose, number = struct.unpack_from("<I7di", data, place)
        start = place + struct.calcsize("<I7di")
        end = data.index(b"\0", start)
        (points,) = struct.unpack_from("<Q", data, end + 1)
        place = end + 9 + 24 * points
        if place > len(data):
            raise ValueError(f"truncated: {len(cameras)} of {count} images: copy or export the model again")
        cameras.append(_camera(data[start:end].decode(), number, pose, intrinsics))
    return cameras


def has_points(folder: Path) -> bool:
    """Return whether a model has points: a model of known poses alone has an empty points3D file.

    Raises:
        InputError: points3D is no regular file; the message starts with the path.
        OSError: it cannot be read.
    """
    binary, text = folder / "points3D.bin", folder / "points3D.txt"
    path = binary if has_entry(binary) else text
    if not has_entry(path):
        return False
    try:
        with open_regular(path) as file:
            if path == binary:
                return any(file.read(8))
            return any(line.strip() and not line.lstrip().startswith(b"#") for line in file)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def check_model_output(folder: Path) -> None:
    """Say that a text model cannot be written into a folder.

    Raises:
        InputError: it is a file, or holds a binary model, which readers would take instead of a new text one.
    """
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder}: expected a folder for a COLMAP model, got a file")
    if (folder / "cameras.bin").exists():
        raise InputError(f"{folder}: holds a binary COLMAP model, which would hide this one: choose another folder")


def write_colmap_model(folder: Path, cameras: Sequence[Camera], points: Cloud | None = None) -> None:
    """Write cameras, and points without tracks, as a COLMAP text model; the folder is made if it is missing.

    Images get the numbers 1, 2, ... in the order given; equal intrinsics become one camera (PINHOLE or OPENCV).

    Raises:
        InputError: the folder holds a binary model, which readers would take instead.
        OSError: a file cannot be written.
    """
    check_model_output(folder)
    numbers: dict[Intrinsics, int] = {}
    images = ["# Image list with two lines of data per image:"]
    images += ["#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME", "#   POINTS2D[] as (X, Y, POINT3D_ID)"]
    for number, camera in enumerate(cameras, 1):
        shared = numbers.setdefault(camera.intrinsics, len(numbers) + 1)
        pose = [*_quaternion(camera.cam_from_world.rotation), *camera.cam_from_world.translation]
        images += [f"{number} {_numbers(pose)} {shared} {camera.name}", ""]
    table = ["# Camera list with one line of data per camera:", "#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"]
    for k, number in numbers.items():
        model, distortion = ("PINHOLE", ()) if k.is_pinhole else ("OPENCV", k.distortion)
        parameters = _numbers([k.fx, k.fy, k.cx, k.cy, *distortion])
        table.append(f"{number} {model} {k.width} {k.height} {parameters}")
    rows = ["# 3D point list with one line of data per point:"]
    rows += ["#   POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)"]
    if points is not None:
        colors = np.full((len(points), 3), 128) if points.colors is None else points.colors
        for number, (xyz, rgb) in enumerate(zip(points.points, colors, strict=True), 1):
            rows.append(f"{number} {_numbers(xyz)} {rgb[0]} {rgb[1]} {rgb[2]} 0")
    folder.mkdir(parents=True, exist_ok=True)
    for name, lines in zip(MODEL_FILES, (table, images, rows), strict=True):
        with atomic_write(folder / name) as file:
            file.write("\n".join([*lines, ""]).encode())


def _numbers(values: Sequence[float] | FloatArray) -> str:
    return " ".join(repr(float(value)) for value in values)  # every digit


def _rotation(quaternion: FloatArray) -> FloatArray:
    """The rotation (3, 3) of a unit quaternion w, x, y, z."""
    w, x, y, z = quaternion
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _quaternion(rotation: FloatArray) -> FloatArray:
    """The unit quaternion w, x, y, z with w >= 0 of a rotation (3, 3): the largest eigenvector of Bar-Itzhack 2000's
    matrix, which needs no case for half turns.
    """
    (a, b, c), (d, e, f), (g, h, i) = rotation
    k = np.array(
        [
            [a + e + i, h - f, c - g, d - b],
            [h - f, a - e - i, b + d, c + g],
            [c - g, b + d, e - a - i, f + h],
            [d - b, c + g, f + h, i - a - e],
        ]
    )
    quaternion: FloatArray = np.linalg.eigh(k)[1][:, 3]
    return quaternion if quaternion[0] >= 0 else -quaternion
