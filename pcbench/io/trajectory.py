"""Read the camera centres of trajectories: `.log` files of Tanks and Temples, and COLMAP models.

A `.log` file has five lines per image: three integers, then the rows of the 4x4 matrix from camera to world. The first
integer is the number of the image from 0; a negative second one marks an image without a pose.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pcbench.errors import InputError
from pcbench.geometry.arrays import MAX_COORDINATE, FloatArray, IntArray
from pcbench.io.colmap_folders import find_model
from pcbench.io.colmap_model import read_colmap_cameras
from pcbench.io.files import Warn, errors_named
from pcbench.regular_files import read_text

_LINES_PER_IMAGE = 5
_MAX_BOTTOM_ROW_ERROR = 1e-6  # of the last row, which is 0 0 0 1
_NUMBER_IN_NAME = re.compile(r"(\d+)\D*$")


class Trajectory(NamedTuple):
    """Centres of cameras.

    Attributes:
        numbers: (N,) numbers of the images, from 0.
        places: (N,) places of the images in the file, from 0.
        centers: (N, 3) camera centres.
        length: number of images in the file, those without a pose included.
    """

    numbers: IntArray
    places: IntArray
    centers: FloatArray
    length: int


def read_trajectory(path: Path, on_warning: Warn) -> Trajectory:
    """Read a `.log` file, or the cameras of the COLMAP model in a folder.

    The images of a COLMAP model are numbered by the last number in their names minus 1, since those of Tanks and
    Temples begin with 000001.jpg.

    Args:
        path: file, or folder with a COLMAP model.
        on_warning: callback, called with one line per warning.

    Raises:
        InputError: the file is malformed or has no pose. The message starts with the path.
    """
    return _from_model(path, on_warning) if path.is_dir() else _from_log(path)


def _from_model(path: Path, on_warning: Warn) -> Trajectory:
    with errors_named(path):
        folder = find_model(path, "images", on_warning)
        if folder is None:
            raise InputError("expected a .log file or a folder with a COLMAP model, got another folder")
    cameras = read_colmap_cameras(folder, on_warning)
    matches = [_NUMBER_IN_NAME.search(Path(camera.name).stem) for camera in cameras]
    for camera, match in zip(cameras, matches, strict=True):
        if match is None or len(match[1]) > 15:
            raise InputError(
                f"{folder}: expected names of images with a number, such as 000001.jpg, got {camera.name!r}"
            )
    numbers = np.array([int(match[1]) - 1 for match in matches if match is not None])
    centers = np.stack([camera.position for camera in cameras])
    return Trajectory(numbers, np.arange(len(cameras)), centers, len(cameras))


def _from_log(path: Path) -> Trajectory:
    with errors_named(path):
        lines = [line.split() for line in read_text(path).splitlines() if line.strip()]
        if not lines or len(lines) % _LINES_PER_IMAGE:
            raise InputError(f"expected five lines per image (three integers and a 4x4 matrix), got {len(lines)} lines")
        numbers, places, centers = [], [], []
        for first in range(0, len(lines), _LINES_PER_IMAGE):
            header, *rows = lines[first : first + _LINES_PER_IMAGE]
            image = first // _LINES_PER_IMAGE
            try:
                number, view = (int(word) for word in header[:2])
                matrix = np.array([[float(word) for word in row] for row in rows])
            except ValueError:
                raise InputError(f"image {image}: expected three integers and a 4x4 matrix, got other text") from None
            if matrix.shape != (4, 4) or not (np.abs(matrix) < MAX_COORDINATE).all():
                raise InputError(f"image {image}: expected a 4x4 matrix of finite numbers")
            if np.abs(matrix[3] - (0, 0, 0, 1)).max() > _MAX_BOTTOM_ROW_ERROR:
                raise InputError(f"image {image}: expected the last row 0 0 0 1")
            if view >= 0:
                numbers.append(number)
                places.append(image)
                centers.append(matrix[:3, 3])
        if not numbers:
            raise InputError("expected at least one image with a pose, got none")
        if not 0 <= min(numbers) <= max(numbers) < 2**53:
            wrong = min(numbers) if min(numbers) < 0 else max(numbers)
            raise InputError(f"expected numbers of images from 0 to 2^53, got {str(wrong)[:40]}")
    return Trajectory(np.array(numbers), np.array(places), np.array(centers), len(lines) // _LINES_PER_IMAGE)
