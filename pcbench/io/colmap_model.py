"""Read and write the cameras of a COLMAP sparse model, text or binary. Formats: colmap.github.io/format.html.

`pcbench.io.colmap` reads its points. Rigs and frames of newer models are not needed: each image has its pose.
"""

from __future__ import annotations

import struct
import warnings
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from pcbench.errors import InputError, reason_of
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cameras import Camera, Intrinsics
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.transform import Similarity
from pcbench.io.colmap_folders import MAX_MODEL_BYTES
from pcbench.io.colmap_text import ImagePose, check_complete, data_lines, excerpt, parse_images
from pcbench.io.files import MAX_PADDING, Warn, check_end
from pcbench.regular_files import has_entry, open_regular, read_bytes
from pcbench.scratch import atomic_write

# Name and parameter count of the camera models, by COLMAP's model ID.
_MODELS_BY_ID = {
    0: ("SIMPLE_PINHOLE", 3),
    1: ("PINHOLE", 4),
    2: ("SIMPLE_RADIAL", 4),
    3: ("RADIAL", 5),
    4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8),
    6: ("FULL_OPENCV", 12),
    7: ("FOV", 5),
    8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5),
    10: ("THIN_PRISM_FISHEYE", 12),
    11: ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
    12: ("SIMPLE_DIVISION", 4),
    13: ("DIVISION", 5),
    14: ("SIMPLE_FISHEYE", 3),
    15: ("FISHEYE", 4),
    16: ("EUCM", 6),
    17: ("EQUIRECTANGULAR", 2),
}
_ONE_FOCAL_LENGTH = ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
_ONE_FOCAL_LENGTH_FISHEYE = ("SIMPLE_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")
_FISHEYE = (*_ONE_FOCAL_LENGTH_FISHEYE, "FISHEYE", "OPENCV_FISHEYE")
_SUPPORTED_MODELS = (*_ONE_FOCAL_LENGTH, "PINHOLE", "OPENCV", "FULL_OPENCV", *_FISHEYE)
_LEAST_CAMERA_BYTES = 24 + 2 * 8  # of two parameters
_LEAST_IMAGE_BYTES = struct.calcsize("<I7di") + 1 + 8  # without name and keypoints
_PARAMETER_COUNTS = dict(_MODELS_BY_ID.values())

MODEL_FILES = ("cameras.txt", "images.txt", "points3D.txt")  # written by `write_colmap_model`


def read_colmap_cameras(folder: Path, on_warning: Warn | None = None) -> tuple[Camera, ...]:
    """Read the cameras of a COLMAP model, sorted by image name. Binary files take precedence over text.

    Args:
        folder: folder that holds the model itself.
        on_warning: callback, called with one line per warning. Defaults to `warnings.warn`.

    Raises:
        InputError: there is no model, it is damaged or incomplete, a camera model is not supported, or a quaternion is
            not a rotation. The message starts with the path.
    """
    report = on_warning if on_warning is not None else lambda text: warnings.warn(text, stacklevel=3)
    binary = has_entry(folder / "cameras.bin") and has_entry(folder / "images.bin")
    names = ("cameras.bin", "images.bin") if binary else ("cameras.txt", "images.txt")
    intrinsics: dict[int, Intrinsics] = {}
    for name in names:
        path = folder / name
        warn = partial(_report_named, report, path)
        try:
            data = read_bytes(path, MAX_MODEL_BYTES)
            if name.startswith("cameras"):
                intrinsics = _binary_intrinsics(data, warn) if binary else _text_intrinsics(data, warn)
            else:
                images = _binary_images(data, warn) if binary else parse_images(data, warn)
                cameras = [_camera(image, intrinsics) for image in images]
        except FileNotFoundError:
            raise InputError(f"{path}: no such file: expected the cameras and images of a COLMAP model") from None
        except OSError as error:
            raise InputError(f"{path}: cannot be read: {reason_of(error)}") from error
        except InputError as error:
            raise InputError(f"{path}: {error}") from None
        except (ValueError, OverflowError) as error:
            raise InputError(f"{path}: expected a COLMAP model, got a damaged file: {error}") from None
        except struct.error:
            raise InputError(f"{path}: truncated: copy or export the model again") from None
    if not cameras:
        raise InputError(f"{path}: expected at least one image, got a model without images: export it with its images")
    return tuple(sorted(cameras, key=lambda camera: camera.name))


