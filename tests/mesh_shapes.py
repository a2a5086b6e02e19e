"""Triangle meshes as (vertices (V, 3), faces (F, 3)), anticlockwise seen from outside. Imports nothing from pcbench."""

import numpy as np


def cube(half=1.0, centre=(0.0, 0.0, 0.0)):
    """The cube [-half, half]^3 about its centre."""
    corners = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [triangle for a, b, c, d in quads for triangle in ((a, b, c), (a, c, d))]
    return half * corners + np.asarray(centre), np.array(faces)


def tetrahedron():
    """The tetrahedron with corners at the origin and the three unit points."""
    vertices = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)], dtype=float)
    return vertices, np.array([(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)])


def icosphere(levels=3):
    """An icosahedron subdivided `levels` times, with vertices on the unit sphere: 20 * 4^levels faces."""
    golden = (1 + np.sqrt(5)) / 2
    vertices = [(x, y * golden, 0) for x in (-1, 1) for y in (-1, 1)]
    vertices = np.array([np.roll(v, shift) for shift in range(3) for v in vertices], dtype=float)
    edge = 2.0
    distances = np.linalg.norm(vertices[:, None] - vertices[None], axis=2)
    faces = [
        (a, b, c)
        for a in range(12)
        for b in range(12)
        for c in range(12)
        if a < min(b, c) and np.allclose([distances[a, b], distances[b, c], distances[c, a]], edge)
        and np.linalg.det(vertices[[a, b, c]]) > 0
    ]  # fmt: skip
    faces = np.array(faces)
    vertices /= np.linalg.norm(vertices, axis=1, keepdims=True)
    for _ in range(levels):
        edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
        edges, inverse = np.unique(edges, axis=0, return_inverse=True)
        middles = vertices[edges].sum(axis=1)
        ab, bc, ca = (len(vertices) + inverse.reshape(3, -1)).tolist()
        vertices = np.concatenate([vertices, middles / np.linalg.norm(middles, axis=1, keepdims=True)])
        a, b, c = faces.T
        faces = np.concatenate([np.column_stack(f) for f in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))])
    return vertices, faces


def spiky_sphere(levels=2, seed=0):
    """An icosphere with random radii from 0.3 to 1.5: closed, star-shaped about the origin, with sharp edges."""
    vertices, faces = icosphere(levels)
    return vertices * np.random.default_rng(seed).uniform(0.3, 1.5, (len(vertices), 1)), faces


def height_field(n, seed=0):
    """A rough open surface of 2 (n - 1)^2 faces over the unit square."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.linspace(0, 1, n), np.linspace(0, 1, n), indexing="ij")
    z = 0.05 * np.sin(20 * x) * np.cos(17 * y) + rng.normal(0, 0.1 / n, x.shape)
    index = np.arange(n * n).reshape(n, n)
    a, b, c, d = (part.ravel() for part in (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]))
    faces = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    return np.column_stack([x.ravel(), y.ravel(), z.ravel()]), faces


def triangle_soup(count):
    """Separate triangles spread through a cube."""
    rng = np.random.default_rng(21)
    corners = rng.random((count, 1, 3)) + rng.normal(0, 1e-2, (count, 3, 3))
    return corners.reshape(-1, 3), np.arange(3 * count).reshape(-1, 3)
