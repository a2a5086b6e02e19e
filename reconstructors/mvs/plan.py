"""Matching effort: image size, sources and iterations, chosen from the desired point spacing and the images."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_MAX_SIDE_PX = 2000  # longer side of matched images if no spacing is given; larger ones are halved
_MIN_SIDE_PX = 240  # in smaller images most patches contain edges
_MIN_LEVEL_SIDE_PX = 60  # shorter side at the coarsest level
# Surface that few images observe is missed if these images are not sources of each other. In a city, the recall of
# surface that exactly three images observe was 0.43 with half as many sources and 0.57 with these; 50 % more added
# nothing.
MAX_SOURCES_PER_IMAGE = 8
_LOW_TEXTURE_SHARE = 0.5  # below this share of textured patches, depths must propagate further: one more iteration
_PATCH_SIDE_PX = 9
_MIN_TEXTURE_DEVIATION = 4.0  # standard deviation of the grey values in a textured patch


@dataclass(frozen=True)
class ImageSurvey:
    """Measurements of the images from which the matching plan is made.

    Args:
        side_px: median of the longer sides of the images.
        footprint: median size of a pixel on the surface, in the unit of the cameras.
        angle_deg: median triangulation angle between references and sources.
        overlap: median number of images that could be sources of an image.
        textured_share: share of the patches with texture.
    """

    side_px: int
    footprint: float
    angle_deg: float
    overlap: float
    textured_share: float


@dataclass(frozen=True)
class MatchingPlan:
    """Matching effort.

    Args:
        scale: scale of the matched images relative to the photographs.
        sources: maximum number of sources per image.
        levels: number of image sizes at which depths are searched, each half of the next.
        photometric_iterations: sweeps that compare photographs only.
        geometric_iterations: sweeps that also compare the depths of the sources.
        spacing: expected distance between points.
        reasons: explanations of the choices, one line each.
    """

    scale: float
    sources: int
    levels: int
    photometric_iterations: int
    geometric_iterations: int
    spacing: float
    reasons: tuple[str, ...]


def make_plan(survey: ImageSurvey, spacing: float | None, sources: int | None) -> MatchingPlan:
    """Plan the matching for a desired point spacing.

    Args:
        survey: measurements of the images.
        spacing: desired distance between points, in the unit of the cameras; None for images of up to 2000 pixels.
        sources: maximum number of sources per image; None for 8, or fewer if fewer overlap.
    """
    scale, why_scale = _choose_scale(survey, spacing)
    expected = survey.footprint / scale
    count, why_sources = (sources, "as requested") if sources else _choose_source_count(survey)
    iterations, why_iterations = 3, f"{survey.textured_share:.0%} of the patches have texture"
    if survey.textured_share < _LOW_TEXTURE_SHARE:
        iterations = 4
    side = max(1, round(scale * survey.side_px))
    levels = max(1, min(3, 1 + int(math.log2(max(1.0, 0.6 * side / _MIN_LEVEL_SIDE_PX)))))
    reasons = (
        f"images of {side} pixels along the longer side, {why_scale}: points about {expected:.3g} apart",
        f"up to {count} sources per image, {why_sources}",
        f"{iterations} + 2 iterations over {levels} levels: {why_iterations}",
    )
    return MatchingPlan(scale, count, levels, iterations, 2, expected, reasons)


def _choose_scale(survey: ImageSurvey, spacing: float | None) -> tuple[float, str]:
    if spacing is None:
        halvings = max(0, math.ceil(math.log2(survey.side_px / _MAX_SIDE_PX)))
        if not halvings:
            return 1.0, "their full size"
        return (
            0.5**halvings,
            f"1/{2**halvings} of their size, at most {_MAX_SIDE_PX} pixels (set spacing for denser or sparser points)",
        )
    wanted = survey.footprint / spacing
    least = min(1.0, _MIN_SIDE_PX / survey.side_px)
    if wanted > 1:
        return 1.0, f"their full size (the requested spacing of {spacing:.3g} is finer than the images allow)"
    if wanted < least:
        return least, f"the smallest size that can be matched (the requested spacing of {spacing:.3g} is coarser)"
    return wanted, f"{wanted:.2f} of their size, for the requested spacing of {spacing:.3g}"


def _choose_source_count(survey: ImageSurvey) -> tuple[int, str]:
    """Choose the number of sources: the maximum, or as many images as typically overlap."""
    angles = f"with a median triangulation angle of {survey.angle_deg:.0f} degrees"
    if survey.overlap < MAX_SOURCES_PER_IMAGE:
        return max(1, math.floor(survey.overlap)), f"{angles}; no more images overlap"
    return MAX_SOURCES_PER_IMAGE, angles


def measure_textured_share(images: Sequence[NDArray[np.uint8]]) -> float:
    """Return the share of the patches with texture in grey images (H, W)."""
    textured = total = 0
    for image in images:
        rows, columns = (size // _PATCH_SIDE_PX for size in image.shape)
        patches = image[: rows * _PATCH_SIDE_PX, : columns * _PATCH_SIDE_PX].reshape(
            rows, _PATCH_SIDE_PX, columns, _PATCH_SIDE_PX
        )
        deviations = patches.std(axis=(1, 3), dtype=np.float32)
        textured += int((deviations > _MIN_TEXTURE_DEVIATION).sum())
        total += deviations.size
    return textured / max(1, total)
