"""Similarity of a rendering to a photograph of the same view."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.errors import InputError
from pcbench.geometry.arrays import FloatArray

_RADIUS = 5  # of the windows of SSIM: 11 x 11 pixels
_SIGMA = 1.5
_C1, _C2 = 0.01**2, 0.03**2


class ViewScores(NamedTuple):
    """Scores of one rendering against its photograph.

    Attributes:
        psnr: peak signal-to-noise ratio in decibels; higher is better.
        ssim: structural similarity, at most 1; higher is better.
        lpips, flip: perceptual errors, at least 0; lower is better; None if not installed
            (`pcbench.measure.perceptual`).
    """

    psnr: float
    ssim: float
    lpips: float | None = None
    flip: float | None = None


def psnr(image: NDArray[Any], reference: NDArray[Any], mask: NDArray[np.bool_] | None = None) -> float:
    """Peak signal-to-noise ratio in decibels: -10 log10 of the mean squared difference over all channels of all pixels
    that count, where the largest value of a pixel is 1. Infinite where nothing differs, NaN where no pixel counts.

    Args:
        image, reference: (H, W, 3), uint8 or numbers from 0 to 1.
        mask: (H, W), which pixels count; None: all.

    Raises:
        InputError: they are of different or other shapes, or neither uint8 nor floating-point numbers.
    """
    a, b, counts = _checked(image, reference, mask)
    squares = np.square(a - b)[counts]
    if not squares.size:
        return float("nan")
    error = float(squares.mean())
    return float("inf") if error == 0 else -10 * float(np.log10(error))


def ssim(image: NDArray[Any], reference: NDArray[Any], mask: NDArray[np.bool_] | None = None) -> float:
    """Structural similarity (Wang, Bovik, Sheikh & Simoncelli 2004, "Image quality assessment"): the mean over the
    channels and over all windows that lie in the image and count whole. NaN where no window does.

    Windows are of 11 x 11 pixels with Gaussian weights, sigma 1.5; K1 = 0.01 and K2 = 0.03; covariances are those of
    the window itself, not of a population it would be a sample of. Without a mask this is scikit-image's
    `structural_similarity` with `gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=1,
    channel_axis=2`. The code of 3D Gaussian splatting (Kerbl et al. 2023) has the same windows, but also takes those
    that reach beyond the image, where it takes both images to be black.

    Args:
        image, reference: (H, W, 3), uint8 or numbers from 0 to 1.
        mask: (H, W), which pixels count; None: all.

    Raises:
        InputError: they are of different or other shapes, or neither uint8 nor floating-point numbers.
    """
    a, b, counts = _checked(image, reference, mask)
    whole = _windows(counts)
    if not whole.any():
        return float("nan")
    mean_a, mean_b = _blurred(a), _blurred(b)
    variance_a, variance_b = _blurred(a * a) - mean_a**2, _blurred(b * b) - mean_b**2
    covariance = _blurred(a * b) - mean_a * mean_b
    likeness = (2 * mean_a * mean_b + _C1) * (2 * covariance + _C2)
    likeness /= (mean_a**2 + mean_b**2 + _C1) * (variance_a + variance_b + _C2)
    return float(likeness[whole].mean())


def absolute_error(image: NDArray[Any], reference: NDArray[Any]) -> FloatArray:
    """|difference| of every pixel (H, W), the mean over its channels, in levels of 255.

    Raises:
        InputError: they are of different or other shapes, or neither uint8 nor floating-point numbers.
    """
    a, b, _ = _checked(image, reference, None)
    error: FloatArray = 255 * np.abs(a - b).mean(axis=2)
    return error


def unit_range(image: NDArray[Any]) -> FloatArray:
    """An image (H, W, 3) as float64 from 0 to 1.

    Raises:
        InputError: it is of another shape, or neither uint8 nor of floating-point numbers.
    """
    if image.ndim != 3 or image.shape[2] != 3:
        raise InputError(f"expected an image of shape (height, width, 3), got {image.shape}")
    if image.dtype == np.uint8:
        return image / 255.0
    if not np.issubdtype(image.dtype, np.floating):
        raise InputError(f"expected an image of uint8 or of numbers from 0 to 1, got {image.dtype}")
    return image.astype(np.float64)


def _checked(
    image: NDArray[Any], reference: NDArray[Any], mask: NDArray[np.bool_] | None
) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
    a, b = unit_range(image), unit_range(reference)
    if a.shape != b.shape:
        raise InputError(f"expected two images of one size, got {_size(a)} and {_size(b)} pixels")
    counts = np.ones(a.shape[:2], dtype=bool) if mask is None else mask
    if counts.shape != a.shape[:2] or counts.dtype != bool:
        raise InputError(f"expected a mask of truth values, {_size(a)} pixels, got {counts.dtype}, {_size(counts)}")
    return a, b, counts


def _size(image: NDArray[Any]) -> str:
    return " x ".join(map(str, image.shape[1::-1]))


def _blurred(image: FloatArray) -> FloatArray:
    """Gaussian means over the windows that lie in the image (H - 10, W - 10, 3)."""
    from scipy.ndimage import correlate1d

    weights = np.exp(-0.5 * np.square(np.arange(-_RADIUS, _RADIUS + 1) / _SIGMA))
    weights /= weights.sum()
    down = correlate1d(image, weights, axis=0)[_RADIUS : len(image) - _RADIUS]
    blurred: FloatArray = correlate1d(down, weights, axis=1)[:, _RADIUS : image.shape[1] - _RADIUS]
    return blurred


def _windows(counts: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Whether every pixel counts, of each window that lies in the image (H - 10, W - 10)."""
    from scipy.ndimage import minimum_filter1d

    height, width = counts.shape
    if min(height, width) <= 2 * _RADIUS:
        return np.zeros((0, 0), dtype=bool)
    size = 2 * _RADIUS + 1
    least = minimum_filter1d(minimum_filter1d(counts.astype(np.uint8), size, axis=0), size, axis=1)
    inside: NDArray[np.bool_] = least[_RADIUS : height - _RADIUS, _RADIUS : width - _RADIUS] > 0
    return inside
