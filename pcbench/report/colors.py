"""Colours for files: blue small, red large, without a plotting library."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray

# The colour map "turbo" (Mikhailov 2019) at eleven even places, as in the pictures.
_TURBO = np.array(
    [
        [48, 18, 59],
        [69, 89, 203],
        [62, 155, 254],
        [25, 213, 205],
        [70, 248, 132],
        [164, 252, 60],
        [225, 221, 55],
        [254, 164, 49],
        [240, 91, 18],
        [195, 37, 3],
        [122, 4, 3],
    ],
    dtype=np.float64,
)


def color_limit(values: Sequence[FloatArray]) -> float:
    """Upper end of the scale that all candidates share: the largest of their 95th percentiles; strays do not decide."""
    return max(float(np.percentile(np.abs(v), 95)) for v in values) or 1e-12


def ramp(values: FloatArray, low: float, high: float) -> NDArray[np.uint8]:
    """RGB (N, 3) of values (N,): blue at `low`, red at `high`, clipped outside."""
    place = np.clip((values - low) / (high - low), 0, 1) * (len(_TURBO) - 1)
    anchors = np.arange(len(_TURBO))
    channels = [np.interp(place, anchors, channel) for channel in _TURBO.T]
    colors: NDArray[np.uint8] = np.rint(np.stack(channels, axis=1)).astype(np.uint8)
    return colors
