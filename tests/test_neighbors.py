"""Exact search: brute force in float64 on every kind of cloud."""

import numpy as np
import oracles
import pytest

from pcbench.errors import InputError
from pcbench.neighbors import Index

RNG = np.random.default_rng(1)
CLOUDS = {
    "uniform": RNG.random((400, 3)),
    "clustered": np.concatenate([RNG.normal(c, 0.01, (100, 3)) for c in range(4)]),
    "planar": RNG.random((400, 3)) * [1, 1, 0],
    "collinear": RNG.random((300, 1)) * [1.0, 2.0, 3.0],
    "duplicates": np.repeat(RNG.random((80, 3)), 4, axis=0),
    "far": RNG.random((400, 3)) + [5e5, 4.8e6, 100.0],
    "single": RNG.random((1, 3)),
}


@pytest.mark.parametrize("name", CLOUDS)
def test_nearest_equals_brute_force(name):
    points = CLOUDS[name]
    queries = np.concatenate([points[:50], points[:50] + 0.1, points.mean(axis=0) + RNG.normal(0, 2, (50, 3))])
    distances, indices = Index(points).query(queries)
    expected, _ = oracles.nearest(queries, points)
    # 1e-12 of the distance, or the rounding of the coordinates themselves.
    np.testing.assert_allclose(distances, expected, rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(np.linalg.norm(queries - points[indices], axis=1), expected, rtol=1e-12, atol=1e-15)
    assert indices.dtype == np.int64


@pytest.mark.parametrize("name", [name for name in CLOUDS if name != "single"])
def test_k_nearest_and_leave_one_out(name):
    points = CLOUDS[name]
    index = Index(points)
    np.testing.assert_allclose(index.query(points, 7).distances, oracles.k_nearest(points, points, 7)[0], atol=1e-9)
    other = index.nearest_other()
    np.testing.assert_allclose(other.distances, oracles.leave_one_out(points), rtol=1e-12, atol=1e-15)
    assert (other.indices != np.arange(len(points))).all()
    some = np.array([5, 0, 17])
    np.testing.assert_array_equal(index.nearest_other(some).distances, other.distances[some])


def test_refusals():
    with pytest.raises(InputError, match=r"expected points of shape \(N, 3\)"):
        Index(np.empty((0, 3)))
    with pytest.raises(InputError, match="at least 3 points to find 3 neighbours, got 2"):
        Index(RNG.random((2, 3))).query(RNG.random((1, 3)), k=3)
    with pytest.raises(InputError, match="at least 2 points"):
        Index(RNG.random((1, 3))).nearest_other()
