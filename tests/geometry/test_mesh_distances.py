"""Distances to meshes: closed forms, a brute force in numpy, signs by the winding number, and refusals."""

import os
import subprocess
import sys

import numpy as np
import pytest
from mesh_shapes import cube, height_field, icosphere, spiky_sphere, tetrahedron
from repository import TESTS
from shapes import UTM
from wording import check_error

from pcbench.geometry.mesh import Mesh, MeshIndex

# ---- oracles ----


def brute_force_distances(points, vertices, faces):
    """Distances (N,) and the lowest nearest face (N,): minimum over the plane (if inside the face) and the edges."""
    a, b, c = (vertices[faces[:, k]][None] for k in range(3))
    p = points[:, None, :]
    squared = np.minimum.reduce(
        [squared_edge_distances(p, a, b), squared_edge_distances(p, b, c), squared_edge_distances(p, c, a)]
    )
    e1, e2, d = b - a, c - a, p - a
    g11, g12, g22 = (e1 * e1).sum(-1), (e1 * e2).sum(-1), (e2 * e2).sum(-1)
    r1, r2 = (d * e1).sum(-1), (d * e2).sum(-1)
    det = g11 * g22 - g12**2
    with np.errstate(divide="ignore", invalid="ignore"):
        s, t = (g22 * r1 - g12 * r2) / det, (g11 * r2 - g12 * r1) / det
        inside = (det > 1e-20 * g11 * g22) & (s > 0) & (t > 0) & (s + t < 1)
        offset = d - s[..., None] * e1 - t[..., None] * e2
    squared = np.where(inside, np.minimum(squared, np.where(inside, (offset**2).sum(-1), 0)), squared)
    nearest_faces = squared.argmin(axis=1)
    return np.sqrt(squared[np.arange(len(points)), nearest_faces]), nearest_faces


def squared_edge_distances(p, a, b):
    ab = b - a
    length = (ab * ab).sum(-1)
    t = np.clip(((p - a) * ab).sum(-1) / np.where(length > 0, length, 1), 0, 1)
    return ((p - a - t[..., None] * ab) ** 2).sum(-1)


def winding_numbers(points, vertices, faces):
    """Winding number of the mesh about each point (N,): Van Oosterom and Strackee 1983."""
    a, b, c = (vertices[faces[:, k]][None] - points[:, None] for k in range(3))
    la, lb, lc = (np.linalg.norm(v, axis=-1) for v in (a, b, c))
    volume = (a * np.cross(b, c)).sum(-1)
    flat = la * lb * lc + (a * b).sum(-1) * lc + (b * c).sum(-1) * la + (c * a).sum(-1) * lb
    return np.arctan2(volume, flat).sum(axis=1) / (2 * np.pi)


def distance_to_closest(matches, points):
    return np.linalg.norm(points - matches.closest, axis=1)


# ---- distances ----


def test_cube_closed_form():
    points = np.random.default_rng(1).uniform(-3, 3, (5000, 3))
    beyond = np.abs(points) - 1
    outside = np.linalg.norm(np.maximum(beyond, 0), axis=1)
    exact = np.where(outside > 0, outside, beyond.max(axis=1))
    index = MeshIndex(Mesh(*cube()))
    np.testing.assert_allclose(index.query(points).distances, np.abs(exact), atol=1e-15)
    np.testing.assert_allclose(index.query(points, signed=True).distances, exact, atol=1e-15)


def test_tetrahedron_closed_form():
    index = MeshIndex(Mesh(*tetrahedron()))
    matches = index.query([(1, 1, 1), (-1, -2, -2), (0.25, 0.25, -3), (3, 0, 0), (0.1, 0.1, 0.1)], signed=True)
    expected = [2 / np.sqrt(3), 3, 3, 2, -0.1]
    np.testing.assert_allclose(matches.distances, expected, rtol=1e-15)
    np.testing.assert_allclose(matches.closest[:4], [[1 / 3] * 3, [0, 0, 0], [0.25, 0.25, 0], [1, 0, 0]], atol=1e-15)
    assert matches.faces[0] == 3
    assert matches.faces[1] == 0  # the origin lies on three faces: the lowest index wins


