"""Read `K.txt`, the 3x3 intrinsics matrix that multi-view data sets store next to their images."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pcbench.errors import InputError
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cameras import Intrinsics
from pcbench.io.files import errors_named
from pcbench.regular_files import read_text

K_MATRIX_FILE = "K.txt"
_REDUCTION_FACTORS = (1, 2, 3, 4, 6, 8)  # by which data sets downscale their images
_MAX_OFF_CENTER = 0.1  # distance of the principal point from the centre, as a share of the image size


def read_k_matrix(path: Path) -> FloatArray:
    """Read the matrix (3, 3) from a file of nine numbers, row by row.

    Raises:
        InputError: the file does not contain such a matrix, or it has skew. The message starts with the path.
    """
    with errors_named(path):
        words = read_text(path).replace(",", " ").split()
        try:
            values = np.array([float(word) for word in words])
        except ValueError:
            raise InputError("expected the nine numbers of a 3x3 matrix K, got other text: correct it") from None
        if values.shape != (9,) or not np.isfinite(values).all():
            raise InputError(f"expected nine finite numbers, a 3x3 matrix K; got {len(values)} values: correct it")
        k: FloatArray = values.reshape(3, 3)
        if not (k[0, 0] > 0 and k[1, 1] > 0) or abs(k[0, 1]) > 1e-6 * k[0, 0] or k[1, 0] or k[2].tolist() != [0, 0, 1]:
            raise InputError(
                "expected K as fx 0 cx, 0 fy cy, 0 0 1, with positive focal lengths and no skew: correct it"
            )
    return k


def intrinsics_from_k(k: FloatArray, width: int, height: int) -> tuple[Intrinsics, int]:
    """Return the intrinsics of an image of a given size, and the factor by which it was downscaled from the size of K.

    K does not state an image size. Its principal point is near the centre of the image that it was calibrated for. Its
    position therefore shows whether K belongs to this image, or to a larger one that was downscaled by an integer.

    Args:
        k: intrinsics matrix (3, 3).
        width: image width in pixels.
        height: image height in pixels.

    Raises:
        InputError: the principal point is not near the centre at any factor.
    """
    for factor in _REDUCTION_FACTORS:
        offset = np.array([k[0, 2] / (factor * width), k[1, 2] / (factor * height)]) - 0.5
        if np.abs(offset).max() <= _MAX_OFF_CENTER:
            full = Intrinsics(factor * width, factor * height, k[0, 0], k[1, 1], k[0, 2], k[1, 2])
            return full.resized(width, height), factor
    raise InputError(
        f"expected a principal point near the centre of {width} x {height} pixels, or of up to"
        f" {_REDUCTION_FACTORS[-1]} times that size; got ({k[0, 2]:g}, {k[1, 2]:g}): use the K of these images"
    )
