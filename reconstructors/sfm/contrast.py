"""Contrast of dark and faint photographs, stretched for features and matching; colours stay as photographed."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_MIN_CONTRAST = 110.0  # grey levels between the tails: 165 to 242 in well-exposed photographs; less is stretched
_TAIL_SHARE = 0.001  # share of the pixels ignored at each end: hot pixels, lamps
_MIN_SPREAD = 1.0  # grey levels; blank photographs are not stretched
_MAX_SAMPLES_PER_SIDE = 1000  # pixels per side from which the tails are estimated


def stretch_contrast(luminance: NDArray[np.float32]) -> NDArray[np.uint8] | None:
    """Stretch the grey values of a photograph linearly to 0 to 255; None if its contrast suffices or it is blank.

    SIFT's thresholds are absolute, so a photograph whose values end at a third of the range has half the features, and
    one whose values end at a tenth has none.

    Args:
        luminance: (H, W), from 0 to 255, not rounded.
    """
    step = max(1, max(luminance.shape) // _MAX_SAMPLES_PER_SIDE)
    low, high = np.quantile(luminance[::step, ::step], [_TAIL_SHARE, 1 - _TAIL_SHARE])
    if not _MIN_SPREAD < high - low < _MIN_CONTRAST:
        return None
    stretched: NDArray[np.uint8] = ((luminance - low) * (255 / (high - low))).clip(0, 255).round().astype(np.uint8)
    return stretched
