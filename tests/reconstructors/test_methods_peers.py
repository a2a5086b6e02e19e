"""The peers that `benchmarks/methods.py` runs beside the reconstructors."""

import numpy as np
import pytest
from repository import ROOT

from pcbench.geometry.cameras import Camera, Intrinsics, look_at

K = Intrinsics(300, 200, 280, 280, 150, 100)


@pytest.mark.parametrize(
    ("second", "is_possible"),
    [((1, 0, 10), True), ((4, 3, 10), True), ((0.01, 0, 6), False), ((0.5, 0, 7), False)],
    ids=["beside", "aslant", "ahead", "ahead and beside"],
)
def test_only_pairs_beside_each_other_can_be_rectified(monkeypatch, second, is_possible):
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    import methods_peers

    eyes = (0.0, 0.0, 10.0), second
    cameras = [Camera("a.png", K, look_at(eye, [0, 0, 0], up=(0, 1, 0))) for eye in eyes]
    assert methods_peers._can_be_rectified(cameras) == is_possible
    if is_possible:
        rotation, focal, borders = methods_peers._common_frame(cameras)
        assert focal == 280
        point = np.array([0.4, -0.3, 0.5])
        rows = [focal * ray[1] / ray[2] for ray in (rotation @ (point - camera.position) for camera in cameras)]
        assert rows[0] == pytest.approx(rows[1])  # rows are epipolar lines
        for border, camera in zip(borders, cameras, strict=True):
            x, y, depth = rotation @ (point - camera.position)
            assert (border.min(axis=0) < focal * np.array([x, y]) / depth).all()
            assert (border.max(axis=0) > focal * np.array([x, y]) / depth).all()
