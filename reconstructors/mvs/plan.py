"""How much is done: the size of the images, the number of sources and of iterations, from the spacing of points that is
wanted and from what the images can give.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_MOST_SIDE = 2000  # pixels of the images that are matched, where no spacing is asked for: half of larger ones, or less
_LEAST_SIDE = 240  # a shorter image shows patches of nothing but edges
_LEAST_LEVEL = 60  # pixels of the shorter side at the coarsest level
# What few images show is missed where most of these are no sources of each other: in a city 0.43 of what three show was
# there with half as many sources, 0.57 with these. Half as many again added nothing.
MOST_SOURCES = 8
_POOR = 0.5  # share of textured patches: with less, depths have further to go from where they are found
_PATCH, _FLAT = 9, 4.0  # pixels along a patch; standard deviation of grey values in a patch without texture


@dataclass(frozen=True)
class ImageSurvey:
    """What the images can give.

    Args:
        side: pixels of the longer side of the images, median.
        footprint: of a pixel at the sparse points, median, in the units of the cameras.
        angle_deg: at which sources and references see points, median.
        overlap: images that could be sources of an image, median.
        textured: share of the patches that are not flat.
    """

    side: int
    footprint: float
    angle_deg: float
    overlap: float
    textured: float


@dataclass(frozen=True)
class MatchingPlan:
    """How much is done.

    Args:
        scale: of the images that are matched.
        sources: of each image, at most.
        levels: sizes at which depths are looked for, each half of the next.
        iterations: by the photographs alone.
        geometric: with the depths of the sources.
        spacing: of the points that are expected.
        reasons: of the choice, a line each.
    """

    scale: float
    sources: int
    levels: int
    iterations: int
    geometric: int
    spacing: float
    reasons: tuple[str, ...]


def make_plan(survey: ImageSurvey, spacing: float | None, sources: int | None) -> MatchingPlan:
    """How much is done for points so far apart.

    Args:
        spacing: in the units of the cameras; None for what images of up to 2000 pixels give.
        sources: None for as many as are of use, as far as images overlap.
    """
    scale, why_scale = _scale(survey, spacing)
    expected = survey.footprint / scale
    count, why_sources = (sources, "as asked for") if sources else _sources(survey)
    iterations, why_iterations = 3, f"{survey.textured:.0%} of the patches have texture"
    if survey.textured < _POOR:
        iterations = 4
    side = max(1, round(scale * survey.side))
    levels = max(1, min(3, 1 + int(math.log2(max(1.0, 0.6 * side / _LEAST_LEVEL)))))
    reasons = (
        f"images of {side} pixels along the longer side, {why_scale}: points about {expected:.3g} apart",
        f"up to {count} sources an image, {why_sources}",
        f"{iterations} + 2 iterations over {levels} levels: {why_iterations}",
    )
    return MatchingPlan(scale, count, levels, iterations, 2, expected, reasons)


def _scale(survey: ImageSurvey, spacing: float | None) -> tuple[float, str]:
    if spacing is None:
        halvings = max(0, math.ceil(math.log2(survey.side / _MOST_SIDE)))
        if not halvings:
            return 1.0, "their full size"
        return (
            0.5**halvings,
            f"1/{2**halvings} of their size, to be at most {_MOST_SIDE} (spacing asks for more or less)",
        )
    wanted = survey.footprint / spacing
    least = min(1.0, _LEAST_SIDE / survey.side)
    if wanted > 1:
        return 1.0, f"their full size (a spacing of {spacing:.3g} is finer)"
    if wanted < least:
        return least, f"the smallest that can be matched (a spacing of {spacing:.3g} is coarser)"
    return wanted, f"{wanted:.2f} of their size, as a spacing of {spacing:.3g} asks for"


def _sources(survey: ImageSurvey) -> tuple[int, str]:
    """So many that what few images show is matched with those that show it, as far as images overlap."""
    seen = f"they see points at {survey.angle_deg:.0f} degrees (median)"
    if survey.overlap < MOST_SOURCES:
        return max(1, math.floor(survey.overlap)), f"{seen}, and no more overlap"
    return MOST_SOURCES, seen


def textured_share(images: Sequence[NDArray[np.uint8]]) -> float:
    """The share of the patches of grey images (H, W) that are not flat."""
    textured = total = 0
    for image in images:
        rows, columns = (size // _PATCH for size in image.shape)
        patches = image[: rows * _PATCH, : columns * _PATCH].reshape(rows, _PATCH, columns, _PATCH)
        deviations = patches.std(axis=(1, 3), dtype=np.float32)
        textured += int((deviations > _FLAT).sum())
        total += deviations.size
    return textured / max(1, total)
