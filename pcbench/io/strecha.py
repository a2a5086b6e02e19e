"""Read `.camera` files of the multi-view sets of Strecha et al. 2008 (fountain-P11, Herz-Jesu-P8).

A file has 26 numbers: K (3x3), three distortion coefficients, R (3x3, camera to world), C (the centre), width, height.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pcbench.errors import InputError
from pcbench.geometry.arrays import MAX_COORDINATE
from pcbench.geometry.cameras import Camera, Intrinsics, nearest_rotation
from pcbench.geometry.transform import Similarity
from pcbench.io.files import errors_named
from pcbench.regular_files import read_text

_EXPECTED = "expected 26 finite numbers (K, distortion, R, C, width and height)"


def read_strecha(path: Path) -> Camera:
    """Read the camera in a `.camera` file. Its name is the file name without `.camera` (such as `0000.jpg`).

    Raises:
        InputError: the file is malformed, the image is distorted, or R is not a rotation. The message starts with the
            path.
    """
    with errors_named(path):
        words = read_text(path).split()
        try:
            values = np.array([float(word) for word in words])
        except ValueError as error:
            raise InputError(f"{_EXPECTED}: {error}") from None
        if values.shape != (26,) or not (np.abs(values) < MAX_COORDINATE).all():
            raise InputError(f"{_EXPECTED}, got {len(values)}: correct it")
        k, distortion, rotation, centre, size = np.split(values, [9, 12, 21, 24])
        if distortion.any():
            raise InputError(
                "expected zero distortion (three zeros after K), got other values: undistort the images first"
            )
        if abs(k[1]) > 1e-6 * k[0] or k[3] or k[6] or k[7] or k[8] != 1 or (size != size.round()).any():
            raise InputError("expected K without skew and a size in integer pixels: undistort the images or correct it")
        world_from_cam = nearest_rotation(rotation.reshape(3, 3))
        intrinsics = Intrinsics(int(size[0]), int(size[1]), float(k[0]), float(k[4]), float(k[2]), float(k[5]))
        pose = Similarity(world_from_cam.T, -world_from_cam.T @ centre)
    return Camera(path.name.removesuffix(".camera"), intrinsics, pose)
