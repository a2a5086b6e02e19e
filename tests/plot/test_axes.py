"""Axes and the local origin of plotters; they need no graphics library."""

from itertools import combinations

import numpy as np
import pytest

from pcbench.report.plot.views import AxisBox, Frame
from pcbench.report.plotters.axes import VIEW, axes_of, lay_out
from pcbench.report.plotters.stage import local_origin

SHAPES = [(4.3, 2.1, 1.7), (10.0, 9.0, 0.1), (1.0, 1.0, 0.0), (0.0, 0.0, 3.0), (3.0, 3.0, 40.0), (1000.0, 20.0, 10.0)]
TITLES = ("x − 635,000 [m]", "y − 5,847,000 [m]", "z [m]")


def test_the_origin_is_round_and_below_the_scene():
    box = AxisBox(np.array([636_001.7, 848_935.2, 406.0]), np.array([637_179.2, 849_497.9, 520.5]))
    assert local_origin(Frame.of(box, [])).tolist() == [636_000, 848_000, 0]
    assert local_origin(Frame.of(AxisBox(box.low * 0, box.high * 0 + 1), [])).tolist() == [0, 0, 0]
    west = AxisBox(np.array([-500_000.0, 0, 0]), np.array([-499_990.0, 10, 10]))
    assert local_origin(Frame.of(west, [])).tolist() == [-500_000, 0, 0]


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e5])
@pytest.mark.parametrize("shape", SHAPES)
def test_axes_have_round_labels_inside_the_box(scale, shape):
    low = scale * np.array([-1.234, 0.77, 3.1])
    high = low + scale * np.array(shape)
    pixel = scale * max(shape) / 600
    for k, axis in enumerate(axes_of(low, high, TITLES, pixel)):
        assert (axis.values >= low[k] - 1e-9 * scale).all() and (axis.values <= high[k] + 1e-9 * scale).all()
        assert len(axis.values) <= 11
        assert np.allclose(axis.ends[:, k], [low[k], high[k]])
        places = np.array([text.place for text in axis.labels]).reshape(-1, 3)
        assert np.allclose(places[:, k] if k < 2 else axis.ticks[:, 0, 2], axis.values)
        for value in axis.values:
            assert len(f"{value:.10g}".replace("-", "").replace(".", "").strip("0").partition("e")[0]) <= 4
    longest = int(np.argmax(high - low))
    assert len(axes_of(low, high, TITLES, pixel)[longest].values) >= 4


@pytest.mark.parametrize("size", [(1100, 600), (600, 400), (380, 520)])
@pytest.mark.parametrize("offset", [0.0, 0.777, -12.3, 1234.5])
@pytest.mark.parametrize("shape", SHAPES)
def test_texts_of_axes_do_not_overlap_and_fit_into_the_window(shape, offset, size):
    low = np.full(3, offset)
    layout = lay_out(low, low + shape, TITLES, np.array(size))
    rectangles = [
        text.rectangle((VIEW.axes[:2] @ text.place - layout.middle) / layout.pixel)
        for axis in layout.axes
        for text in (*axis.labels, axis.title)
    ]
    for one, other in combinations(rectangles, 2):
        assert (one[1] <= other[0]).any() or (other[1] <= one[0]).any()
    # The window is 1.087 times as wide as this part: scale and labels depend on each other, and need not settle.
    assert (np.abs(rectangles) <= 0.54 * np.array(size)).all()
