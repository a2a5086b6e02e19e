"""Mesh: area, normals, closedness, transforms, sampling, and refusals."""

import pickle

import numpy as np
import pytest
from mesh_shapes import cube, height_field, spiky_sphere, tetrahedron
from scipy.stats import chi2
from shapes import UTM
from wording import check_error

from pcbench.geometry.mesh import Mesh, MeshIndex
from pcbench.geometry.transform import Affine, Similarity


def test_is_closed():
    vertices, faces = cube()
    assert Mesh(vertices, faces).is_closed
    assert Mesh(vertices, faces[:, [1, 2, 0]]).is_closed
    assert not Mesh(vertices, faces[1:]).is_closed
    flipped = faces.copy()
    flipped[0] = flipped[0, ::-1]
    assert not Mesh(vertices, flipped).is_closed
    assert not Mesh(*height_field(4)).is_closed


def test_area_and_normals():
    mesh = Mesh(*cube(half=0.5, centre=UTM))
    assert mesh.area == pytest.approx(6, rel=1e-9)  # UTM coordinates are rounded at 1e-9
    centres = mesh.vertices[mesh.faces].mean(axis=1) - UTM
    assert (np.einsum("ni,ni->n", mesh.normals(), centres) > 0.4).all()
    flat = Mesh([(0, 0, 0), (1, 0, 0), (0, 1, 0)], [(0, 1, 2), (0, 0, 1)])
    np.testing.assert_array_equal(flat.normals(), [[0, 0, 1], [0, 0, 0]])
    assert flat.area == 0.5


def test_transformed_and_shifted():
    mesh = Mesh(*tetrahedron(), crs="EPSG:32632", unit="m")
    shifted = mesh.shifted(-UTM)
    np.testing.assert_array_equal(shifted.vertices, mesh.vertices + UTM)
    assert (shifted.crs, shifted.unit) == ("EPSG:32632", "m")
    scaled = mesh.transformed(Similarity(np.eye(3), np.ones(3), 2.0))
    assert scaled.area == pytest.approx(4 * mesh.area)
    mirrored = mesh.transformed(Affine(np.diag([-1.0, 1, 1]), np.zeros(3)))
    outward = mirrored.vertices[mirrored.faces].mean(axis=1) - mirrored.vertices.mean(axis=0)
    assert (np.einsum("ni,ni->n", mirrored.normals(), outward) > 0).all()


def test_sample_is_uniform_by_area():
    # Twenty faces of areas 1 to 20, cut from strips, with one face without area among them.
    heights = np.arange(21.0)
    x = np.arange(21) * 3.0
    vertices = np.concatenate([
        np.column_stack([x, np.zeros(21), x]),
        np.column_stack([x + 1, np.zeros(21), x]),
        np.column_stack([x, heights, x]),
    ])  # fmt: skip
    mesh = Mesh(vertices, np.arange(63).reshape(3, 21).T)
    count = 40_000
    cloud = mesh.sample(count, seed=3)
    face_rows = np.round(cloud.points[:, 2] / 3).astype(int)
    observed, expected = np.bincount(face_rows, minlength=21)[1:], count * heights[1:] / heights.sum()
    assert not (face_rows == 0).any()
    assert ((observed - expected) ** 2 / expected).sum() < chi2.ppf(0.999, 19)
    # Within a face: the four similar parts of a triangle get equally many points.
    s, t = cloud.points[:, 0] - 3 * face_rows, cloud.points[:, 1] / heights[face_rows]
    part = np.select([s > 0.5, t > 0.5, s + t < 0.5], [0, 1, 2], 3)
    assert ((np.bincount(part) - count / 4) ** 2 / (count / 4)).sum() < chi2.ppf(0.999, 3)
    np.testing.assert_array_equal(cloud.normals, np.tile([0.0, 0, 1], (count, 1)))


def test_samples_lie_on_the_mesh_and_are_reproducible():
    mesh = Mesh(*spiky_sphere(2), crs="EPSG:32632", unit="m")
    cloud = mesh.sample(2000, seed=1)
    # A coordinate has five roundings, and the distance about as many.
    rounding = 10 * np.finfo(float).eps * np.abs(mesh.vertices).max()
    assert MeshIndex(mesh).query(cloud.points).distances.max() < rounding
    np.testing.assert_array_equal(cloud.points, mesh.sample(2000, seed=1).points)
    assert not np.array_equal(cloud.points, mesh.sample(2000, seed=2).points)
    assert (cloud.crs, cloud.unit, len(mesh.sample(1))) == ("EPSG:32632", "m", 1)
    with check_error():
        mesh.sample(0)


VERTICES, FACES = tetrahedron()
INVALID_MESHES = {
    "no faces": (VERTICES, np.empty((0, 3), int)),
    "quads": (VERTICES, [(0, 1, 2, 3)]),
    "floats": (VERTICES, FACES * 1.0),
    "too high": (VERTICES, [(0, 1, 4)]),
    "negative": (VERTICES, [(0, 1, -1)]),
    "nan": (np.where(VERTICES == 0, np.nan, 1), FACES),
    "flat": (VERTICES[:, :2], FACES),
    "words": ("mesh", FACES),
    "no area": (VERTICES, [(0, 1, 1)]),
    "overflow": (VERTICES * 1e200, FACES),
}


@pytest.mark.parametrize("name", INVALID_MESHES)
def test_invalid_meshes_are_refused(name):
    vertices, faces = INVALID_MESHES[name]
    with check_error():
        Mesh(vertices, faces)


def test_a_pickled_index_gives_the_same_distances():
    index = MeshIndex(Mesh(*spiky_sphere()))
    copy = pickle.loads(pickle.dumps(index))
    queries = np.random.default_rng(0).normal(size=(200, 3))
    for found, again in zip(index.query(queries), copy.query(queries), strict=True):
        np.testing.assert_array_equal(found, again)