def _report_named(report: Warn, path: Path, text: str) -> None:
    report(f"{path}: {text}")


def intrinsics_from_colmap(model: str, width: int, height: int, p: Sequence[float]) -> Intrinsics:
    """Convert the model and parameters of a COLMAP camera to intrinsics.

    Args:
        model: name of the camera model, such as "OPENCV".
        width: image width in pixels.
        height: image height in pixels.
        p: parameters of the model, in COLMAP's order.

    Raises:
        InputError: `Intrinsics` does not support the model, or the parameter count is wrong.
    """
    if model not in _SUPPORTED_MODELS:
        raise InputError(
            f"expected a camera model of {', '.join(_SUPPORTED_MODELS)}, got {model}: undistort the images with"
            " COLMAP's image_undistorter"
        )
    if len(p) != _PARAMETER_COUNTS[model]:
        raise InputError(
            f"expected {_PARAMETER_COUNTS[model]} parameters for {model}, got {len(p)}: export the model again"
        )
    one_focal_length = model in _ONE_FOCAL_LENGTH or model in _ONE_FOCAL_LENGTH_FISHEYE
    fx, fy, cx, cy, *stated = [p[0], *p] if one_focal_length else p
    distortion = (*stated, 0.0, 0.0, 0.0, 0.0)[: 8 if any(stated[4:]) else 4]
    return Intrinsics(width, height, fx, fy, cx, cy, distortion, model in _FISHEYE)


def colmap_camera(k: Intrinsics) -> tuple[str, list[float]]:
    """Return the name of COLMAP's model of a lens and its parameters, in COLMAP's order."""
    model = "OPENCV_FISHEYE" if k.fisheye else "FULL_OPENCV" if len(k.distortion) == 8 else "OPENCV"
    if k.is_pinhole:
        return "PINHOLE", [k.fx, k.fy, k.cx, k.cy]
    return model, [k.fx, k.fy, k.cx, k.cy, *k.distortion]


def _camera(image: ImagePose, intrinsics: Mapping[int, Intrinsics]) -> Camera:
    if image.camera not in intrinsics:
        raise InputError(
            f"image {image.name}: camera {image.camera} is missing in the cameras file: export the model again"
        )
    quaternion = np.array(image.pose[:4], dtype=np.float64)
    length = float(np.linalg.norm(quaternion))
    if not abs(length - 1) < 1e-3:
        raise InputError(
            f"image {image.name}: expected a unit quaternion, got one of length {length:.6g}: export the model again"
        )
    pose = Similarity(_rotation(quaternion / length), np.array(image.pose[4:]))
    return Camera(image.name, intrinsics[image.camera], pose)


def _text_intrinsics(data: bytes, warn: Warn) -> dict[int, Intrinsics]:
    intrinsics: dict[int, Intrinsics] = {}
    for number, line in data_lines(data):
        if not line:
            continue
        try:
            camera, model, width, height, *parameters = line.decode().split()
            key, size, values = int(camera), (int(width), int(height)), [float(word) for word in parameters]
        except ValueError:
            raise InputError(
                f"line {number}: expected id, model, width, height, parameters; got {excerpt(line)}: copy or export the"
                " model again"
            ) from None
        _add_camera(intrinsics, key, intrinsics_from_colmap(model, *size, values))
    check_complete(data, "cameras", len(intrinsics), warn)
    return intrinsics


def _add_camera(intrinsics: dict[int, Intrinsics], number: int, camera: Intrinsics) -> None:
    if intrinsics.setdefault(number, camera) != camera:
        raise InputError(f"expected each camera once, got two different cameras {number}: export the model again")


def _binary_intrinsics(data: bytes, warn: Warn) -> dict[int, Intrinsics]:
    (count,) = struct.unpack_from("<Q", data)
    intrinsics: dict[int, Intrinsics] = {}
    offset = 8
    for _ in range(count):
        number, model, width, height = struct.unpack_from("<iiQQ", data, offset)
        if model not in _MODELS_BY_ID:
            raise InputError(
                f"expected a camera model of {', '.join(_SUPPORTED_MODELS)}, got one with the unknown number {model}:"
                " undistort the images with COLMAP's image_undistorter"
            )
        name, parameters = _MODELS_BY_ID[model]
        values = struct.unpack_from(f"<{parameters}d", data, offset + 24)
        _add_camera(intrinsics, number, intrinsics_from_colmap(name, width, height, values))
        offset += 24 + 8 * parameters
    check_end(data[offset:][:MAX_PADDING], len(data) - offset, _LEAST_CAMERA_BYTES, f"{count} cameras", warn)
    return intrinsics


