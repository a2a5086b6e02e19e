"""Cells of a grid and the heights of their points, against slow oracles."""

import numpy as np
import pytest
from scipy.interpolate import LinearNDInterpolator

from pcbench.errors import InputError
from pcbench.measure.dem.grid import CellMoments, HeightGrid, default_cell
from pcbench.measure.dem.surface import EpochSurface, GridMethod, lowest_offset, slopes_deg, surface_of


def _points(count: int = 900) -> np.ndarray:
    rng = np.random.default_rng(3)
    points = rng.uniform(0, 9.999, (count, 3))
    points[:, 2] = 0.5 * points[:, 0] + rng.standard_normal(count)
    return points


GRID = HeightGrid.over(np.zeros(2), np.full(2, 9.999), 1.0)


def test_cells_are_numbered_from_north_west_and_aligned_with_multiples_of_their_edge() -> None:
    grid = HeightGrid.over(np.array([12.1, 7.3]), np.array([15.0, 8.9]), 0.5)
    assert (grid.west, grid.north, grid.shape) == (12.0, 9.0, (4, 7))
    corners = np.array([[12.0, 8.5], [12.0, 8.999], [12.5, 8.5], [12.0, 7.0], [11.9, 8.0], [15.5, 8.0], [13.0, 9.0]])
    assert grid.numbers(corners).tolist() == [0, 0, 1, 21, -1, -1, -1]
    assert grid.numbers(grid.centres()).tolist() == list(range(grid.size))


def test_too_many_cells_are_refused() -> None:
    with pytest.raises(InputError, match="choose larger cells"):
        HeightGrid.over(np.zeros(2), np.full(2, 1e6), 0.1)


@pytest.mark.parametrize(("density", "cell"), [(4.0, 1.0), (3.9, 2.0), (400.0, 0.1), (0.04, 10.0), (0.9, 5.0)])
def test_default_cell_holds_four_points_on_average(density: float, cell: float) -> None:
    assert default_cell(1e6, density) == pytest.approx(cell)


def test_default_cell_of_a_small_area_holds_fewer_points() -> None:
    assert default_cell(1600.0, 0.5) == 2.0  # 5 with four points per cell, which leaves 64 cells
    assert default_cell(100.0, 0.01) == 10.0


def test_moments_do_not_depend_on_pieces_or_order() -> None:
    points = np.round(_points() * 256) / 256  # so that sums are exact
    whole = CellMoments(GRID, 1.0).add(points)
    parts = CellMoments(GRID, 1.0)
    for piece in np.array_split(points[::-1], 7):
        parts.add(piece)
    for name in ("counts", "sums", "squares", "lowest"):
        assert np.array_equal(getattr(whole, name), getattr(parts, name)), name


@pytest.mark.parametrize(
    ("method", "oracle"), [(GridMethod.MEAN, np.mean), (GridMethod.MEDIAN, np.median), (GridMethod.LOWEST, np.min)]
)
def test_heights_of_cells(method: GridMethod, oracle) -> None:
    points = _points()
    heights = surface_of(CellMoments(GRID, 2.0).add(points), method, points).heights
    numbers = GRID.numbers(points)
    expected = [oracle(points[numbers == k, 2]) for k in range(GRID.size)]
    np.testing.assert_allclose(heights.ravel(), expected, atol=1e-12)  # sums of tens of numbers of size 10


def test_triangulated_heights() -> None:
    points = _points(300)
    heights = surface_of(CellMoments(GRID, 0.0).add(points), GridMethod.TIN, points).heights.ravel()
    expected = LinearNDInterpolator(points[:, :2], points[:, 2])(GRID.centres())
    assert np.isfinite(heights).sum() > 90
    np.testing.assert_allclose(heights, expected, atol=1e-9)  # no triangle of these points is long


def test_each_triangle_has_heights() -> None:
    grid = HeightGrid.over(np.zeros(2), np.full(2, 2 - 1e-6), 1.0)
    points = np.array([[0.0, 0, 1], [2, 0, 5], [0, 2, -1], [2, 2, 3]])  # two triangles on a plane
    heights = surface_of(CellMoments(grid, 0.0).add(points), GridMethod.TIN, points).heights
    np.testing.assert_allclose(heights.ravel(), 1 + grid.centres() @ [2, -1], atol=1e-12)


def test_slopes_of_a_plane_with_a_void() -> None:
    rows, columns = np.mgrid[:6, :7]
    heights = 2.0 * (0.3 * rows - 0.4 * columns)
    heights[2, 3] = np.nan
    np.testing.assert_allclose(slopes_deg(heights, 2.0)[heights == heights], np.degrees(np.arctan(0.5)))


def test_variances_of_means_are_those_of_repeated_points() -> None:
    rng = np.random.default_rng(5)
    means, stated = [], []
    for _ in range(40):
        points = rng.uniform(0, 9.999, (600, 3))
        points[:, 2] = 0.2 * rng.standard_normal(600)
        surface = surface_of(CellMoments(GRID, 0.0).add(points), GridMethod.MEAN)
        means.append(surface.heights)
        stated.append(surface.variances)
    ratio = np.nanmean(np.square(means)) / np.nanmean(stated)
    assert 0.9 < ratio < 1.1  # 4,000 independent cells: standard error 2 %


def test_offset_of_the_lowest_points() -> None:
    """Expected minima of 5 and 6 normal values are 1.163 and 1.267 standard deviations below the mean (Harter 1961)."""
    variances = np.full((2, 2), 0.25)
    five, six = (EpochSurface(np.zeros((2, 2)), variances, np.full((2, 2), n, np.int32)) for n in (5, 6))
    # Blom's approximation is within 2 % of the exact minima of these numbers of points.
    assert lowest_offset(six, five) == pytest.approx(0.5 * (1.2672 - 1.1630), rel=0.05)
    assert lowest_offset(five, six) == -lowest_offset(six, five)
