"""Poisson reconstruction: a sphere is recovered, its open half stays open, and each refusal."""

from functools import cache

import numpy as np
import pytest
from optional import break_library, import_or_skip
from shapes import UTM, fibonacci_sphere
from wording import check_error

from pcbench.errors import MissingExtra
from pcbench.geometry import poisson
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.mesh import MeshIndex
from pcbench.geometry.meshlab import decimate
from pcbench.geometry.poisson import poisson_mesh, poisson_mesh_by_meshlab

ENGINES = {"open3d": poisson_mesh, "pymeshlab": poisson_mesh_by_meshlab}
EACH_ENGINE = pytest.mark.parametrize("engine", ["open3d", pytest.param("pymeshlab", marks=pytest.mark.long)])


def engine_or_skip(name):
    import_or_skip(name)
    return ENGINES[name]


def cloud_with_normals(points, normals, **fields):
    return Cloud(points, normals=normals, **fields)


def reconstruct_sphere(engine):
    points, normals = fibonacci_sphere(4000, 10.0)
    return engine_or_skip(engine)(cloud_with_normals(points + UTM, 3 * normals, crs="EPSG:32632", unit="m"))


sphere = cache(reconstruct_sphere)


@EACH_ENGINE
def test_sphere_far_from_the_origin(engine):
    mesh = sphere(engine)
    radii = np.linalg.norm(mesh.vertices - UTM, axis=1)
    assert np.abs(radii - 10).max() < 0.1  # a fifth of the spacing
    assert mesh.is_closed
    assert (np.einsum("ni,ni->n", mesh.normals(), mesh.vertices[mesh.faces[:, 0]] - UTM) > 0).all()
    assert (mesh.crs, mesh.unit) == ("EPSG:32632", "m")
    assert MeshIndex(mesh).query([UTM], signed=True).distances[0] == pytest.approx(-10, abs=0.1)


@EACH_ENGINE
def test_an_open_surface_ends_where_its_points_end(engine):
    poisson_mesh = engine_or_skip(engine)
    points, normals = fibonacci_sphere(6000, 10.0)
    half = points[:, 2] > 0
    mesh = poisson_mesh(cloud_with_normals(points[half], normals[half]))
    spacing = 20 / np.sqrt(6000) * np.sqrt(np.pi)  # side of the area per point
    assert not mesh.is_closed
    assert mesh.vertices[:, 2].min() > -4 * spacing
    assert MeshIndex(mesh).query(points[half]).distances.max() < spacing


@EACH_ENGINE
def test_reconstruction_is_reproducible(engine):
    first, second = sphere(engine), reconstruct_sphere(engine)
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
    for call in (poisson_mesh, poisson_mesh_by_meshlab, poisson.orient_normals):
        with check_error(MissingExtra):
            call(cloud)


def test_a_library_that_cannot_be_loaded_in_the_child_is_reported(monkeypatch, tmp_path):
    break_library(monkeypatch, tmp_path, "pymeshlab")
    with check_error(MissingExtra):
        poisson_mesh_by_meshlab(cloud_with_normals(*fibonacci_sphere(60)))


@pytest.mark.long
def test_decimation_keeps_a_sphere():
    mesh = sphere("pymeshlab")
    coarse = decimate(mesh, len(mesh) // 10)
    assert len(coarse) == pytest.approx(len(mesh) / 10, rel=0.01)
    # Chords of edge length a lie a^2 / 8R inside; the coarse faces have a of about 2.5.
    radii = np.linalg.norm(coarse.vertices - UTM, axis=1)
    assert np.abs(radii - 10).max() < 0.15
    with check_error():
        decimate(coarse, len(coarse) + 1)


def test_orientation_is_consistent_over_a_sphere():
    import_or_skip("open3d")
    points, normals = fibonacci_sphere(5000)
    signs = np.random.default_rng(0).choice([-1.0, 1.0], len(points))
    oriented_normals = poisson.orient_normals(Cloud(points, normals=signs[:, None] * normals)).normals
    outward = (oriented_normals * normals).sum(axis=1) > 0
    assert outward.all() or not outward.any()


def test_normals_of_a_plane_get_one_sign():
    import_or_skip("open3d")
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(0, 10, (500, 2)), np.zeros(500)])
    normals = np.outer(rng.choice([-1.0, 1.0], 500), [0.0, 0.0, 1.0])
    tilt = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    oriented = poisson.orient_normals(cloud_with_normals(points @ tilt, normals @ tilt)).normals
    assert np.ptp(oriented, axis=0).max() < 1e-12 and oriented[0, 2] > 0