def test_icosphere_against_the_sphere():
    vertices, faces = icosphere(5)
    mesh = Mesh(vertices, faces)
    rng = np.random.default_rng(2)
    points = rng.normal(size=(5000, 3)) * rng.uniform(0.1, 2, (5000, 1))
    distances = MeshIndex(mesh).query(points, signed=True).distances
    # A chord of length e lies up to e^2 / 8 below the sphere, a triangle e^2 / 6; the longest edge here is 0.04.
    longest = np.linalg.norm(vertices[faces[:, 0]] - vertices[faces[:, 1]], axis=1).max()
    error = distances - (np.linalg.norm(points, axis=1) - 1)
    assert error.min() > -(longest**2) / 6 and error.max() < longest**2 / 6
    assert mesh.area == pytest.approx(4 * np.pi, rel=1e-3)
    assert mesh.is_closed


def degenerate_soup(seed, count=300):
    """Triangles of all sizes, a third of them degenerate: needles, three equal corners, corners on one line."""
    rng = np.random.default_rng(seed)
    corners = rng.normal(size=(count, 1, 3)) + rng.normal(size=(count, 3, 3)) * 10 ** rng.uniform(
        -4, 0.5, (count, 1, 1)
    )
    a, b, c = corners.transpose(1, 0, 2)
    c[0::12] = b[0::12]
    b[1::12] = c[1::12] = a[1::12]
    c[2::12] = a[2::12] + 0.5 * (b - a)[2::12]
    c[3::12] = a[3::12] + 0.3 * (b - a)[3::12] + 1e-9 * rng.normal(size=(len(c[3::12]), 3))
    return np.concatenate([a, b, c]), np.arange(3 * count).reshape(3, -1).T


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("origin", [np.zeros(3), UTM], ids=["near", "far"])
def test_distances_equal_brute_force(seed, origin):
    vertices, faces = degenerate_soup(seed)
    rng = np.random.default_rng(100 + seed)
    # The oracle's normal equations square the condition number of slender triangles: half the digits remain.
    tolerance = np.sqrt(np.finfo(float).eps) * np.abs(vertices).max()
    vertices = vertices + origin
    points = np.concatenate([
        rng.normal(size=(300, 3)) * 3 + origin,
        vertices[rng.integers(len(vertices), size=50)],  # on corners
        vertices[faces[:50, 0]] + 0.3 * (vertices[faces[:50, 1]] - vertices[faces[:50, 0]]),  # on edges
        vertices[faces[:50]].mean(axis=1),  # on faces
        rng.normal(size=(20, 3)) * 1e4 + origin,
    ])  # fmt: skip
    matches = MeshIndex(Mesh(vertices, faces)).query(points)
    distances, _ = brute_force_distances(points - origin, vertices - origin, faces)
    # Subtracting the origin is exact up to rounding of 1e-9 at a distance of a few hundred metres.
    np.testing.assert_allclose(matches.distances, distances, rtol=1e-12, atol=tolerance)
    own_distances = distances_to_own_triangles(points - origin, (vertices - origin)[faces[matches.faces]])
    np.testing.assert_allclose(own_distances, distances, rtol=1e-12, atol=tolerance)
    np.testing.assert_allclose(distance_to_closest(matches, points), matches.distances, rtol=1e-12, atol=3e-9)


def distances_to_own_triangles(points, corners):
    """Distance (N,) of each point to its own triangle (N, 3, 3)."""
    distances = [
        brute_force_distances(p[None], c, np.array([[0, 1, 2]]))[0][0] for p, c in zip(points, corners, strict=True)
    ]
    return np.array(distances)


def test_points_on_a_large_mesh():
    vertices, faces = height_field(30)
    points = np.random.default_rng(3).uniform(-0.2, 1.2, (400, 3)) * [1, 1, 0.2]
    matches = MeshIndex(Mesh(vertices, faces)).query(points)
    distances, _ = brute_force_distances(points, vertices, faces)
    np.testing.assert_allclose(matches.distances, distances, rtol=1e-12, atol=1e-15)
    vertex_matches = MeshIndex(Mesh(vertices, faces)).query(vertices)
    assert (vertex_matches.distances == 0).all()
    np.testing.assert_array_equal(vertex_matches.closest, vertices)


