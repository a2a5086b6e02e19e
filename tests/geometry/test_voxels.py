"""Voxel grids compared with sorting in numpy."""

import numpy as np
import pytest
from wording import check_error

from pcbench.geometry.voxels import cell_means, cells, voxel_downsample, voxel_downsample_to


def group_by_sorting(points, side, lower):
    cell_indices = np.clip(np.floor((points - lower) / side), -(2**31), 2**31 - 1)
    _, first, inverse, counts = np.unique(
        cell_indices, axis=0, return_index=True, return_inverse=True, return_counts=True
    )
    order = np.argsort(first)  # cells are numbered by their first points
    rank = np.argsort(order)
    return rank[inverse.ravel()], first[order], counts[order]


@pytest.mark.parametrize("count, side", [(1, 1.0), (63, 0.3), (5000, 0.02), (5000, 5.0), (40_000, 0.1)])
def test_cells_agree_with_sorting(count, side):
    rng = np.random.default_rng(count)
    points = rng.normal(size=(count, 3)) * [3, 1, 0.2] + [5e5, 4e6, 0]
    for lower in (points.min(axis=0), points.min(axis=0) + 0.7):
        for got, expected in zip(cells(points, side, lower), group_by_sorting(points, side, lower), strict=True):
            np.testing.assert_array_equal(got, expected)
    grid = cells(points, side)
    heights = [points[grid.of_point == cell, 2].mean() for cell in range(min(20, len(grid.first)))]
    np.testing.assert_allclose(grid.means(points[:, 2])[:20], heights, rtol=0, atol=1e-12)


def test_far_points_share_the_outermost_cells():
    points = np.array([[0.0, 0, 0], [1e90, 0, 0], [1e95, 0, 0], [-1e95, 0, 0]])
    np.testing.assert_array_equal(cells(points, 1.0, np.zeros(3)).of_point, [0, 1, 1, 2])
    with check_error():
        cells(points, 0.0)


@pytest.mark.parametrize("lower", [None, np.zeros(3)])
def test_rows_are_downsampled_as_a_copy_of_their_points(lower):
    rng = np.random.default_rng(3)
    points = rng.random((70_000, 3)) - 0.2
    rows = np.flatnonzero(rng.random(len(points)) < 0.98)  # more than one block of rows
    expected = rows[cells(points[rows], 0.05, lower).first]
    np.testing.assert_array_equal(voxel_downsample(points, 0.05, rows, lower), expected)
    np.testing.assert_array_equal(
        voxel_downsample_to(points, 500, 0.05, rows), rows[voxel_downsample_to(points[rows], 500, 0.05)]
    )


def test_downsampling_keeps_the_first_point_of_each_cell():
    points = np.array([[0.1, 0, 0], [0.9, 0, 0], [1.1, 0, 0], [0.2, 0, 0], [5, 0, 0]])
    np.testing.assert_array_equal(voxel_downsample(points, 1.0), [0, 2, 4])
    np.testing.assert_allclose(cell_means(points, 1.0, np.zeros(3))[:, 0], [0.4, 1.1, 5])
    cloud = np.random.default_rng(1).random((20_000, 3)) * [100, 100, 1]
    rows = voxel_downsample_to(cloud, 500, start=0.5)
    assert 250 < len(rows) <= 600
    assert (np.diff(rows) > 0).all()
