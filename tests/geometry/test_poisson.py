"""Poisson reconstruction: a sphere is recovered, its open half stays open, and each refusal."""

import numpy as np
import pytest
from optional import break_library, import_or_skip
from shapes import UTM, fibonacci_sphere
from wording import check_error

from pcbench.errors import MissingExtra
from pcbench.extras import import_problem
from pcbench.geometry import poisson
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.mesh import MeshIndex
from pcbench.geometry.poisson import poisson_mesh


@pytest.fixture
def poisson_library():
    if import_problem("open3d"):
        import_or_skip("pymeshlab")


def cloud_with_normals(points, normals, **fields):
    return Cloud(points, normals=normals, **fields)


@pytest.mark.usefixtures("poisson_library")
def test_sphere_far_from_the_origin():
    points, normals = fibonacci_sphere(4000, 10.0)
    mesh = poisson_mesh(cloud_with_normals(points + UTM, 3 * normals, crs="EPSG:32632", unit="m"))
    radii = np.linalg.norm(mesh.vertices - UTM, axis=1)
    assert np.abs(radii - 10).max() < 0.1  # a fifth of the spacing
    assert mesh.is_closed
    assert (np.einsum("ni,ni->n", mesh.normals(), mesh.vertices[mesh.faces[:, 0]] - UTM) > 0).all()
    assert (mesh.crs, mesh.unit) == ("EPSG:32632", "m")
    assert MeshIndex(mesh).query([UTM], signed=True).distances[0] == pytest.approx(-10, abs=0.1)


@pytest.mark.usefixtures("poisson_library")
def test_an_open_surface_ends_where_its_points_end():
    points, normals = fibonacci_sphere(6000, 10.0)
    half = points[:, 2] > 0
    mesh = poisson_mesh(cloud_with_normals(points[half], normals[half]))
    spacing = 20 / np.sqrt(6000) * np.sqrt(np.pi)  # side of the area per point
    assert not mesh.is_closed
    assert mesh.vertices[:, 2].min() > -4 * spacing
    assert MeshIndex(mesh).query(points[half]).distances.max() < spacing


@pytest.mark.usefixtures("poisson_library")
def test_reconstruction_is_reproducible():
    points, normals = fibonacci_sphere(3000)
    first, second = (poisson_mesh(cloud_with_normals(points, normals), depth=6) for _ in range(2))
    np.testing.assert_array_equal(first.vertices, second.vertices)
    np.testing.assert_array_equal(first.faces, second.faces)


def test_unsuitable_normals_and_depths_are_refused():
    points, normals = fibonacci_sphere(60)
    with check_error():
        poisson_mesh(Cloud(points))
    with check_error():
        poisson_mesh(cloud_with_normals(points, normals), depth=0)
    normals[20:] = 0
    with check_error():
        poisson_mesh(cloud_with_normals(points, normals))


def test_a_missing_library_is_reported(monkeypatch, tmp_path):
    break_library(monkeypatch, tmp_path, "pymeshlab", None)
    break_library(monkeypatch, tmp_path, "open3d", None)
    cloud = cloud_with_normals(*fibonacci_sphere(60))
    for call in (poisson_mesh, poisson.orient_normals):
        with check_error(MissingExtra):
            call(cloud)


def test_pymeshlab_is_used_if_open3d_does_not_load(monkeypatch, tmp_path):
    import_or_skip("pymeshlab")
    break_library(monkeypatch, tmp_path, "open3d")
    points, normals = fibonacci_sphere(4000, 10.0)
    mesh = poisson_mesh(cloud_with_normals(points, normals))
    assert np.abs(np.linalg.norm(mesh.vertices, axis=1) - 10).max() < 0.1  # a fifth of the spacing
    with check_error(MissingExtra):
        poisson.orient_normals(cloud_with_normals(points, normals))


def test_orientation_is_consistent_over_a_sphere():
    import_or_skip("open3d")
    points, normals = fibonacci_sphere(5000)
    signs = np.random.default_rng(0).choice([-1.0, 1.0], len(points))
    oriented_normals = poisson.orient_normals(Cloud(points, normals=signs[:, None] * normals)).normals
    outward = (oriented_normals * normals).sum(axis=1) > 0
    assert outward.all() or not outward.any()
