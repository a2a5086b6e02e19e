"""Choose the steps and offsets with which LAS stores coordinates as 32-bit integers."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.errors import InputError
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.crs import METRES_PER_DEGREE, is_in_degrees
from pcbench.geometry.neighbors import Index
from pcbench.geometry.sampling import median_spacing
from pcbench.io.files import Warn
from pcbench.io.las_records import AXES

_LARGEST_INTEGER = 2**31 - 1
_MAX_STEP, _MAX_STEP_DEG = 1e-4, 1e-9  # both are 0.1 mm, if lengths are in metres
_EXTENT_DIGITS = 7  # a step is at most this power of ten below the extent of its axis
_SPACING_SHARE = 1e-3  # likewise of the point spacing
_NOTABLE_SPACING_SHARE = 0.1  # of the point spacing: larger rounding is reported
_SAMPLE_POINTS = 20_000
_OFFSET_DIGITS = 8  # offsets are decimals of at most this many powers of ten above the step, so they take few integers
_LEAST_EXTENT = 1e-290  # smaller ones have no decimal step


class LasGrid(NamedTuple):
    """Coordinates as LAS stores them.

    Attributes:
        steps: steps of x, y and z, in the cloud's unit.
        offsets: offsets of x, y and z.
        integers: (N, 3) coordinates, in steps from the offsets.
    """

    steps: tuple[float, float, float]
    offsets: tuple[float, float, float]
    integers: NDArray[np.int32]


def choose_grid(cloud: Cloud, warn: Warn) -> LasGrid:
    """Return the coordinates of a cloud in steps that are fine enough for it.

    A cloud from a LAS file keeps the file's steps and offsets, which reproduce its coordinates. Otherwise each axis has
    its own step, a power of ten: at most a ten-millionth of the axis's extent, a thousandth of the point spacing, and
    0.0001 units (1e-9 degrees). It is larger only where 32 bits require it. An axis of one value is stored exactly.

    Args:
        cloud: cloud to write.
        warn: called if rounding moves points by more than a tenth of the spacing.

    Raises:
        InputError: rounding would move points by more than the spacing.
    """
    if cloud.stored is not None:
        steps, offsets = (abs(step) for step in cloud.stored.steps), cloud.stored.offsets
        columns = [_round(*axis) for axis in zip(cloud.points.T, steps, offsets, strict=True)]
        precision = [4 * np.spacing(np.abs(values).max()) for values in cloud.points.T]
        if all(column.fits and column.error <= least for column, least in zip(columns, precision, strict=True)):
            return _grid(columns)
    spacings = _spacings(cloud)
    in_degrees = is_in_degrees(cloud.crs, cloud.unit)
    largest = (_MAX_STEP_DEG, _MAX_STEP_DEG, _MAX_STEP) if in_degrees else (_MAX_STEP,) * 3
    columns = []
    for values, low, high, spacing, most in zip(cloud.points.T, *cloud.bounds, spacings, largest, strict=True):
        step = _choose_step(float(low), float(high), spacing, most)
        # An axis of one value is its offset.
        digits = _OFFSET_DIGITS + math.floor(math.log10(step))
        offset = float(low) if high - low < _LEAST_EXTENT else round(float(low / 2 + high / 2), max(-digits, 0))
        columns.append(_round(values, step, offset))
    _check_rounding(columns, spacings, cloud.unit, warn)
    return _grid(columns)


class _StoredAxis(NamedTuple):
    step: float
    offset: float
    numbers: FloatArray  # whole numbers (N,)
    error: float  # the largest distance by which rounding moves a point

    @property
    def fits(self) -> bool:
        """Return whether the numbers fit into 32 bits."""
        return bool(self.numbers.min() >= -_LARGEST_INTEGER - 1 and self.numbers.max() <= _LARGEST_INTEGER)


def _round(values: FloatArray, step: float, offset: float) -> _StoredAxis:
    numbers = np.rint((values - offset) / step)
    return _StoredAxis(step, offset, numbers, float(np.abs(numbers * step + offset - values).max()))


def _grid(columns: list[_StoredAxis]) -> LasGrid:
    (x, y, z), (x0, y0, z0) = [column.step for column in columns], [column.offset for column in columns]
    return LasGrid((x, y, z), (x0, y0, z0), np.stack([column.numbers for column in columns], axis=1).astype(np.int32))


def _choose_step(low: float, high: float, spacing: float, most: float) -> float:
    extent = high - low
    if extent < _LEAST_EXTENT:
        return most
    step = min(most, _power_of_ten(extent) * 10.0**-_EXTENT_DIGITS)
    if spacing > 0:
        step = min(step, _power_of_ten(_SPACING_SHARE * spacing))
    # Coordinates have no finer digits, and 32 bits no more of them.
    least = extent / 2 / (_LARGEST_INTEGER - 10**_OFFSET_DIGITS / 2)
    return max(float(f"{step:.0e}"), _power_of_ten(float(np.spacing(max(abs(low), abs(high))))), _round_up(least))


def _power_of_ten(value: float) -> float:
    """Return the largest power of ten that is not above a positive number."""
    return float(f"1e{math.floor(math.log10(value))}")


def _round_up(value: float) -> float:
    """Return the smallest 1, 2 or 5 times a power of ten that is not below a positive number."""
    below = math.floor(math.log10(value))
    return next(step for factor in (1, 2, 5, 10) if (step := float(f"{factor}e{below}")) >= value)


def _spacings(cloud: Cloud) -> list[float]:
    """Return the point spacing in the units of x, y and z, of large clouds from a sample; 0 if there is none."""
    thinned = cloud.points[:: -(-len(cloud) // _SAMPLE_POINTS)]
    centre = np.median(thinned, axis=0)
    lengths = np.ones(3)  # of the units
    if is_in_degrees(cloud.crs, cloud.unit):
        # Poles have no longitude, so parallels are not taken to be shorter than at 89.9 degrees.
        parallel = math.cos(math.radians(min(abs(float(centre[1])), 89.9)))
        lengths = np.array([parallel * METRES_PER_DEGREE, METRES_PER_DEGREE, 1.0])
    spacing = median_spacing(Index((thinned - centre) * lengths))
    # The points of a surface are sqrt(n) times as close if there are n times as many.
    return [float(spacing * math.sqrt(len(thinned) / len(cloud)) / length) for length in lengths]


def _check_rounding(columns: list[_StoredAxis], spacings: list[float], unit: str | None, warn: Warn) -> None:
    shares = [column.error / spacing if spacing > 0 else 0.0 for column, spacing in zip(columns, spacings, strict=True)]
    worst = int(np.argmax(shares))
    if shares[worst] <= _NOTABLE_SPACING_SHARE:
        return
    axis, column, spacing = AXES[worst].lower(), columns[worst], spacings[worst]
    units = f" {unit}" if unit and unit != "deg" else ""
    text = (
        f"LAS stores {axis} in steps of {column.step:g}{units}, since its range needs 32 bits: points move by up to"
        f" {column.error:.3g}{units}, but are {spacing:.3g}{units} apart"
    )
    if shares[worst] > 1:
        raise InputError(f"{text}: remove outliers with pcbench crop, or write a .ply")
    warn(f"{text}: to keep them, remove outliers with pcbench crop, or write a .ply")
