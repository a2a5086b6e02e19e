"""Axes and the local origin of plotters; they need no graphics library."""

from itertools import combinations

import numpy as np
import pytest
from camera_rigs import random_rotation, rotated, sector
from scipy.spatial import ConvexHull

from pcbench.report.plot.plan_marks import left_of_arrow
from pcbench.report.plot.rounding import round_origin
from pcbench.report.plot.views import SOUTH_WEST, AxisBox, Viewpoint, oblique_view
from pcbench.report.plotters.axes import axes_of, lay_out
from pcbench.report.viewing import ViewingCameras

SHAPES = [(4.3, 2.1, 1.7), (10.0, 9.0, 0.1), (1.0, 1.0, 0.0), (0.0, 0.0, 3.0), (3.0, 3.0, 40.0), (1000.0, 20.0, 10.0)]
TITLES = ("x − 635,000 [m]", "y − 5,847,000 [m]", "z [m]")
ROTATED = {
    f"rotated {seed}": oblique_view(ViewingCameras.of(rotated(sector(-130, -50), random_rotation(seed))))
    for seed in range(4)
}
ALONG_AXES = {
    "from above": Viewpoint("", (0, 0, 1), (0, 1, 0)),
    "front": Viewpoint("", (0, -1, 0), (0, 0, 1)),
    "along x": Viewpoint("", (1, 0, 0), (0, 1, 0)),
}
VIEWS = {"south-west": SOUTH_WEST, **ROTATED, **ALONG_AXES}
EVERY_VIEW = pytest.mark.parametrize("view", VIEWS.values(), ids=VIEWS)
EVERY_ROTATED_VIEW = pytest.mark.parametrize("view", ROTATED.values(), ids=ROTATED)


def corners_of(low, high):
    return np.stack(np.meshgrid(*zip(low, high, strict=True)), axis=-1).reshape(-1, 3)


def texts_of(axes):
    return [text for axis in axes for text in (*axis.labels, axis.title)]


def test_the_origin_is_round_and_below_the_scene():
    box = AxisBox(np.array([636_001.7, 848_935.2, 406.0]), np.array([637_179.2, 849_497.9, 520.5]))
    assert round_origin(box.low, box.high).tolist() == [636_000, 848_000, 0]
    assert round_origin(box.low * 0, box.high * 0 + 1).tolist() == [0, 0, 0]
    west = AxisBox(np.array([-500_000.0, 0, 0]), np.array([-499_990.0, 10, 10]))
    assert round_origin(west.low, west.high).tolist() == [-500_000, 0, 0]


@EVERY_VIEW
@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e5])
@pytest.mark.parametrize("shape", SHAPES)
def test_axes_have_round_labels_inside_the_box(scale, shape, view):
    low = scale * np.array([-1.234, 0.77, 3.1])
    high = low + scale * np.array(shape)
    for k, axis in enumerate(axes_of(low, high, TITLES, view, scale * max(shape) / 600)):
        assert (axis.values >= low[k] - 1e-9 * scale).all() and (axis.values <= high[k] + 1e-9 * scale).all()
        assert len(axis.values) <= 11
        assert np.allclose(axis.ends[:, k], [low[k], high[k]])
        assert np.allclose(axis.ticks[:, 0, k], axis.values)
        labels = {f"{value:.6g}" for value in axis.values}
        assert {label.text for label in axis.labels} <= labels
        for value in axis.values:
            assert len(f"{value:.10g}".replace("-", "").replace(".", "").strip("0").partition("e")[0]) <= 4


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e5])
@pytest.mark.parametrize("shape", SHAPES)
def test_the_longest_axis_has_at_least_four_labels(scale, shape):
    low = scale * np.array([-1.234, 0.77, 3.1])
    axes = axes_of(low, low + scale * np.array(shape), TITLES, SOUTH_WEST, scale * max(shape) / 600)
    assert len(axes[int(np.argmax(shape))].labels) >= 4


def test_axes_are_in_front_and_on_the_left_with_z_up():
    x, y, z = axes_of(np.zeros(3), np.array([4.0, 3.0, 2.0]), TITLES, SOUTH_WEST, 0.01)
    assert x.ends.tolist() == [[0, 0, 0], [4, 0, 0]]
    assert y.ends.tolist() == [[0, 0, 0], [0, 3, 0]]
    assert z.ends.tolist() == [[0, 3, 0], [0, 3, 2]]


@EVERY_ROTATED_VIEW
def test_texts_are_outside_the_picture_of_the_box(view):
    """In whatever frame; the axis closest to the upward direction is on the left, and titled above."""
    low, high, pixel = np.zeros(3), np.array([4.0, 3.0, 2.0]), 0.01
    axes = axes_of(low, high, TITLES, view, pixel)
    for k, axis in enumerate(axes):
        np.testing.assert_array_equal(np.abs(np.diff(axis.ends, axis=0)[0]), high[k] * np.eye(3)[k])
    corners = corners_of(low, high) @ view.axes[:2].T / pixel
    sides = ConvexHull(corners).equations  # the outward normals of the sides of the box's picture, and their offsets
    for text in texts_of(axes):
        (left, bottom), (right, top) = text.rectangle(view, pixel)
        places = np.array([[left, bottom], [right, bottom], [left, top], [right, top]])
        assert (sides[:, :2] @ places.T + sides[:, 2:] > 0).all(axis=1).any()  # beyond one of the sides
    right, up, _ = view.axes
    vertical = axes[int(np.argmax(np.abs(view.up)))]
    assert vertical.title.place @ up > (vertical.ends @ up).max()
    for axis in axes:
        away = axis.ticks[:, 1] - axis.ticks[:, 0]
        assert (away @ (right if axis is vertical else up) < 0).all()  # to the left, or down


@EVERY_VIEW
@pytest.mark.parametrize(
    "low, size, share",
    [(-12.3, (1100, 600), 0.5), (1234.5, (600, 400), 0.5), (-12.3, (380, 520), 0.58), (1234.5, (380, 520), 0.58)],
    ids=str,
)
@pytest.mark.parametrize("shape", SHAPES)
def test_texts_of_axes_do_not_overlap_and_fit_into_the_window(shape, low, size, share, view):
    """In a narrow window, texts extend into the margin, so that the box is not too small."""
    low = np.full(3, low)
    layout = lay_out(low, low + shape, TITLES, view, np.array(size))
    middle = layout.middle / layout.pixel
    rectangles = [text.rectangle(view, layout.pixel) - middle for text in texts_of(layout.axes)]
    for one, other in combinations(rectangles, 2):
        assert (one[1] <= other[0]).any() or (other[1] <= one[0]).any()
    corners = corners_of(low, low + shape) @ view.axes[:2].T / layout.pixel - middle
    for places in (*rectangles, corners):
        assert (np.abs(places) <= share * np.array(size) + 1).all()
    shares = np.ptp(corners, axis=0) / size
    assert shares.max() > 0.29 or not shares.any()


def test_numbers_do_not_cover_the_north_arrow():
    extent = (100.0, 200.0, 0.0, 50.0)
    places = [(195, 45), (195, 30), (150, 45), (192, 49)]
    assert [left_of_arrow(place, extent) for place in places] == [192, 195, 150, 192]
