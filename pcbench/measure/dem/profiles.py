"""Heights of the epochs along a line."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pcbench.errors import InputError
from pcbench.geometry.arrays import FloatArray
from pcbench.measure.dem.difference import DemOfDifference
from pcbench.measure.dem.grid import HeightGrid
from pcbench.measure.dem.surface import EpochSurface

_STEPS_PER_CELL = 2


@dataclass(frozen=True, eq=False)
class Profile:
    """Heights along a line.

    Attributes:
        line: its ends x0, y0, x1, y1.
        distances: (N,) distances from the first end.
        heights: (E, N) heights of each epoch; NaN in voids.
        levels: (E - 1, N) level of detection of each difference to the first epoch.
    """

    line: tuple[float, float, float, float]
    distances: FloatArray
    heights: FloatArray
    levels: FloatArray


def profile_along(
    line: tuple[float, float, float, float],
    grid: HeightGrid,
    surfaces: Sequence[EpochSurface],
    differences: Sequence[DemOfDifference],
) -> Profile:
    """Return the heights of the cells along a line, twice per cell.

    Raises:
        InputError: the line does not meet the area that the epochs share.
    """
    start, end = np.array(line[:2]), np.array(line[2:])
    length = float(np.linalg.norm(end - start))
    shares = np.linspace(0, 1, max(2, round(_STEPS_PER_CELL * length / grid.cell) + 1))
    numbers = grid.numbers(start + shares[:, None] * (end - start))
    inside = numbers >= 0
    if not inside.any():
        raise InputError(
            f"expected --profile in the area of the epochs, {grid.extent_text()}, got"
            f" {','.join(f'{value:.10g}' for value in line)}"
        )

    def sampled(values: FloatArray) -> FloatArray:
        return np.where(inside, values.ravel()[np.maximum(numbers, 0)], np.nan)

    heights = np.stack([sampled(surface.heights) for surface in surfaces])
    levels = np.stack([sampled(difference.level_of_detection) for difference in differences])
    return Profile(line, shares * length, heights, levels)