def test_ties_go_to_the_lowest_face():
    vertices, faces = height_field(12)
    lowest = np.array([np.flatnonzero((faces == v).any(axis=1)).min() for v in range(len(vertices))])
    index = MeshIndex(Mesh(vertices, faces))
    np.testing.assert_array_equal(index.query(vertices).faces, lowest)
    # Above a convex edge both faces give the same bits.
    ridge = Mesh([(0, 0, 0), (1.3, 0.7, 0.9), (-1, 1, -3), (2, -1, -3)], [(1, 0, 2), (0, 1, 3)])
    t = np.random.default_rng(4).uniform(0.1, 0.9, (200, 1))
    above_ridge = t * ridge.vertices[1] + [0.0, 0.0, 0.2]
    for faces in ([(1, 0, 2), (0, 1, 3)], [(0, 1, 3), (1, 0, 2)], [(3, 0, 1), (2, 1, 0)]):
        assert (MeshIndex(Mesh(ridge.vertices, faces)).query(above_ridge).faces == 0).all()
    doubled = Mesh(vertices, np.concatenate([index.mesh.faces, index.mesh.faces]))
    points = np.random.default_rng(5).uniform(0, 1, (500, 3))
    assert (MeshIndex(doubled).query(points).faces < len(index)).all()


def test_results_are_bit_identical_across_batches_threads_and_runs():
    vertices, faces = spiky_sphere(4)
    points = np.random.default_rng(6).normal(size=(3000, 3))
    index = MeshIndex(Mesh(vertices, faces))
    matches = index.query(points)
    for parts in ([points[:1], points[1:]], np.array_split(points, 37), [points[::-1]]):
        rows = [index.query(part) for part in parts]
        for field, expected in zip(zip(*rows, strict=True), matches, strict=True):
            got = np.concatenate(field)
            np.testing.assert_array_equal(got[::-1] if len(parts) == 1 else got, expected)
    script = (
        f"import sys\nsys.path.insert(0, {str(TESTS)!r})\n"
        "import hashlib, numpy as np\nfrom mesh_shapes import spiky_sphere\n"
        "from pcbench.geometry.mesh import Mesh, MeshIndex\n"
        "points = np.random.default_rng(6).normal(size=(3000, 3))\n"
        "matches = MeshIndex(Mesh(*spiky_sphere(4))).query(points)\n"
        "print(hashlib.sha256(b''.join(m.tobytes() for m in matches)).hexdigest())"
    )
    outputs = {
        subprocess.run([sys.executable, "-c", script], env={**os.environ, "OMP_NUM_THREADS": threads}, check=True,
                       capture_output=True).stdout
        for threads in ("1", "3")
    }  # fmt: skip
    assert len(outputs) == 1


@pytest.mark.parametrize("scale", [1e-30, 1e-9, 1e12, 1e60])
def test_signed_distances_scale_with_the_mesh(scale):
    vertices, faces = spiky_sphere(2)
    points = np.random.default_rng(7).normal(size=(500, 3))
    unscaled = MeshIndex(Mesh(vertices, faces)).query(points, signed=True)
    scaled = MeshIndex(Mesh(vertices * scale, faces)).query(points * scale, signed=True)
    np.testing.assert_allclose(scaled.distances, unscaled.distances * scale, rtol=1e-12)


def test_queries_far_away_are_exact():
    mesh = Mesh(*cube())
    points = np.array([(1e9, 0, 0), (0, -1e15, 0), (1e30, 0, 0), (0, 0, 1e100)])
    np.testing.assert_array_equal(MeshIndex(mesh).query(points).distances, np.linalg.norm(points, axis=1) - 1)


def test_thousands_of_identical_triangles():
    # No split separates boxes at one position.
    mesh = Mesh([(0, 0, 0), (1, 0, 0), (0, 1, 0)], np.tile([0, 1, 2], (50_000, 1)))
    matches = MeshIndex(mesh).query([(0.2, 0.2, 2.0), (-1, 0, 0)])
    np.testing.assert_array_equal(matches.distances, [2, 1])
    np.testing.assert_array_equal(matches.faces, [0, 0])


def test_no_queries_give_no_matches():
    assert [len(part) for part in MeshIndex(Mesh(*cube())).query(np.empty((0, 3)), signed=True)] == [0, 0, 0]


# ---- signs ----


