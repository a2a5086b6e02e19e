"""Frames and windows of pictures, and points drawn as images."""

import numpy as np
import pytest

from pcbench import Cloud
from pcbench.report.plot.maps import frame
from pcbench.report.plot.splats import splat
from pcbench.report.plot.views import VIEWS, AxisBox, Frame, Viewpoint, round_length

GROUND = np.array([10, 20, 30], np.uint8)
ABOVE = VIEWS[0]


def cube(size, *, at=(0.0, 0.0, 0.0), points=5000, seed=0):
    return Cloud(np.random.default_rng(seed).uniform(-0.5, 0.5, (points, 3)) * size + np.array(at))


def test_the_frame_is_that_of_the_measured_region():
    reference, good = cube([10, 20, 4]), cube([10, 20, 4], seed=1)
    found = frame(reference, {"good": good})
    np.testing.assert_allclose(found.box.high - found.box.low, [11, 22, 4.4], rtol=0.03)
    above = found.sizes[0]
    assert above[0] / above[1] == pytest.approx(0.5, abs=0.05)


@pytest.mark.parametrize("far", [cube([500, 500, 500], seed=2), cube([10, 20, 4], at=(300, 0, 0), seed=3)])
def test_a_distant_candidate_does_not_change_the_frame(far):
    reference, good = cube([10, 20, 4]), cube([10, 20, 4], seed=1)
    alone, with_far = frame(reference, {"good": good}), frame(reference, {"good": good, "far": far})
    np.testing.assert_array_equal(alone.windows, with_far.windows)


def test_the_frame_extends_by_at_most_a_quarter_beyond_the_reference():
    reference, wider = cube([10, 20, 4]), cube([13, 20, 4], seed=1)
    found = frame(reference, {"wider": wider})
    assert found.box.high[0] > 6.4
    much_wider = frame(reference, {"wider": cube([18, 20, 4], seed=1)})
    assert much_wider.box.high[0] == pytest.approx(5.5 + 0.25 * 11, rel=0.03)


def test_outliers_do_not_widen_the_frame():
    points = np.concatenate([cube([10, 10, 10]).points, [[1e5, 0, 0], [0, -1e6, 0]]])
    assert AxisBox.around(points).high.max() < 6


def test_a_wall_and_a_point_still_get_windows():
    wall = cube([10, 0, 4]).points
    assert (Frame.of(AxisBox.around(wall), [wall]).sizes > 0.1).all()
    point = np.zeros((1, 3))
    assert np.isfinite(Frame.of(AxisBox.around(point), [point]).windows).all()
    assert (Frame.of(AxisBox.around(point), [point]).sizes > 0).all()


@pytest.mark.parametrize("view", VIEWS, ids=lambda view: view.title)
def test_views_are_rotations_in_the_named_direction(view: Viewpoint):
    np.testing.assert_allclose(view.axes @ view.axes.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(view.axes) == pytest.approx(1)
    assert view.axes[0, 2] == 0  # the picture's width is horizontal: lengths along it are true


@pytest.mark.parametrize(
    ("most", "length"), [(1.0, 1.0), (0.99, 0.5), (49.0, 20.0), (5.0, 5.0), (0.0021, 0.002), (7e5, 5e5)]
)
def test_scale_bars_have_round_lengths(most, length):
    assert round_length(most) == pytest.approx(length)


def test_a_point_is_a_dot_where_it_lies_with_its_colour():
    window = np.array([[-5.0, -4.0], [5.0, 4.0]])
    image = splat(np.array([[2.0, 1.0, 7.0]]), np.array([[200, 100, 50]], np.uint8), ABOVE, window, (100, 80), GROUND)
    assert image.shape == (80, 100, 3)
    drawn = (image != GROUND).any(axis=2)
    rows, columns = np.nonzero(drawn)
    assert columns.mean() == pytest.approx(10 * (2 + 5), abs=1)
    assert rows.mean() == pytest.approx(10 * (4 - 1), abs=1)
    assert image[30, 70].tolist() == [200, 100, 50]
    assert np.ptp(rows) == np.ptp(columns) < 12  # round


def test_the_nearest_is_on_top_and_what_is_outside_is_not_drawn():
    window = np.array([[-1.0, -1.0], [1.0, 1.0]])
    points = np.array([[0, 0, 1.0], [0, 0, 5.0], [0, 0, 3.0], [9, 0, 9], [0.999, 0.999, 0]])
    colors = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255], [9, 9, 9], [1, 2, 3]], np.uint8)
    for order in ([0, 1, 2, 3, 4], [4, 3, 2, 1, 0]):
        image = splat(points[order], colors[order], ABOVE, window, (40, 40), GROUND)
        assert image[20, 20].tolist() == [0, 255, 0]
    nothing = splat(points[3:4], colors[3:4], ABOVE, window, (40, 40), GROUND)
    assert (nothing == GROUND).all()


def test_a_map_of_a_rough_surface_shows_both_sides_alike():
    """From above, points above the surface hide those below it, which would suggest a vertical offset."""
    rng = np.random.default_rng(0)
    height = rng.normal(0, 0.02, 200_000)
    points = np.column_stack([rng.uniform(-10, 10, (200_000, 2)), height])
    colors = np.where(height[:, None] > 0, 200, 100).astype(np.uint8) * np.ones(3, np.uint8)
    image = splat(points, colors, ABOVE, np.array([[-10.0, -10], [10, 10]]), (200, 200), GROUND)
    assert image.mean() == pytest.approx(150, abs=3)
    hidden = splat(points, colors, ABOVE, np.array([[-10.0, -10], [10, 10]]), (200, 200), GROUND, shaded=True)
    assert hidden.mean() > 175  # with shading, points above the surface hide those below


def test_shading_darkens_edges_but_not_level_ground():
    rng = np.random.default_rng(0)
    flat = np.column_stack([rng.uniform(-10, 10, (100_000, 2)), np.zeros(100_000)])
    tower = flat.copy()
    tower[(np.abs(flat[:, :2]) < 3).all(axis=1), 2] = 8.0
    grey = np.full((100_000, 3), 180, np.uint8)
    window = np.array([[-9.0, -9], [9, 9]])
    level = splat(flat, grey, ABOVE, window, (180, 180), GROUND, shaded=True)
    edged = splat(tower, grey, ABOVE, window, (180, 180), GROUND, shaded=True)
    assert np.median(level) == 180
    assert edged[90, 55:61].min() < 120  # the ground to the left of the tower
    assert np.median(edged[80:100, 80:100]) == 180


def test_outliers_do_not_slow_drawing():
    points = np.concatenate([cube([2, 2, 2]).points, [[1e12, 0, 0], [0, -1e12, 1e12]]])
    image = splat(
        points, np.full((len(points), 3), 99, np.uint8), ABOVE, np.array([[-1.0, -1], [1, 1]]), (50, 50), GROUND
    )
    assert (image != GROUND).any(axis=2).mean() > 0.5
