"""Meshes are closed by the positions of their vertices; signs do not depend on how these are stored."""

import numpy as np
import pytest
from mesh_shapes import cube, height_field, icosphere, spiky_sphere
from wording import check_text

from pcbench.geometry.mesh import Mesh, MeshIndex


def joined(*parts):
    """Return several meshes (vertices, faces) as one."""
    starts = np.cumsum([0, *(len(vertices) for vertices, _ in parts[:-1])])
    faces = [faces + start for (_, faces), start in zip(parts, starts, strict=True)]
    return np.concatenate([vertices for vertices, _ in parts]), np.concatenate(faces)


def separated(vertices, faces):
    """Return a mesh whose faces share no vertices."""
    return vertices[faces].reshape(-1, 3), np.arange(faces.size).reshape(-1, 3)


def jittered(vertices, faces, length):
    return vertices + np.random.default_rng(3).uniform(-length, length, vertices.shape), faces


def turned(vertices, faces):
    return vertices, faces[:, ::-1]


def queries(count=400):
    return np.random.default_rng(4).uniform(-1.5, 1.5, (count, 3))


FAR = np.array([7.1, 3.3, 0.1])
# Each is the same cube: with vertices per face, rounded, inside out, or with repeated faces.
CUBES = {
    "separated": separated(*cube()),
    "rounded": jittered(*separated(*cube()), 1e-6),
    "float32": (
        np.float32(separated(*cube(centre=(7.1, 3.3, 0.1)))[0]) - np.array([7.1, 3.3, 0.1]),
        separated(*cube())[1],
    ),
    "inside out": turned(*separated(*cube())),
    "repeated faces": (cube()[0], np.concatenate([cube()[1], cube()[1][:5, [1, 2, 0]]])),
    "two rounded vertices": (np.vstack([cube()[0], cube()[0][:1] + 1e-6]), np.vstack([[8, 1, 3], cube()[1][1:]])),
}


@pytest.mark.parametrize("name", CUBES)
def test_signs_do_not_depend_on_how_the_vertices_are_stored(name):
    points = queries()
    expected = MeshIndex(Mesh(*cube())).query(points, signed=True).distances
    mesh = Mesh(*CUBES[name])
    assert mesh.is_closed
    found = MeshIndex(mesh).query(points, signed=True).distances
    np.testing.assert_allclose(found, expected, atol=2e-6)  # the vertices are rounded by 1e-6
    assert (found < 0).sum() == (expected < 0).sum() > 50


def test_signs_at_corners_and_edges_of_separate_faces():
    vertices, faces = spiky_sphere(2)
    points = np.repeat(vertices, 3, axis=0) * np.random.default_rng(5).uniform(0.9, 1.1, (3 * len(vertices), 1))
    welded = MeshIndex(Mesh(vertices, faces)).query(points, signed=True).distances
    separate = MeshIndex(Mesh(*jittered(*separated(vertices, faces), 1e-9))).query(points, signed=True).distances
    np.testing.assert_allclose(separate, welded, atol=1e-8)


def test_edges_that_vanish_when_their_ends_are_merged():
    vertices, faces = cube()
    split = np.vstack([vertices, vertices[0] + (0, 0, 1e-7)])  # a needle 0, 8, 1 with a gap beside it
    mesh = Mesh(split, np.vstack([[(8, 1, 3), (0, 8, 3)], faces[1:]]))
    points = vertices[0] + np.random.default_rng(6).normal(0, 1e-7, (500, 3))
    expected = MeshIndex(Mesh(vertices, faces)).query(points, signed=True).distances
    found = MeshIndex(mesh).query(points, signed=True).distances
    np.testing.assert_allclose(found, expected, atol=2e-7)
    far = np.abs(expected) > 1e-7
    np.testing.assert_array_equal(found[far] < 0, expected[far] < 0)


def test_shells():
    """Solids beside each other may point either way; a cavity points against its solid."""
    outer, inner, core = (
        icosphere(1),
        (0.5 * icosphere(1)[0], icosphere(1)[1]),
        (0.2 * icosphere(1)[0], icosphere(1)[1]),
    )
    hollow = joined(outer, turned(*inner), core)
    points = np.array([(0, 0, 0), (0.35, 0, 0), (0.7, 0, 0), (1.5, 0, 0)])
    for vertices, faces in (hollow, turned(*hollow)):
        assert (MeshIndex(Mesh(vertices, faces)).query(points, signed=True).distances < 0).tolist() == [1, 0, 1, 0]
    beside = joined(cube(), turned(*cube(centre=(5, 0, 0))))
    distances = MeshIndex(Mesh(*beside)).query([(0, 0, 0), (5, 0, 0), (2.5, 0, 0)], signed=True).distances
    np.testing.assert_allclose(distances, [-1, -1, 1.5], rtol=1e-14)
    touching = joined(cube(), cube(centre=(2, 0, 0)))  # two faces coincide, and each cube has its own vertices
    np.testing.assert_allclose(MeshIndex(Mesh(*touching)).query([(0, 0, 0), (0, 3, 0)], signed=True).distances, [-1, 2])


_, CUBE_FACES = cube()
UNSIGNED = {
    "hole": (cube()[0], CUBE_FACES[1:]),
    "wide gap": jittered(*separated(*cube()), 1e-3),
    "turned face": (cube()[0], np.vstack([CUBE_FACES[:1, ::-1], CUBE_FACES[1:]])),
    "both sides": (cube()[0], np.vstack([CUBE_FACES, CUBE_FACES[:, ::-1]])),
    "terrain": height_field(4),
    "far vertex": (np.vstack([cube()[0], [(1e9, 0, 0)]]), np.vstack([CUBE_FACES, [(0, 1, 8)]])),
    "shell inside": joined(cube(), cube(0.5)),
}


@pytest.mark.parametrize("name", UNSIGNED)
def test_the_reason_for_unsigned_distances_is_stated(name):
    mesh = Mesh(*UNSIGNED[name])
    assert not MeshIndex(mesh).supports_signed_distance
    assert mesh.is_closed == (name == "shell inside")
    check_text(mesh.closure.describe("m"), masked=False)


def test_the_tolerance_is_stated():
    check_text(Mesh(*CUBES["rounded"]).closure.describe("m"), masked=False)
    assert Mesh(*CUBES["separated"]).closure.describe(None) == "closed"
