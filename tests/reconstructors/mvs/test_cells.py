"""Cells partition space: each point lies in exactly one."""

import numpy as np
import pytest

from reconstructors.mvs.cells import SPACE, SpaceCell, bounding_cell, split_space


def point_sets():
    rng = np.random.default_rng(3)
    strip = rng.uniform([0, 0, 0], [1000, 50, 10], (3000, 3))
    on_grid = rng.integers(0, 4, (2000, 3)).astype(float)  # many points on the borders of cells
    cluster = np.concatenate([np.zeros((500, 3)), rng.normal(0, 1, (40, 3))])
    return {
        "strip": strip,
        "grid": on_grid,
        "cluster": cluster,
        "one plane": strip * [1, 1, 0],
        "line": strip * [0, 0, 1],
    }


@pytest.mark.parametrize("name", point_sets())
def test_each_point_of_space_lies_in_exactly_one_cell(name):
    points = point_sets()[name]
    cells = split_space(points, lambda rows: len(rows) <= 100)
    assert len(cells) > 3
    borders = np.concatenate([[cell.lower, cell.upper] for cell in cells])
    on_borders = np.where(np.isfinite(borders), borders, 0.0)
    beside = [np.nextafter(on_borders, side * np.inf) for side in (-1, 1)]
    rng = np.random.default_rng(4)
    anywhere = np.concatenate(
        [points, on_borders, *beside, rng.normal(0, 1e6, (1000, 3)), rng.permuted(on_borders, axis=0)]
    )
    assert (sum(cell.contains(anywhere).astype(int) for cell in cells) == 1).all()
    # Only coinciding points may be more than asked for.
    for cell in cells:
        inside = points[cell.contains(points)]
        assert len(inside) > 0 and (len(inside) <= 100 or (inside == inside[0]).all())


def test_a_strip_is_cut_across_and_neighbors_follow_each_other():
    cells = split_space(point_sets()["strip"], lambda rows: len(rows) <= 400)
    assert len(cells) == 8
    borders = [cell.lower[0] for cell in cells[1:]]
    assert borders == sorted(borders) == [cell.upper[0] for cell in cells[:-1]]
    np.testing.assert_allclose(borders, np.arange(125, 1000, 125), atol=40)
    assert all(np.isinf([*cell.lower[1:], *cell.upper[1:]]).all() for cell in cells)


def test_outliers_do_not_choose_the_axis():
    points = point_sets()["strip"].copy()
    points[0, 2] = 1e6
    for cell in split_space(points, lambda rows: len(rows) <= 1500):
        assert np.isinf([cell.lower[2], cell.upper[2]]).all()


@pytest.mark.parametrize("points", [np.empty((0, 3)), np.ones((1, 3)), np.ones((1000, 3))], ids=len)
def test_points_that_cannot_be_separated_are_one_cell(points):
    assert split_space(points, lambda _: False) == [SPACE]


def test_boxes_meet_where_they_touch():
    box = bounding_cell(np.array([[0.0, 0, 0], [1, 2, 3]]))
    assert box.meets(SpaceCell(np.array([1.0, 2, 3]), np.full(3, 9.0)))
    assert not box.meets(SpaceCell(np.array([1.1, 0, 0]), np.full(3, 9.0)))
    assert box.grow(0.2).meets(SpaceCell(np.array([1.1, 0, 0]), np.full(3, 9.0)))
    assert box.meets(SPACE) and SPACE.grow(1.0).meets(box)
