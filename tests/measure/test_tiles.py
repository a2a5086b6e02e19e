"""Deviations by tile, against a loop over the tiles."""

from dataclasses import replace

import numpy as np
import pytest

from pcbench.measure.tiles import MIN_TILE_POINTS, TileGrid, deviations_by_tile


def scene(count=20_000, seed=0):
    """Return points of a slab far from the origin, with signed values, some of them unknown."""
    rng = np.random.default_rng(seed)
    points = rng.uniform([0, 0, 0], [40, 25, 3], (count, 3)) + [500_000, 5_000_000, 100]
    values = rng.normal(0.01 * (points[:, 0] - 500_000), 0.1)
    values[rng.random(count) < 0.05] = np.nan
    return points, values


def test_statistics_are_those_of_a_loop_over_the_tiles():
    points, values = scene()
    grid = TileGrid.covering(points.min(axis=0), points.max(axis=0), 5.0)
    assert grid.axes == (0, 1) and grid.shape == (8, 5)
    found = {deviations.tile: deviations for deviations in deviations_by_tile(grid, points, values)}
    assert len(found) == 40
    for column in range(8):
        for row in range(5):
            low = np.array([500_000 + 5 * column, 5_000_000 + 5 * row])
            inside = ((points[:, :2] >= low) & (points[:, :2] < low + 5)).all(axis=1) & np.isfinite(values)
            tile, here = found[column + 8 * row], values[inside]
            assert tile.count == np.count_nonzero(inside)
            assert tile.at == (*(low + 2.5), np.median(points[inside, 2]))
            assert tile.median == np.median(here)
            assert tile.nmad == pytest.approx(1.4826 * np.median(np.abs(here - np.median(here))), rel=1e-4)
            assert tile.p95 == np.percentile(np.abs(here), 95)


def test_the_worst_tile_comes_first():
    points, values = scene()
    grid = TileGrid.covering(points.min(axis=0), points.max(axis=0), 5.0)
    found = deviations_by_tile(grid, points, values)
    assert [tile.p95 for tile in found] == sorted((tile.p95 for tile in found), reverse=True)
    assert found[0].at[0] == 500_037.5  # the values grow along x


def test_tiles_lie_along_the_two_longest_axes():
    points, values = scene()
    upright = points[:, [2, 0, 1]]
    grid = TileGrid.covering(upright.min(axis=0), upright.max(axis=0), 5.0)
    assert grid.axes == (1, 2)
    turned, plain = (
        deviations_by_tile(TileGrid.covering(p.min(axis=0), p.max(axis=0), 5.0), p, values) for p in (upright, points)
    )
    assert [replace(tile, at=(tile.at[1], tile.at[2], tile.at[0])) for tile in turned] == plain


def test_sparse_tiles_and_points_outside_the_grid_are_left_out():
    points, values = scene(MIN_TILE_POINTS, seed=1)
    points[:, :2] = [500_001, 5_000_001]
    grid = TileGrid.covering(np.array([500_000, 5_000_000, 100.0]), np.array([500_010, 5_000_010, 101.0]), 5.0)
    known = np.zeros(len(values))
    assert [tile.count for tile in deviations_by_tile(grid, points, known)] == [MIN_TILE_POINTS]
    points[0, 0] += 1000
    assert deviations_by_tile(grid, points, known) == []
    assert deviations_by_tile(grid, points[:0], known[:0]) == []
    assert deviations_by_tile(grid, points, np.full(len(values), np.nan)) == []


def test_a_flat_box_has_one_row_of_tiles():
    grid = TileGrid.covering(np.array([0.0, 3, 0]), np.array([10.0, 3, 0]), 5.0)
    assert grid.axes == (0, 1) and grid.shape == (2, 1)
    assert grid.tiles_of(np.array([[1.0, 3, 0], [7, 3.5, 9], [7, 9, 0], [np.nan, 3, 0]])).tolist() == [0, 1, -1, -1]