@pytest.mark.parametrize("origin", [np.zeros(3), UTM], ids=["near", "far"])
@pytest.mark.parametrize("seed", range(3))
def test_signs_agree_with_the_winding_number(seed, origin):
    vertices, faces = spiky_sphere(2, seed)
    rng = np.random.default_rng(seed)
    edges = vertices[faces[:, 0]] + 0.4 * (vertices[faces[:, 1]] - vertices[faces[:, 0]])
    surface_points = np.concatenate([np.tile(vertices, (5, 1)), edges, vertices[faces].mean(axis=1)])
    points = np.concatenate([
        rng.normal(size=(1000, 3)),
        surface_points + rng.normal(size=surface_points.shape) * 10 ** rng.uniform(-6, -1, (len(surface_points), 1)),
    ])  # fmt: skip
    inside = winding_numbers(points, vertices, faces) > 0.5
    mesh = Mesh(vertices + origin, faces)
    distances = MeshIndex(mesh).query(points + origin, signed=True).distances
    off_surface = np.abs(distances) > 1e-8  # arctangents of the winding number, and coordinates rounded at 1e-9
    np.testing.assert_array_equal(distances[off_surface] < 0, inside[off_surface])
    assert inside.mean() > 0.2 and off_surface.mean() > 0.99


def test_pseudo_normals_need_angle_weights():
    # The closest point is a corner with many thin faces on one side, which would dominate unweighted normals.
    fan = 60
    angles = np.linspace(0, np.pi / 2, fan)
    rim = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(fan)])
    vertices = np.concatenate([[(0, 0, 0), (0, 0, -5)], rim])
    k = np.arange(2, fan + 1)
    top = np.column_stack([np.zeros_like(k), k, k + 1])
    skirt = np.column_stack([np.ones_like(k), k + 1, k])
    sides = np.array([(0, 1, 2), (0, fan + 1, 1)])
    faces = np.concatenate([top, skirt, sides])
    mesh = Mesh(vertices, faces)
    assert mesh.is_closed
    points = np.random.default_rng(8).normal(size=(4000, 3)) * 0.1
    inside = winding_numbers(points, vertices, faces) > 0.5
    np.testing.assert_array_equal(MeshIndex(mesh).query(points, signed=True).distances < 0, inside)


def test_signs_do_not_depend_on_face_orientation():
    vertices, faces = cube()
    points = [(0, 0, 0), (0, 0, 3), (0.9, 0.9, 0.9)]
    for oriented_faces in (faces, faces[:, ::-1]):
        distances = MeshIndex(Mesh(vertices, oriented_faces)).query(points, signed=True).distances
        np.testing.assert_allclose(distances, [-1, 2, -0.1], rtol=1e-14)


def test_faces_with_a_repeated_vertex_are_ignored():
    vertices, faces = spiky_sphere(2)
    needles = faces[:40, [0, 0, 1]]
    mesh = Mesh(vertices, np.concatenate([needles, faces]))
    assert mesh.is_closed
    points = np.random.default_rng(9).normal(size=(2000, 3))
    with_needles = MeshIndex(mesh).query(points, signed=True)
    without_needles = MeshIndex(Mesh(vertices, faces)).query(points, signed=True)
    assert (with_needles.faces < 40).any()
    np.testing.assert_array_equal(with_needles.distances, without_needles.distances)


def test_signed_distances_of_unsuitable_meshes_are_refused():
    vertices, faces = cube()
    with check_error():
        MeshIndex(Mesh(vertices, faces[1:])).query([(0, 0, 0)], signed=True)
    # Corner 8 on the edge 01 of the first face: a face of no area closes the gap.
    first, rest = faces[0], faces[1:]
    a, b, c = first
    split = [(a, 8, c), (8, b, c), (a, b, 8)]
    mesh = Mesh(np.concatenate([vertices, [(vertices[a] + vertices[b]) / 2]]), np.concatenate([split, rest]))
    assert mesh.is_closed
    with check_error():
        MeshIndex(mesh).query([(0, 0, 0)], signed=True)
    assert MeshIndex(mesh).query([(0, 0, 0)]).distances == 1
    assert (
        not MeshIndex(mesh).supports_signed_distance
        and not MeshIndex(Mesh(vertices, faces[1:])).supports_signed_distance
    )
    assert MeshIndex(Mesh(vertices, faces)).supports_signed_distance


# ---- refusals ----


def test_invalid_queries_are_refused():
    index = MeshIndex(Mesh(*cube()))
    with check_error():
        index.query(np.zeros(3))
    with check_error():
        index.query([(0, 0, np.nan)])


def test_kernel_validates_its_arguments():
    from pcbench.native import _core

    vertices, faces = cube()
    with check_error(IndexError):
        _core.MeshIndex(vertices, faces + 1)
    tree = _core.MeshIndex(vertices, faces)
    with check_error(ValueError):
        tree.query(np.zeros((2, 3)), np.empty(1), np.empty((2, 3)), np.empty(2, np.int64), np.empty(2, np.uint8))
