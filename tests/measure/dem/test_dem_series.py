"""The trend of cells and the change of places over several epochs."""

from datetime import date

import numpy as np
import pytest
from wording import check_error

from pcbench.measure.dem.difference import LEVEL_Z, DemOfDifference, difference_of
from pcbench.measure.dem.grid import HeightGrid
from pcbench.measure.dem.series import place_changes, trend_of, years
from pcbench.measure.dem.surface import EpochSurface

GRID = HeightGrid.over(np.zeros(2), np.full(2, 4.9), 1.0)  # too small for an estimate of errors
TIMES = np.array([0.0, 1.0, 1.5, 4.0])


def _differences(heights: np.ndarray, variances: np.ndarray) -> list[DemOfDifference]:
    """Return the differences of the later epochs (E, H, W) to the first, with a variance for each epoch."""
    surfaces = [
        EpochSurface(z, np.where(np.isfinite(z), variance, np.nan), np.where(np.isfinite(z), 5, 0).astype(np.int32))
        for z, variance in zip(heights, variances, strict=True)
    ]
    return [difference_of(GRID, surfaces[0], surface) for surface in surfaces[1:]]


def _heights(spread: float) -> np.ndarray:
    return spread * np.random.default_rng(2).standard_normal((len(TIMES), *GRID.shape))


def test_trend_is_the_line_of_least_squares() -> None:
    heights = _heights(0.1)
    trend = trend_of(_differences(heights, np.full(4, 1e-4)), TIMES)
    assert trend is not None and trend.is_per_year
    lines, covariance = np.polyfit(TIMES, heights.reshape(4, -1), 1, cov=True)
    np.testing.assert_allclose(trend.rate.ravel(), lines[0], rtol=1e-9)
    # The heights scatter more than their stated errors, so that the scatter about the line is the error.
    np.testing.assert_allclose(trend.sigma.ravel() ** 2, covariance[0, 0], rtol=1e-9)


def test_stated_errors_are_the_least_of_a_trend() -> None:
    trend = trend_of(_differences(_heights(1e-6), np.full(4, 0.01)), TIMES)
    assert trend is not None
    expected = 0.1 / np.sqrt(((TIMES - TIMES.mean()) ** 2).sum())
    np.testing.assert_allclose(trend.sigma, expected, rtol=1e-9)


def test_trend_with_a_void() -> None:
    heights = _heights(0.1)
    heights[2, 1, 3] = np.nan
    heights[1:3, 2, 2] = np.nan  # two epochs are left
    heights[0, 4, 4] = np.nan  # no difference is left
    trend = trend_of(_differences(heights, np.full(4, 1e-4)), TIMES)
    assert trend is not None
    left = [0, 1, 3]
    assert trend.rate[1, 3] == pytest.approx(np.polyfit(TIMES[left], heights[left, 1, 3], 1)[0])
    assert np.isnan(trend.rate[[2, 4], [2, 4]]).all() and np.isnan(trend.sigma[[2, 4], [2, 4]]).all()
    assert np.isfinite(trend.rate).sum() == GRID.size - 2


def test_trend_without_dates_and_of_two_epochs() -> None:
    differences = _differences(_heights(0.1), np.full(4, 1e-4))
    trend = trend_of(differences, None)
    assert trend is not None and not trend.is_per_year
    heights = np.stack([np.zeros(GRID.shape), *(each.dz for each in differences)])
    np.testing.assert_allclose(trend.rate.ravel(), np.polyfit(np.arange(4), heights.reshape(4, -1), 1)[0], rtol=1e-9)
    assert trend_of(differences[:1], TIMES[:2]) is None


def test_change_of_places() -> None:
    heights = _heights(0.1)
    heights[2, 0, 1] = np.nan
    differences = _differences(heights, np.full(4, 0.01))
    (inside,) = place_changes([(1.5, 4.5)], GRID, differences)
    value, low, high = inside.changes[0]
    assert value == pytest.approx(heights[1, 0, 1] - heights[0, 0, 1])
    assert (high - low) / 2 == pytest.approx(LEVEL_Z * np.sqrt(0.02))
    assert np.isnan(inside.changes[1]).all()
    with check_error():
        place_changes([(9.0, 9.0)], GRID, differences)


def test_years_since_the_first_epoch() -> None:
    days = [date(2020, 1, 1), date(2021, 1, 1), date(2024, 1, 1)]
    assert years(days) == pytest.approx([0, 366 / 365.25, 4])
    assert years([*days, None]) is None
    assert years([*days, days[0]]) is None
