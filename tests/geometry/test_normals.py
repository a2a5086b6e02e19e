"""Normals: surfaces with known normals, and comparison with numpy's eigenvectors."""

import numpy as np
import oracles
import pytest
import shapes
from wording import check_error

from pcbench.geometry import normals as normals_module
from pcbench.geometry.neighbors import Index
from pcbench.geometry.normals import Surface, estimate_normals


def angles_deg(a, b):
    """Angles between lines in degrees, ignoring signs."""
    sine = np.linalg.norm(np.cross(a, b), axis=1)
    return np.degrees(np.arctan2(sine, np.abs((a * b).sum(axis=1))))


def test_normals_of_a_tilted_plane_are_exact_also_at_utm():
    points = shapes.plane_samples(500) @ shapes.rotation([1, 2, 0], 35).T
    expected = np.tile(shapes.rotation([1, 2, 0], 35)[:, 2], (500, 1))
    estimate = estimate_normals(Index(points), 12)
    # 1e-6 degrees: rounding of coordinates of size 10 over patches of size 1.
    assert angles_deg(estimate.directions, expected).max() < 1e-6
    assert estimate.variation.max() < 1e-12
    far_estimate = estimate_normals(Index(np.round(points * 2**20) / 2**20 + [5e5, 4.8e6, 0.0]), 12)
    # 2^-20 m of rounding over patches of half a metre: 1e-4 degrees.
    assert angles_deg(far_estimate.directions, expected).max() < 1e-3


def test_normals_of_a_sphere():
    points, normals = shapes.fibonacci_sphere(4000)
    estimate = estimate_normals(Index(points), 12)
    # Half a spacing (sqrt(4 pi / 4000) rad), the largest offset of the centre of twelve neighbours from the point.
    assert angles_deg(estimate.directions, normals).max() < 1.6


def test_normals_equal_numpy_eigenvectors():
    points, _ = shapes.terrain(400)
    points += np.random.default_rng(3).normal(0, 0.05, points.shape)
    estimate = estimate_normals(Index(points), 10)
    assert angles_deg(estimate.directions, oracles.normals(points, 10)).max() < 1e-6
    np.testing.assert_allclose(np.linalg.norm(estimate.directions, axis=1), 1, rtol=1e-14)
    _, neighbors = oracles.k_nearest(points, points, 10)
    values = [np.linalg.eigvalsh(np.cov(points[row].T)) for row in neighbors]
    expected = [v[0] / v.sum() for v in values]
    np.testing.assert_allclose(estimate.variation, expected, rtol=1e-9, atol=1e-15)


def test_signs_of_normals():
    grid = np.stack(np.meshgrid(np.arange(4.0), np.arange(4.0)), axis=-1).reshape(-1, 2)
    for axis in range(3):  # upwards in z, or in y if z is 0, or in x
        flat = np.insert(grid, axis, 0.0, axis=1)
        np.testing.assert_array_equal(estimate_normals(Index(flat), 5).directions, np.tile(np.eye(3)[axis], (16, 1)))
    assert (estimate_normals(Index(shapes.sphere(50)[0]), 5).directions[:, 2] >= 0).all()


def test_surface_uses_given_normals_and_estimates_missing_ones():
    points = shapes.plane_grid(10)
    input_normals = np.tile([0, 3.0, 4.0], (100, 1))
    input_normals[7] = 0
    normals = Surface(Index(points), normals=input_normals).normals(np.array([7, 8]))
    np.testing.assert_allclose(normals, [[0, 0, 1], [0, 0.6, 0.8]], atol=1e-12)


@pytest.fixture
def as_in_large_clouds(monkeypatch):
    """Let small clouds compute only the normals that are requested."""
    monkeypatch.setattr(normals_module, "_MAX_SWEPT_POINTS", 0)


def test_small_clouds_compute_all_normals_at_the_first_request():
    surface = Surface(Index(shapes.plane_grid(10)))
    surface.compute_normals(np.empty(0, np.int64))
    assert not surface.is_complete
    surface.compute_normals(np.array([3]))
    assert surface.is_complete


@pytest.mark.usefixtures("as_in_large_clouds")
@pytest.mark.parametrize("has_normals", [False, True])
def test_uncomputed_rows_are_nan(has_normals):
    points = shapes.plane_grid(10)
    input_normals = np.zeros((100, 3)) if has_normals else None
    surface = Surface(Index(points), normals=input_normals)
    normals = surface.compute_normals(np.array([3, 50]))
    np.testing.assert_allclose(normals[[3, 50]], [[0, 0, 1]] * 2, atol=1e-12)
    assert np.isnan(np.delete(normals, [3, 50], axis=0)).all()
    np.testing.assert_allclose(surface.compute_normals(None), np.tile([0, 0, 1.0], (100, 1)), atol=1e-12)


@pytest.mark.usefixtures("as_in_large_clouds")
@pytest.mark.parametrize("count", [1, 40, 150, 199])
def test_selected_rows_have_the_normals_of_all_rows(count):
    """The planes of few rows, of many, and of all are computed in different ways, with the same bits."""
    points, directions = shapes.sphere(200)
    rows = np.random.default_rng(2).permutation(200)[:count]
    surface, whole = Surface(Index(points)), Surface(Index(points))
    np.testing.assert_array_equal(surface.normals(rows), whole.normals(np.arange(200))[rows])
    np.testing.assert_array_equal(surface.compute_normals(None), whole.compute_normals(None))
    np.testing.assert_array_equal(surface.variation(rows), whole.variation(rows))
    partly = np.where(np.arange(200)[:, None] < 20, directions, 0)
    completed = Surface(Index(points), normals=partly).compute_normals(None)
    np.testing.assert_allclose(completed[:20], directions[:20], rtol=1e-15)  # scaled to unit length again: a few ulp
    np.testing.assert_array_equal(completed[20:], whole.compute_normals(None)[20:])


def test_duplicates_are_accepted_and_too_few_points_refused():
    points = np.zeros((10, 3))
    assert np.isfinite(estimate_normals(Index(points), 5).directions).all()
    with check_error():
        estimate_normals(Index(points[:2]))
