"""What arrays are called here, how far their coordinates may go, and the box they lie in."""

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

MAX_COORDINATE = 1e100  # squared distances between coordinates beyond it overflow


def bounds(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Lowest and highest corner (3,) of points (N, 3), N >= 1."""
    # One axis at a time: several times faster than numpy's reduction of rows of three.
    columns = [points[:, axis] for axis in range(3)]
    return np.array([c.min() for c in columns]), np.array([c.max() for c in columns])
