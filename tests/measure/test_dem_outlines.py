"""Outlines of areas of cells, and volumes along normals."""

import numpy as np
import pytest

from pcbench.geometry.regions import Polygon
from pcbench.measure.dem.along_normals import volume_along_normals
from pcbench.measure.dem.grid import HeightGrid
from pcbench.measure.dem.outlines import outlines_of


@pytest.mark.parametrize("share", [0.2, 0.5, 0.8])
def test_outlines_contain_exactly_the_cells(share):
    grid = HeightGrid(100.0, 200.0, 2.0, (30, 40))
    mask = np.random.default_rng(round(10 * share)).random(grid.shape) < share
    centres = np.column_stack([grid.centres(), np.zeros(grid.size)])
    inside = np.zeros(grid.size, dtype=int)
    for outline in outlines_of(mask, grid):
        inside += Polygon((outline.outer, *outline.holes)).contains(centres)
    assert (inside.reshape(grid.shape) == mask).all()


def test_an_outline_has_corners_only_where_it_turns():
    grid = HeightGrid(0.0, 10.0, 1.0, (10, 10))
    mask = np.zeros(grid.shape, dtype=bool)
    mask[2:8, 1:9] = True
    mask[4:6, 3:5] = False
    (outline,) = outlines_of(mask, grid)
    assert sorted(map(tuple, outline.outer)) == [(1, 2), (1, 8), (9, 2), (9, 8)]
    assert sorted(map(tuple, outline.holes[0])) == [(3, 4), (3, 6), (5, 4), (5, 6)]


@pytest.mark.parametrize("tilt_deg", [0.0, 35.0, 90.0])
def test_the_volume_along_normals_is_that_of_the_moved_surface(tilt_deg):
    """A rough surface of 20 by 12 moves by 0.2 along its normal, whichever way it faces."""
    rng = np.random.default_rng(1)
    slope = np.radians(tilt_deg)
    rotation = np.array([[1, 0, 0], [0, np.cos(slope), -np.sin(slope)], [0, np.sin(slope), np.cos(slope)]])

    def surface(height):
        x, y = rng.uniform(0, [[20], [12]], (2, 6000))
        return np.column_stack([x, y, height + rng.normal(0, 0.02, x.size)]) @ rotation.T

    result = volume_along_normals(surface(0.0), surface(0.2))
    net = abs(result.volumes.net.value)
    # The cubes at the border of the surface are whole, and each side has one of them: 4 * side * 32 / 2 at most.
    assert 0.97 * 48 < net < 0.2 * (240 + result.side * 64)
    assert result.steep_share == (1.0 if tilt_deg == 90.0 else 0.0)


def test_the_interval_along_normals_is_that_of_the_net_alone():
    """Without change, sums by sign are the errors' size, which no interval about them tells."""
    rng = np.random.default_rng(3)
    first, second = (np.column_stack([rng.uniform(0, [20, 12], (6000, 2)), rng.normal(0, 0.02, 6000)]) for _ in "ab")
    volumes = volume_along_normals(first, second).volumes
    assert volumes.net.low < 0 < volumes.net.high
    assert volumes.fill.value > 0 and np.isnan(volumes.fill.low)
    assert volumes.cut.value > 0 and np.isnan(volumes.cut.high)


def test_a_cliff_faces_away_from_the_rock():
    """Between a foot and a top, a vertical wall of 10 by 12 moves outwards by 0.4: the volume is added."""
    rng = np.random.default_rng(2)

    def cliff(wall):
        parts = []
        for count, low, high in (
            (5000, (0, 0), (wall, 0)),
            (5000, (wall, 0), (wall, 10)),
            (5000, (wall, 10), (20, 10)),
        ):
            x, z = (np.array(low) + rng.random((count, 1)) * (np.array(high) - np.array(low))).T
            parts.append(np.column_stack([x, rng.uniform(0, 12, count), z]))
        points = np.concatenate(parts)
        return points + rng.normal(0, 0.01, points.shape)

    result = volume_along_normals(cliff(10.0), cliff(9.6))
    # The edges above and below are rounded by the cylinders, whose diameter is a twentieth of the wall's height each.
    assert result.volumes.net.value == pytest.approx(0.4 * 10 * 12, rel=0.15)
    assert 0.2 < result.steep_share < 0.5
