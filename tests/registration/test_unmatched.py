"""Points inside the other cloud without a counterpart: none at the right pose, also of parts that overlap little."""

import numpy as np
import pytest

from pcbench.geometry.neighbors import Index
from pcbench.geometry.normals import Surface
from pcbench.registration import Target
from pcbench.registration.unmatched import unmatched_share

STEP = 0.25
HALF_TURN = np.diag([-1.0, -1.0, 1.0])


def sample_room():
    """Return points on a grid on the walls of a cube of side 10, and on a column that stands 2.5 from two walls."""
    ticks = np.arange(-5, 5 + STEP / 2, STEP)
    grid = np.array(np.meshgrid(ticks, ticks, ticks)).reshape(3, -1).T
    walls = grid[np.abs(grid).max(axis=1) == 5]
    x, y = np.array(np.meshgrid([2.5, 2.75], [2.5, 2.75])).reshape(2, -1)
    column = np.column_stack([np.repeat(x, len(ticks)), np.repeat(y, len(ticks)), np.tile(ticks, 4)])
    return walls, column


@pytest.fixture(scope="module")
def room():
    walls, column = sample_room()
    return np.concatenate([walls, column])


def share(reference, candidate):
    return unmatched_share(Target(Surface(Index(reference))), candidate)


def test_equal_clouds_have_no_unmatched_points(room):
    assert share(room, room) == 0


def test_a_column_on_the_other_side_is_unmatched(room):
    """Both directions count the column's points that are farther than five spacings from the floor and the ceiling."""
    walls, column = sample_room()
    expected = np.count_nonzero(np.abs(column[:, 2]) < 5 - 5 * STEP)
    # All of the column is inside; of the walls at least none and at most all.
    assert expected / len(room) <= share(room, room @ HALF_TURN) <= expected / len(column)
    # One direction suffices: an empty room against one with a column.
    assert share(walls, room) == pytest.approx(
        share(room, walls), rel=0.02
    )  # the slabs are cut at slightly other places
    assert share(walls, room) > 0


@pytest.mark.parametrize("half_width", [1, 2.5])
def test_parts_that_overlap_little_match_inside_each_other(room, half_width):
    assert share(room[room[:, 0] <= half_width], room[room[:, 0] >= -half_width]) == 0


def test_strewn_outliers_do_not_count(room):
    rng = np.random.default_rng(0)
    outliers = rng.uniform(-5, 5, (len(room) // 10, 3))
    # Among 9 % of outliers only a few near the surfaces have enough neighbours.
    assert share(room, np.concatenate([room, outliers])) < 0.005
    assert share(np.concatenate([room, outliers]), room) < 0.005
    clump = rng.normal([0, 0, 0], 0.5, (len(room) // 10, 3))
    assert share(room, np.concatenate([room, clump])) > len(clump) / (len(room) + len(clump))  # some walls are cut off


def test_few_points_say_nothing(room):
    assert share(room, room[:20] @ HALF_TURN) == 0


def test_the_share_does_not_depend_on_the_unit(room):
    turned = room @ HALF_TURN
    assert share(1024 * room, 1024 * turned) == share(room, turned)  # a power of two, exact in floating point
