"""Poisson reconstruction: a sphere comes back, its open half stays open, and what is refused."""

import numpy as np
import pytest
from shapes import UTM, fibonacci_sphere

from pcbench.errors import InputError, MissingExtra
from pcbench.geometry import poisson
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.mesh import MeshIndex
from pcbench.geometry.poisson import poisson_mesh


@pytest.fixture
def library():
    try:
        import open3d  # noqa: F401
    except (ImportError, OSError) as error:
        pytest.importorskip("pymeshlab", reason=f"neither open3d ({error}) nor pymeshlab", exc_type=ImportError)


def oriented(points, normals, **fields):
    return Cloud(points, normals=normals, **fields)


@pytest.mark.usefixtures("library")
def test_sphere_far_from_the_origin():
    points, normals = fibonacci_sphere(4000, 10.0)
    mesh = poisson_mesh(oriented(points + UTM, 3 * normals, crs="EPSG:32632", unit="m"))
    radii = np.linalg.norm(mesh.vertices - UTM, axis=1)
    assert np.abs(radii - 10).max() < 0.1  # a fifth of the spacing
    assert mesh.is_closed
    assert (np.einsum("ni,ni->n", mesh.normals(), mesh.vertices[mesh.faces[:, 0]] - UTM) > 0).all()
    assert (mesh.crs, mesh.unit) == ("EPSG:32632", "m")
    assert MeshIndex(mesh).query([UTM], signed=True).distances[0] == pytest.approx(-10, abs=0.1)


@pytest.mark.usefixtures("library")
def test_an_open_surface_ends_where_its_points_end():
    points, normals = fibonacci_sphere(6000, 10.0)
    half = points[:, 2] > 0
    mesh = poisson_mesh(oriented(points[half], normals[half]))
    spacing = 20 / np.sqrt(6000) * np.sqrt(np.pi)  # side of a point's share of the sphere
    assert not mesh.is_closed
    assert mesh.vertices[:, 2].min() > -4 * spacing
    assert MeshIndex(mesh).query(points[half]).distances.max() < spacing


@pytest.mark.usefixtures("library")
def test_two_runs_give_the_same_bits():
    points, normals = fibonacci_sphere(3000)
    first, second = (poisson_mesh(oriented(points, normals), depth=6) for _ in range(2))
    np.testing.assert_array_equal(first.vertices, second.vertices)
    np.testing.assert_array_equal(first.faces, second.faces)


def test_refusals(monkeypatch):
    points, normals = fibonacci_sphere(60)
    with pytest.raises(InputError, match="expected a cloud with normals"):
        poisson_mesh(Cloud(points))
    with pytest.raises(InputError, match="expected a depth of 1 to 14, got 0"):
        poisson_mesh(oriented(points, normals), depth=0)
    normals[20:] = 0
    with pytest.raises(InputError, match="at least 50 points with normals to reconstruct a surface, got 20"):
        poisson_mesh(oriented(points, normals))
    monkeypatch.setitem(__import__("sys").modules, "open3d", None)
    monkeypatch.setitem(__import__("sys").modules, "pymeshlab", None)
    with pytest.raises(MissingExtra, match=r"pcbench\[open3d\]"):
        poisson_mesh(oriented(*fibonacci_sphere(60)))


def test_signs_agree_over_a_sphere():
    pytest.importorskip("open3d", exc_type=ImportError)
    points, normals = fibonacci_sphere(5000)
    signs = np.random.default_rng(0).choice([-1.0, 1.0], len(points))
    found = poisson.oriented(Cloud(points, normals=signs[:, None] * normals)).normals
    outward = (found * normals).sum(axis=1) > 0
    assert outward.all() or not outward.any()
