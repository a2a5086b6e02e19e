"""Axes and the local origin of plotters; they need no graphics library."""

import numpy as np
import pytest
from camera_rigs import random_rotation, rotated, sector
from scipy.spatial import Delaunay

from pcbench.report.plot.views import AxisBox, Frame, oblique_view
from pcbench.report.plotters.axes import axes_of
from pcbench.report.plotters.stage import local_origin
from pcbench.report.viewing import ViewingCameras


def test_the_origin_is_round_and_below_the_scene():
    box = AxisBox(np.array([636_001.7, 848_935.2, 406.0]), np.array([637_179.2, 849_497.9, 520.5]))
    assert local_origin(Frame.of(box, [])).tolist() == [636_000, 848_000, 0]
    assert local_origin(Frame.of(AxisBox(box.low * 0, box.high * 0 + 1), [])).tolist() == [0, 0, 0]
    west = AxisBox(np.array([-500_000.0, 0, 0]), np.array([-499_990.0, 10, 10]))
    assert local_origin(Frame.of(west, [])).tolist() == [-500_000, 0, 0]


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e5])
@pytest.mark.parametrize("shape", [(4.3, 2.1, 1.7), (10.0, 9.0, 0.1), (1.0, 1.0, 0.0), (0.0, 0.0, 3.0)])
def test_axes_have_round_labels_inside_the_box(scale, shape):
    low = scale * np.array([-1.234, 0.77, 3.1])
    high = low + scale * np.array(shape)
    for k, axis in enumerate(axes_of(low, high)):
        assert (axis.values >= low[k] - 1e-9 * scale).all() and (axis.values <= high[k] + 1e-9 * scale).all()
        assert len(axis.values) <= 11
        assert np.allclose(axis.ends[:, k], [low[k], high[k]])
        assert np.allclose(axis.places[:, k] if k < 2 else axis.ticks[:, 0, 2], axis.values)
        for value in axis.values:
            assert len(f"{value:.10g}".replace("-", "").replace(".", "").strip("0").partition("e")[0]) <= 4
    longest = int(np.argmax(high - low))
    assert len(axes_of(low, high)[longest].values) >= 4


def test_axes_are_in_front_and_on_the_left_with_z_up():
    x, y, z = axes_of(np.zeros(3), np.array([4.0, 3.0, 2.0]))
    assert x.ends.tolist() == [[0, 0, 0], [4, 0, 0]]
    assert y.ends.tolist() == [[0, 0, 0], [0, 3, 0]]
    assert z.ends.tolist() == [[0, 3, 0], [0, 3, 2]]


@pytest.mark.parametrize("seed", range(12))
def test_axes_are_at_the_border_of_the_picture_and_titled_above(seed):
    """In whatever frame."""
    cameras = ViewingCameras.of(rotated(sector(-130, -50), random_rotation(seed)))
    low, high = np.zeros(3), np.array([4.0, 3.0, 2.0])
    view = oblique_view(cameras)
    _, up, _ = view.axes
    corners = np.stack(np.meshgrid(*zip(low, high, strict=True)), axis=-1).reshape(-1, 3)
    hull = Delaunay(corners @ view.axes[:2].T)
    axes = axes_of(low, high, view)
    vertical = int(np.argmax(np.abs(cameras.up)))
    for k, axis in enumerate(axes):
        np.testing.assert_array_equal(np.abs(np.diff(axis.ends, axis=0)[0]), high[k] * np.eye(3)[k])
        outside = axis.ends.mean(axis=0) + 1e-3 * (axis.ends.mean(axis=0) - 0.5 * high)
        assert hull.find_simplex(outside[None] @ view.axes[:2].T)[0] == -1  # its edge borders the picture of the box
    title = axes[vertical].title_place
    assert title @ up > (axes[vertical].ends @ up).max()
