"""Ray casting: a brute force in numpy, watertightness, limits, and refusals."""

import numpy as np
import pytest
from mesh_shapes import cube, icosphere
from oracles import first_hits
from shapes import UTM
from wording import check_error

from pcbench.geometry.mesh import Mesh, MeshIndex


@pytest.mark.parametrize("offset", [np.zeros(3), UTM], ids=["origin", "utm"])
def test_rays_equal_brute_force(offset):
    rng = np.random.default_rng(3)
    vertices, faces = rng.normal(size=(300, 3)), rng.integers(0, 300, (400, 3))
    faces = faces[(np.diff(np.sort(faces), axis=1) > 0).all(axis=1)]
    vertices = vertices * [10, 10, 4] + offset
    origins = rng.normal(0, 15, (400, 3)) + offset
    directions = rng.normal(size=(400, 3)) * rng.choice([1e-3, 1, 50], (400, 1))
    directions[:30, rng.integers(0, 3)] = 0  # along the boxes' faces
    hits = MeshIndex(Mesh(vertices, faces)).cast(origins, directions)
    expected = first_hits(origins, directions, vertices, faces)
    assert 50 < np.isfinite(expected).sum() < 400
    np.testing.assert_array_equal(np.isfinite(hits.distances), np.isfinite(expected))
    is_hit = np.isfinite(expected)
    # The oracle's 3x3 systems lose digits for triangles that are slender or seen edge-on.
    np.testing.assert_allclose(hits.distances[is_hit], expected[is_hit], rtol=1e-6)
    assert (hits.faces[~is_hit] == -1).all()
    assert (hits.faces[is_hit] >= 0).all()


def test_hits_lie_in_the_plane_of_their_face():
    rng = np.random.default_rng(4)
    vertices, faces = icosphere(3)
    index = MeshIndex(Mesh(vertices, faces))
    origins, directions = rng.normal(0, 0.1, (2000, 3)), rng.normal(size=(2000, 3))
    hits = index.cast(origins, directions)
    positions = origins + hits.distances[:, None] * directions
    corners, normals = vertices[faces[hits.faces, 0]], index.mesh.normals()[hits.faces]
    assert (
        np.abs(np.einsum("ni,ni->n", positions - corners, normals)).max() < 1e-14
    )  # rounding of coordinates of about 1
    np.testing.assert_array_equal(index.is_occluded(origins, directions), np.ones(2000, dtype=bool))


def test_rays_are_watertight():
    """Rays from inside a closed mesh through its vertices and edges, where gaps would be."""
    vertices, faces = icosphere(3)
    index = MeshIndex(Mesh(vertices, faces))
    rng = np.random.default_rng(5)
    s = rng.random((len(faces), 1))
    edges = vertices[faces[:, 0]] * s + vertices[faces[:, 1]] * (1 - s)
    for origin in ([0, 0, 0], [0.123, -0.31, 0.2]):
        for targets in (vertices, edges):
            hits = index.cast(origin, targets - np.array(origin))
            np.testing.assert_allclose(hits.distances, 1, rtol=1e-12)


def test_occlusion_is_limited_to_a_distance():
    vertices, faces = cube()
    index = MeshIndex(Mesh(vertices, faces))
    low, high = np.min(vertices, axis=0), np.max(vertices, axis=0)
    start = (low + high) / 2 - [0, 0, 10 * (high - low)[2]]
    up = np.array([[0.0, 0.0, (high - low)[2]]])
    assert index.cast(start, up).distances[0] == pytest.approx(9.5)
    assert index.is_occluded(start, up, limit=9.6)[0]
    assert not index.is_occluded(start, up, limit=9.4)[0]
    assert not index.is_occluded(start, -up)[0]  # nothing behind the origin


def test_invalid_rays_are_refused():
    index = MeshIndex(Mesh(*cube()))
    for origins, directions in (
        ([[0, 0, 0]], [[0, 0, 0]]),
        ([[0, 0, np.nan]], [[0, 0, 1]]),
        ([[0, 0, 0], [1, 1, 1]], [[0, 0, 1]]),
        ([0, 0], [[0, 0, 1]]),
    ):
        with check_error():
            index.cast(origins, directions)
