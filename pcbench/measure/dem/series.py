"""Change over more than two epochs: the change of places, and the trend of each cell with its standard error."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import date

import numpy as np

from pcbench.errors import InputError
from pcbench.geometry.arrays import FloatArray
from pcbench.measure.dem.difference import LEVEL_Z, DemOfDifference
from pcbench.measure.dem.grid import HeightGrid
from pcbench.measure.dem.volumes import EstimatedChange

DAYS_PER_YEAR = 365.25


@dataclass(frozen=True)
class PlaceChange:
    """Change of height at a place between the first epoch and each later one.

    Attributes:
        place: x and y.
        changes: change of its cell for each later epoch; NaN in voids.
    """

    place: tuple[float, float]
    changes: tuple[EstimatedChange, ...]


@dataclass(frozen=True, eq=False)
class HeightTrend:
    """Straight line through the heights of each cell, in units of height per year, or per epoch without dates.

    Attributes:
        rate: (H, W) slope by weighted least squares; NaN with fewer than three epochs.
        sigma: (H, W) its standard error: the stated errors of the epochs, or their scatter about the line if that is
            larger.
        is_per_year: whether the epochs have dates.
    """

    rate: FloatArray
    sigma: FloatArray
    is_per_year: bool


def years(dates: Sequence[date | None]) -> FloatArray | None:
    """Return the times of epochs in years since the first; None if one has no date or two have the same."""
    if any(day is None for day in dates):
        return None
    days = np.array([day.toordinal() for day in dates if day is not None], dtype=float)
    if len(np.unique(days)) < len(days):
        return None
    times: FloatArray = (days - days[0]) / DAYS_PER_YEAR
    return times


def place_changes(
    places: Sequence[tuple[float, float]], grid: HeightGrid, differences: Sequence[DemOfDifference]
) -> list[PlaceChange]:
    """Return the change of places in each difference to the first epoch.

    Raises:
        InputError: a place is outside of the area that the epochs share.
    """
    result = []
    for place in places:
        number = int(grid.numbers(np.array([place]))[0])
        if number < 0:
            raise InputError(
                f"expected --point in the area of the epochs, {grid.extent_text()}, got"
                f" {','.join(f'{value:.10g}' for value in place)}"
            )
        changes = []
        for difference in differences:
            cell = divmod(number, grid.shape[1])
            value, sigma = float(difference.dz[cell]), float(difference.sigma[cell])
            changes.append(EstimatedChange.within(value, LEVEL_Z * sigma))
        result.append(PlaceChange(place, tuple(changes)))
    return result


def trend_of(differences: Sequence[DemOfDifference], times: FloatArray | None) -> HeightTrend | None:
    """Return the trend of each cell; None with fewer than three epochs.

    The first epoch is part of all differences, so its error is common to them. An unknown common height is estimated
    with the slope (equation of a line with an intercept), which takes that error out.

    Args:
        differences: differences of the later epochs to the first.
        times: times of all epochs in years; None: they are numbered.
    """
    if len(differences) < 2:
        return None
    at_epochs = np.arange(len(differences) + 1.0) if times is None else times
    shape = differences[0].dz.shape
    sums = [np.zeros(shape) for _ in range(5)]  # of weights, times, squared times, heights, products
    count = np.zeros(shape)
    heights = [np.where(np.isfinite(differences[0].dz), 0.0, np.nan), *(each.dz for each in differences)]
    first = np.minimum.reduce([np.nan_to_num(each.sigma, nan=np.inf) for each in differences]) / np.sqrt(2)
    sigmas = [first, *(np.sqrt(np.maximum(each.sigma**2 - first**2, first**2)) for each in differences)]
    weights = []
    for time, height, sigma in zip(at_epochs, heights, sigmas, strict=True):
        good = np.isfinite(height) & np.isfinite(sigma) & (sigma > 0)
        weight = np.where(good, 1 / np.where(good, sigma, 1.0) ** 2, 0.0)
        value = np.nan_to_num(height)
        weights.append(weight)
        count += good
        for total, term in zip(sums, (1.0, time, time * time, value, time * value), strict=True):
            total += weight * term
    w, t, tt, z, tz = sums
    with np.errstate(divide="ignore", invalid="ignore"):
        determinant = w * tt - t * t
        rate = (w * tz - t * z) / determinant
        level = (z - rate * t) / w
        variance = w / determinant
        misfit = np.zeros(shape)
        for time, height, weight in zip(at_epochs, heights, weights, strict=True):
            misfit += weight * np.nan_to_num(height - level - rate * time) ** 2
        scale = np.maximum(misfit / np.maximum(count - 2, 1), 1.0)
    usable = (count >= 3) & (determinant > 0)  # rounding can turn the sign where errors differ extremely
    return HeightTrend(
        np.where(usable, rate, np.nan), np.sqrt(np.where(usable, variance * scale, np.nan)), times is not None
    )
