"""The picture of a scene's cameras."""

import numpy as np
import pytest
from scene_folders import NAMES, orbit, ten_pictures

from pcbench import Cloud
from pcbench.errors import InputError
from pcbench.io.colmap_model import write_colmap_model
from pcbench.scenes import read_scene


@pytest.mark.parametrize("count", [1, 2, 10])
def test_the_camera_plot_is_drawn(tmp_path, count):
    photographs = ten_pictures(tmp_path)
    matplotlib_image = pytest.importorskip("matplotlib.image")
    from pcbench.report.plot.cameras import draw_cameras

    write_colmap_model(photographs / "sparse/0", orbit(NAMES), Cloud(np.random.default_rng(0).normal(size=(500, 3))))
    draw_cameras(read_scene(photographs).select(NAMES[:count]), photographs / "cameras.png")
    image = matplotlib_image.imread(photographs / "cameras.png")
    assert image.shape == (768, 1680, 4)
    blue = (np.abs(image[..., :3] - [0, 0x72 / 255, 0xB2 / 255]).max(axis=2) < 0.1).sum()
    assert blue > 100  # both panels have cameras in their colour
    with pytest.raises(InputError, match="no cameras to draw"):
        draw_cameras(read_scene(photographs, cameras="none"), photographs / "none.png")
    assert not (photographs / "none.png").exists()


def test_rings_are_told_apart_and_closed():
    from pcbench.report.plot.cameras import _rings

    angles = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    circle = np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)
    rings = _rings(np.concatenate([500 * circle, 1500 * circle + [0, 0, 300], 2500 * circle]))
    assert [len(ring) for ring in rings] == [13, 13, 13]
    for ring in rings:
        np.testing.assert_array_equal(ring[0], ring[-1])
    assert [len(ring) for ring in _rings(np.arange(15.0).reshape(5, 3))] == [5]
    walk = np.random.default_rng(0).normal(size=(40, 3)).cumsum(axis=0)
    assert [len(ring) for ring in _rings(walk)] == [40]
    assert not _rings(np.zeros((1, 3)))
