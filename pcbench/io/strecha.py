"""Strecha's `.camera` files, which go with the multi-view sets of Strecha et al. 2008 (fountain-P11, Herz-Jesu-P8).

Twenty-six numbers: K (3x3), three distortion coefficients, R (3x3, camera to world), C (the centre), width and height.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pcbench.errors import InputError
from pcbench.geometry.cameras import Camera, Intrinsics, rotation_from
from pcbench.geometry.transform import Similarity
from pcbench.regular_files import read_text


def read_strecha(path: Path) -> Camera:
    """The camera in a `.camera` file; its name is the file's without that ending (`0000.jpg.camera` -> `0000.jpg`).

    Raises:
        InputError: it is no such file, is distorted, or its R is no rotation; the message starts with the path.
    """
    try:
        values = np.array([float(word) for word in read_text(path).split()])
        if values.shape != (26,):
            raise InputError(f"expected 26 numbers (K, distortion, R, C, width and height), got {len(values)}")
        k, distortion, rotation, centre, size = np.split(values, [9, 12, 21, 24])
        if distortion.any():
            raise InputError("expected undistorted images (three zeros after K): undistort them first")
        if abs(k[1]) > 1e-6 * k[0] or k[3] or k[6] or k[7] or k[8] != 1 or (size != size.round()).any():
            raise InputError("expected K without skew and a size in whole pixels")
        world_from_cam = rotation_from(rotation.reshape(3, 3))
        intrinsics = Intrinsics(int(size[0]), int(size[1]), float(k[0]), float(k[4]), float(k[2]), float(k[5]))
        pose = Similarity(world_from_cam.T, -world_from_cam.T @ centre)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    except (ValueError, OverflowError) as error:
        raise InputError(f"{path}: expected 26 numbers (K, distortion, R, C, width and height): {error}") from None
    return Camera(path.name.removesuffix(".camera"), intrinsics, pose)
