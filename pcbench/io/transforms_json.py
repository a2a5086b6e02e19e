"""Read and write transforms.json of instant-ngp and nerfstudio (docs.nerf.studio, "Data conventions").

Poses are camera-to-world with OpenGL's camera axes (x right, y up, z backwards); pixel centres are at +0.5. Intrinsics
are given for the complete file or per frame.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pcbench.errors import InputError
from pcbench.geometry.arrays import MAX_COORDINATE
from pcbench.geometry.cameras import Camera, Intrinsics, nearest_rotation
from pcbench.geometry.transform import Similarity
from pcbench.io.files import errors_named
from pcbench.regular_files import read_json
from pcbench.scratch import atomic_write

Size = tuple[int, int]

_MODELS = ("OPENCV", "OPENCV_FISHEYE", "PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE", "SIMPLE_RADIAL", "RADIAL")
# Keys that are ignored, and the value for which ignoring them changes nothing.
_IGNORED_KEYS: dict[str, Any] = {
    **dict.fromkeys(("k5", "k6", "rolling_shutter_scanline_time", "rolling_shutter_time"), 0),
    "rolling_shutter": [0, 0, 0, 0],
    "applied_transform": np.eye(4)[:3].tolist(),
    "applied_scale": 1,
    **dict.fromkeys(("mask_path", "depth_file_path"), ""),
}
# Relative difference between a focal length and the angle of view: files round, and some angles include distortion.
_MAX_FOCAL_DISAGREEMENT = 0.1
# From OpenGL's camera axes to OpenCV's: y and z change sign.
_OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0])


def read_transforms(
    path: Path, size_of: Callable[[str], Size | None], on_warning: Callable[[str], None] | None = None
) -> tuple[Camera, ...]:
    """Read the cameras of a transforms.json, named by their `file_path` as stored.

    Args:
        path: input file.
        size_of: function from a `file_path` to the (width, height) of its image, or None if there is no image. Files
            that only give an angle of view need it. Frames with neither size nor image are left out.
        on_warning: callback, called with one line about ignored keys. Defaults to `warnings.warn`.

    Raises:
        InputError: the file is malformed, a number is missing, a camera model is not supported, a focal length
            contradicts an angle of view, or a pose is not a rotation. The message starts with the path and names the
            frame.
    """
    warn = on_warning if on_warning is not None else lambda text: warnings.warn(text, stacklevel=3)
    with errors_named(path):
        document = read_json(path)
        if not isinstance(document, dict) or not isinstance(document.get("frames"), list):
            raise InputError("expected a JSON object with a list of frames, got other JSON: export it again")
    names = [frame.get("file_path") if isinstance(frame, dict) else None for frame in document["frames"]]
    _check_duplicates(path, names, size_of)  # before poses are parsed: a file may repeat one frame many times
    cameras = []
    without_size = []
    for number, (name, frame) in enumerate(zip(names, document["frames"], strict=True)):
        with errors_named(f"{path}: frame {number} ({name})"):
            if not isinstance(name, str):
                raise InputError("expected a file_path, got none: add the name of the image")
            values = {**document, **frame}
            try:
                intrinsics = _intrinsics(values, size_of(name))
                if intrinsics is None:
                    without_size.append(name)
                else:
                    cameras.append(Camera(name, intrinsics, _pose(values.get("transform_matrix"))))
            except InputError:  # also a ValueError, but its message is complete
                raise
            except (ValueError, KeyError, TypeError, OverflowError) as error:
                what = f"{error} is missing" if isinstance(error, KeyError) else str(error)
                raise InputError(f"expected numbers: {what}") from None
    if not names:
        raise InputError(f"{path}: expected at least one frame, got none: export it again")
    if not cameras:
        raise InputError(
            f"{path}: expected frames with w and h, or their images; got neither, for example for"
            f" {names[0]!r}: use the images of these cameras"
        )
    if without_size:
        warn(
            f"{path}: left out {len(without_size)} of {len(names)} frames without w and h, whose images are missing:"
            f" {', '.join(without_size[:3])}{', ...' if len(without_size) > 3 else ''}"
        )
    objects = [document, *document["frames"]]
    if ignored := [
        key for key, neutral in _IGNORED_KEYS.items() if any(v.get(key, neutral) != neutral for v in objects)
    ]:
        warn(f"{path}: ignored {', '.join(ignored)}: cameras and lenses are read without them")
    return tuple(cameras)


def _check_duplicates(path: Path, names: Sequence[Any], size_of: Callable[[str], Size | None]) -> None:
    """Raise InputError if two frames refer to one existing image."""
    seen: set[str] = set()
    for number, name in enumerate(names):
        if isinstance(name, str):
            if name in seen and size_of(name) is not None:
                raise InputError(
                    f"{path}: frame {number}: expected one camera per image, got two for {name}: remove one"
                )
            seen.add(name)


def _intrinsics(values: Mapping[str, Any], image: Size | None) -> Intrinsics | None:
    model = values.get("camera_model", "OPENCV")
    is_fisheye = model == "OPENCV_FISHEYE" or bool(values.get("is_fisheye"))
    k1, k2, k3, k4, p1, p2 = (float(values.get(k, 0)) for k in ("k1", "k2", "k3", "k4", "p1", "p2"))
    if model not in _MODELS or (k4 and not is_fisheye) or (is_fisheye and (p1 or p2)):
        raise InputError(
            "expected lens distortion of k1, k2, k3, p1, p2, or of a fisheye lens k1, k2, k3, k4, got"
            f" {model}: undistort the images first"
        )
    size = (int(values["w"]), int(values["h"])) if "w" in values and "h" in values else image
    if size is None:
        return None
    width, height = size
    fx = _focal(values, "x", width)
    if fx is None:
        raise KeyError("fl_x or camera_angle_x")
    fy = _focal(values, "y", height) or fx
    centre = float(values.get("cx", width / 2)), float(values.get("cy", height / 2))
    if is_fisheye:
        return Intrinsics(width, height, fx, fy, *centre, (k1, k2, k3, k4), fisheye=True)
    distortion = (k1, k2, p1, p2, k3, 0.0, 0.0, 0.0) if k3 else (k1, k2, p1, p2)
    return Intrinsics(width, height, fx, fy, *centre, distortion)


def _focal(values: Mapping[str, Any], axis: str, pixels: int) -> float | None:
    """Return the focal length in pixels, as stated or from the angle of view; None if there is neither."""
    stated, angle = (float(values[key]) if key in values else None for key in (f"fl_{axis}", f"camera_angle_{axis}"))
    if angle is None:
        return stated
    implied = 0.5 * pixels / float(np.tan(0.5 * angle))
    if stated is not None and abs(stated - implied) > _MAX_FOCAL_DISAGREEMENT * implied:
        raise InputError(
            f"expected fl_{axis} and camera_angle_{axis} to agree, got {stated:g} px and {angle:g} rad"
            f" ({implied:.4g} px): remove the wrong one"
        )
    return implied if stated is None else stated


def _pose(matrix: Any) -> Similarity:
    m = np.array(matrix, dtype=np.float64)
    if m.shape not in ((4, 4), (3, 4)):
        raise InputError(f"expected a 4x4 transform_matrix, got shape {m.shape}: export it again")
    if len(wrong := m[~(np.abs(m) < MAX_COORDINATE)]):
        raise InputError(f"expected a transform_matrix of finite numbers, got {wrong[0]}: export it again")
    cam_from_world = (nearest_rotation(m[:3, :3]) @ _OPENCV_FROM_OPENGL).T
    return Similarity(cam_from_world, -cam_from_world @ m[:3, 3])


def write_transforms(path: Path, cameras: Sequence[Camera], images: str = "images") -> None:
    """Write cameras as a transforms.json. If an error occurs, an existing file stays unchanged.

    Args:
        path: output file.
        cameras: cameras to write.
        images: folder of the images, relative to the folder of the file.

    Raises:
        InputError: a lens has coefficients that the format does not have.
        OSError: the file cannot be written.
    """
    intrinsics = [_intrinsics_values(camera.intrinsics) for camera in cameras]
    shared = intrinsics[0] if intrinsics and all(values == intrinsics[0] for values in intrinsics) else {}
    frames = []
    for camera, camera_values in zip(cameras, intrinsics, strict=True):
        world_from_cam = camera.cam_from_world.inverse().matrix
        world_from_cam[:3, :3] = world_from_cam[:3, :3] @ _OPENCV_FROM_OPENGL
        name = f"{images}/{camera.name}" if images else camera.name
        frames.append(
            {"file_path": name, **({} if shared else camera_values), "transform_matrix": world_from_cam.tolist()}
        )
    document = {"camera_model": "OPENCV", **shared, "frames": frames}
    with atomic_write(path) as file:
        file.write(json.dumps(document, indent=1).encode() + b"\n")


def _intrinsics_values(intrinsics: Intrinsics) -> dict[str, Any]:
    values: dict[str, Any] = {"w": intrinsics.width, "h": intrinsics.height}
    values |= {"fl_x": intrinsics.fx, "fl_y": intrinsics.fy, "cx": intrinsics.cx, "cy": intrinsics.cy}
    if intrinsics.fisheye:
        names = ("k1", "k2", "k3", "k4")
        return {"camera_model": "OPENCV_FISHEYE", **values, **dict(zip(names, intrinsics.distortion, strict=True))}
    k1, k2, p1, p2, *higher = intrinsics.distortion
    if any(higher[1:]):
        raise InputError("transforms.json has no lens with k4, k5 and k6: write a COLMAP model, in a folder")
    return {**values, "k1": k1, "k2": k2, "p1": p1, "p2": p2, **({"k3": higher[0]} if higher else {})}
