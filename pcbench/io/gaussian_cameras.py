"""Read the cameras.json of 3D Gaussian splatting (Kerbl et al. 2023), which lies beside a trained model.

It is a list of objects with the name of the image, its size, the camera's position, its axes as the columns of a
rotation from camera to world, and the focal lengths. The principal point is the centre of the image.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from pcbench.errors import InputError
from pcbench.geometry.arrays import MAX_COORDINATE
from pcbench.geometry.cameras import Camera, Intrinsics, nearest_rotation
from pcbench.geometry.transform import Similarity
from pcbench.io.files import errors_named
from pcbench.regular_files import read_json

_KEYS = ("img_name", "width", "height", "position", "rotation", "fx", "fy")


def is_gaussian_cameras(path: Path) -> bool:
    """Return whether a file is a cameras.json of 3D Gaussian splatting, and not one of transforms.json's kind."""
    try:
        document = read_json(path)
    except (InputError, OSError):  # the reader of transforms.json says so
        return False
    return isinstance(document, list) and bool(document) and _has_keys(document[0])


def read_gaussian_cameras(path: Path) -> tuple[Camera, ...]:
    """Read the cameras, named by `img_name`.

    Raises:
        InputError: the file is malformed, or a pose is not a rotation. The message starts with the path and names the
            camera.
    """
    with errors_named(path):
        document = read_json(path)
        if not isinstance(document, list) or not document:
            raise InputError("expected a JSON list of cameras, got other JSON: use the cameras.json of the model")
    cameras = []
    for number, values in enumerate(document):
        with errors_named(f"{path}: camera {number}"):
            if not _has_keys(values):
                got = ", ".join(map(str, values))[:80] if isinstance(values, dict) else type(values).__name__
                raise InputError(f"expected {', '.join(_KEYS)}, got {got or 'nothing'}: use the file of the model")
            try:
                cameras.append(_camera(values))
            except InputError:  # also a ValueError, but its message is complete
                raise
            except (ValueError, TypeError, OverflowError) as error:
                raise InputError(f"expected numbers: {str(error)[:80]}: use the file of the model") from None
    return tuple(cameras)


def _has_keys(values: Any) -> bool:
    return isinstance(values, dict) and values.keys() >= set(_KEYS)


def _camera(values: dict[str, Any]) -> Camera:
    position = np.array(values["position"], dtype=np.float64)
    if position.shape != (3,) or not (np.abs(position) < MAX_COORDINATE).all():
        raise InputError(f"expected a position of three finite numbers, got {str(values['position'])[:60]}: correct it")
    cam_from_world = nearest_rotation(values["rotation"]).T
    width, height = int(values["width"]), int(values["height"])
    focal = float(values["fx"]), float(values["fy"])
    intrinsics = Intrinsics(width, height, *focal, width / 2, height / 2)
    return Camera(str(values["img_name"]), intrinsics, Similarity(cam_from_world, -cam_from_world @ position))