def _binary_images(data: bytes, warn: Warn) -> list[ImagePose]:
    (count,) = struct.unpack_from("<Q", data)
    images: list[ImagePose] = []
    offset = 8
    for _ in range(count):
        _, *pose, camera = struct.unpack_from("<I7di", data, offset)
        start = offset + struct.calcsize("<I7di")
        end = data.index(b"\0", start)
        (points,) = struct.unpack_from("<Q", data, end + 1)
        offset = end + 9 + 24 * points
        if offset > len(data):
            raise InputError(f"truncated: got {len(images)} of {count} images: copy or export the model again")
        images.append(ImagePose(data[start:end].decode(), camera, tuple(pose)))
    check_end(data[offset:][:MAX_PADDING], len(data) - offset, _LEAST_IMAGE_BYTES, f"{count} images", warn)
    return images


def has_points(path: Path) -> bool:
    """Return whether a points file contains points. That of a model made of known poses is empty.

    Raises:
        InputError: it is not a regular file. The message starts with the path.
        OSError: the file cannot be read.
    """
    try:
        with open_regular(path) as file:
            if path.suffix == ".bin":
                return any(file.read(8))
            return any(line.strip() and not line.lstrip().startswith(b"#") for line in file)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def check_model_output(folder: Path) -> None:
    """Check that a text model can be written to a folder.

    Raises:
        InputError: the folder is a file or contains a binary model, which readers would prefer over a new text model.
    """
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder}: expected a folder for a COLMAP model, got a file")
    if (folder / "cameras.bin").exists():
        raise InputError(f"{folder}: contains a binary COLMAP model, which readers would prefer: choose another folder")


def write_colmap_model(folder: Path, cameras: Sequence[Camera], points: Cloud | None = None) -> None:
    """Write cameras, and points without tracks, as a COLMAP text model. Create the folder if it is missing.

    Image IDs are 1, 2, ... in the given order. Equal intrinsics share one camera.

    Raises:
        InputError: the folder is a file, or contains a binary model, which readers would prefer.
        OSError: a file cannot be written.
    """
    check_model_output(folder)
    numbers: dict[Intrinsics, int] = {}
    images = ["# Image list with two lines of data per image:"]
    images += ["#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME", "#   POINTS2D[] as (X, Y, POINT3D_ID)"]
    for number, camera in enumerate(cameras, 1):
        shared = numbers.setdefault(camera.intrinsics, len(numbers) + 1)
        pose = [*_quaternion(camera.cam_from_world.rotation), *camera.cam_from_world.translation]
        images += [f"{number} {_format_numbers(pose)} {shared} {camera.name}", ""]
    table = ["# Camera list with one line of data per camera:", "#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"]
    for k, number in numbers.items():
        model, parameters = colmap_camera(k)
        table.append(f"{number} {model} {k.width} {k.height} {_format_numbers(parameters)}")
    rows = ["# 3D point list with one line of data per point:"]
    rows += ["#   POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)"]
    if points is not None:
        colors = np.full((len(points), 3), 128) if points.colors is None else points.colors
        for number, (xyz, rgb) in enumerate(zip(points.points, colors, strict=True), 1):
            rows.append(f"{number} {_format_numbers(xyz)} {rgb[0]} {rgb[1]} {rgb[2]} 0")
    folder.mkdir(parents=True, exist_ok=True)
    for name, lines in zip(MODEL_FILES, (table, images, rows), strict=True):
        with atomic_write(folder / name) as file:
            file.write("\n".join([*lines, ""]).encode())


def _format_numbers(values: Sequence[float] | FloatArray) -> str:
    return " ".join(repr(float(value)) for value in values)  # repr is exact


def _rotation(quaternion: FloatArray) -> FloatArray:
    """Return the rotation matrix (3, 3) of a unit quaternion w, x, y, z."""
    w, x, y, z = quaternion
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _quaternion(rotation: FloatArray) -> FloatArray:
    """Return the unit quaternion w, x, y, z with w >= 0 of a rotation matrix (3, 3).

    It is the eigenvector of the largest eigenvalue of Bar-Itzhack's (2000) matrix, which handles half turns too.
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
