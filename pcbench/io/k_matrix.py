"""`K.txt`: the 3x3 matrix of a camera's intrinsics, as multi-view data sets put it beside their images."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pcbench.errors import InputError
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cameras import Intrinsics
from pcbench.regular_files import read_text

K_MATRIX_FILE = "K.txt"  # the name of the file
_REDUCTION_FACTORS = (1, 2, 3, 4, 6, 8)  # by which data sets reduce their images
_MAX_OFF_CENTER = 0.1  # of a principal point, in image sizes: lenses are mounted better than that


def read_k_matrix(path: Path) -> FloatArray:
    """The matrix (3, 3) in a file of nine numbers, row by row.

    Raises:
        InputError: it is no such file, or has skew; the message starts with the path.
    """
    try:
        words = read_text(path).replace(",", " ").split()
        values = np.array([float(word) for word in words])
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    except ValueError:
        raise InputError(f"{path}: expected the nine numbers of a 3x3 matrix K, got something else") from None
    if values.shape != (9,) or not np.isfinite(values).all():
        raise InputError(f"{path}: expected the nine numbers of a 3x3 matrix K, got {len(values)}")
    k: FloatArray = values.reshape(3, 3)
    if not (k[0, 0] > 0 and k[1, 1] > 0) or abs(k[0, 1]) > 1e-6 * k[0, 0] or k[1, 0] or k[2].tolist() != [0, 0, 1]:
        raise InputError(f"{path}: expected K as fx 0 cx, 0 fy cy, 0 0 1, with positive focal lengths and no skew")
    return k


def intrinsics_from_k(k: FloatArray, width: int, height: int) -> tuple[Intrinsics, int]:
    """The intrinsics of an image of a given size, and how many times as large the images are that K is for.

    K does not state a size. Its principal point lies near the middle of the image that it is for, which tells whether
    that is this image or one that was reduced to it by a whole number.

    Raises:
        InputError: the principal point is near no such middle.
    """
    for factor in _REDUCTION_FACTORS:
        offset = np.array([k[0, 2] / (factor * width), k[1, 2] / (factor * height)]) - 0.5
        if np.abs(offset).max() <= _MAX_OFF_CENTER:
            full = Intrinsics(factor * width, factor * height, k[0, 0], k[1, 1], k[0, 2], k[1, 2])
            return full.resized(width, height), factor
    raise InputError(
        f"K has its principal point at ({k[0, 2]:g}, {k[1, 2]:g}), which is not near the middle of an image of"
        f" {width} x {height} pixels, nor of one up to {_REDUCTION_FACTORS[-1]} times as large: give K for these images"
    )
