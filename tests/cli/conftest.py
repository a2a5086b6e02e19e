import numpy as np
import pytest
import shapes

from pcbench import Cloud, write_cloud


@pytest.fixture
def files(tmp_path, monkeypatch):
    """Write ref.ply, a.ply and b.ply to the current folder."""
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(0)
    reference = shapes.city(4000, noise=0.01, seed=1)[0]
    write_cloud("ref.ply", Cloud(reference, unit="m"))
    for name, count, noise in (("a", 1500, 0.02), ("b", 700, 0.05)):
        points = shapes.city(count, seed=count)[0]
        write_cloud(f"{name}.ply", Cloud(points + rng.normal(0, noise, points.shape) + [0.05, 0.02, 0]))
    return tmp_path
