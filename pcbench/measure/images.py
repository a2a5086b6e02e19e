"""Similarity of a rendering to a photograph of the same view."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcbench.errors import InputError
from pcbench.geometry.arrays import FloatArray

_RADIUS_PX = 5  # the windows of SSIM have 11 x 11 pixels
_SIGMA_PX = 1.5
_C1, _C2 = 0.01**2, 0.03**2


@dataclass(frozen=True)
class ViewScores:
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
    """Return the peak signal-to-noise ratio in decibels.

    It is -10 log10 of the mean squared difference over all channels of all valid pixels, for a peak of 1. It is
    infinite for equal images and NaN without valid pixels.

    Args:
        image: (H, W, 3), uint8 or floating point from 0 to 1.
        reference: the same.
        mask: (H, W) valid pixels; None: all.

    Raises:
        InputError: the shapes differ or are invalid, or the values are neither uint8 nor floating point.
    """
    a, b, valid = _check_images(image, reference, mask)
    squares = np.square(a - b)[valid]
    if not squares.size:
        return float("nan")
    error = float(squares.mean())
    return float("inf") if error == 0 else -10 * float(np.log10(error))


def ssim(image: NDArray[Any], reference: NDArray[Any], mask: NDArray[np.bool_] | None = None) -> float:
    """Return the structural similarity (Wang, Bovik, Sheikh & Simoncelli 2004, "Image quality assessment").

    It is the mean over the channels and over all windows inside the image and its mask; NaN without such windows.
    Windows have 11 x 11 pixels with Gaussian weights, sigma 1.5; K1 = 0.01 and K2 = 0.03; covariances are population
    covariances. Without a mask this is scikit-image's `structural_similarity` with `gaussian_weights=True, sigma=1.5,
    use_sample_covariance=False, data_range=1, channel_axis=2`. The code of 3D Gaussian splatting (Kerbl et al. 2023)
    also includes windows that extend beyond the image, with both images padded with black.

    Args:
        image: (H, W, 3), uint8 or floating point from 0 to 1.
        reference: the same.
        mask: (H, W) valid pixels; None: all.

    Raises:
        InputError: the shapes differ or are invalid, or the values are neither uint8 nor floating point.
    """
    a, b, valid = _check_images(image, reference, mask)
    windows = _valid_windows(valid)
    if not windows.any():
        return float("nan")
    mean_a, mean_b = _window_means(a), _window_means(b)
    variance_a, variance_b = _window_means(a * a) - mean_a**2, _window_means(b * b) - mean_b**2
    covariance = _window_means(a * b) - mean_a * mean_b
    similarity = (2 * mean_a * mean_b + _C1) * (2 * covariance + _C2)
    similarity /= (mean_a**2 + mean_b**2 + _C1) * (variance_a + variance_b + _C2)
    return float(similarity[windows].mean())


def absolute_error(image: NDArray[Any], reference: NDArray[Any]) -> FloatArray:
    """Return the absolute difference (H, W) of each pixel, mean over its channels, in grey levels (0 to 255).

    Raises:
        InputError: the shapes differ or are invalid, or the values are neither uint8 nor floating point.
    """
    a, b, _ = _check_images(image, reference, None)
    error: FloatArray = 255 * np.abs(a - b).mean(axis=2)
    return error


def unit_range(image: NDArray[Any]) -> FloatArray:
    """Return an image (H, W, 3) as float64 from 0 to 1.

    Raises:
        InputError: the shape is invalid, or the values are neither uint8 nor floating point.
    """
    if image.ndim != 3 or image.shape[2] != 3:
        raise InputError(f"expected an image of shape (height, width, 3), got {image.shape}")
    if image.dtype == np.uint8:
        return image / 255.0
    if not np.issubdtype(image.dtype, np.floating):
        raise InputError(f"expected an image of uint8 or of floating point from 0 to 1, got {image.dtype}")
    return image.astype(np.float64)


def _check_images(
    image: NDArray[Any], reference: NDArray[Any], mask: NDArray[np.bool_] | None
) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
    a, b = unit_range(image), unit_range(reference)
    if a.shape != b.shape:
        raise InputError(f"expected two images of the same size, got {_size(a)} and {_size(b)} pixels")
    valid = np.ones(a.shape[:2], dtype=bool) if mask is None else mask
    if valid.shape != a.shape[:2] or valid.dtype != bool:
        raise InputError(f"expected a boolean mask of {_size(a)} pixels, got {valid.dtype}, {_size(valid)}")
    return a, b, valid


def _size(image: NDArray[Any]) -> str:
    return " x ".join(map(str, image.shape[1::-1]))


def _window_means(image: FloatArray) -> FloatArray:
    """Return the Gaussian means (H - 10, W - 10, 3) over the windows inside the image."""
    from scipy.ndimage import correlate1d

    weights = np.exp(-0.5 * np.square(np.arange(-_RADIUS_PX, _RADIUS_PX + 1) / _SIGMA_PX))
    weights /= weights.sum()
    down = correlate1d(image, weights, axis=0)[_RADIUS_PX : len(image) - _RADIUS_PX]
    means: FloatArray = correlate1d(down, weights, axis=1)[:, _RADIUS_PX : image.shape[1] - _RADIUS_PX]
    return means


def _valid_windows(valid: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return which windows (H - 10, W - 10) inside the image have only valid pixels."""
    from scipy.ndimage import minimum_filter1d

    height, width = valid.shape
    if min(height, width) <= 2 * _RADIUS_PX:
        return np.zeros((0, 0), dtype=bool)
    size = 2 * _RADIUS_PX + 1
    least = minimum_filter1d(minimum_filter1d(valid.astype(np.uint8), size, axis=0), size, axis=1)
    inside: NDArray[np.bool_] = least[_RADIUS_PX : height - _RADIUS_PX, _RADIUS_PX : width - _RADIUS_PX] > 0
    return inside
