"""Surfaces with closed-form properties, as numpy arrays; the caller seeds all random numbers."""

import numpy as np

# Projected coordinates: multiples of a quarter, decimals without a binary representation, and integers.
UTM = np.array([468_012.25, 5_428_771.5, 312.0])
UTM_DECIMAL = np.array([512_345.678, 5_612_345.678, 123.456])
UTM_WHOLE = np.array([500_000.0, 4_800_000.0, 0.0])


def plane_grid(n=20, spacing=1.0, height=0.0):
    """Return (n * n, 3) points of a square grid in the plane z = height from the origin, x fastest."""
    x, y = np.meshgrid(np.arange(n) * spacing, np.arange(n) * spacing)
    return np.column_stack([x.ravel(), y.ravel(), np.full(n * n, float(height))])


def plane_samples(n, size=10.0, seed=0):
    """Return (n, 3) uniform random points of the square [0, size]^2 in z = 0."""
    points = np.zeros((n, 3))
    points[:, :2] = np.random.default_rng(seed).uniform(0, size, (n, 2))
    return points


def sphere(n, radius=1.0, centre=(0.0, 0.0, 0.0), seed=0):
    """Return (n, 3) uniform random points of a sphere and their outward unit normals (n, 3)."""
    directions = np.random.default_rng(seed).normal(size=(n, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return np.asarray(centre) + radius * directions, directions


def fibonacci_sphere(n, radius=1.0):
    """Return (n, 3) evenly spread points of a sphere about the origin, and their unit normals; deterministic."""
    z = 1 - (2 * np.arange(n) + 1) / n
    angle = np.arange(n) * np.pi * (3 - np.sqrt(5))
    ring_radius = np.sqrt(1 - z**2)
    directions = np.column_stack([ring_radius * np.cos(angle), ring_radius * np.sin(angle), z])
    return radius * directions, directions


def terrain_height(x, y):
    """Return z = 2 sin(x / 5) + 1.5 cos(y / 7) + 0.5 sin((x + y) / 3), which has no symmetry to slip along."""
    return 2 * np.sin(x / 5) + 1.5 * np.cos(y / 7) + 0.5 * np.sin((x + y) / 3)


def terrain_normals(points):
    """Return upward unit normals (N, 3) of the terrain at points (N, 3) on it."""
    x, y = points[:, 0], points[:, 1]
    common_slope = 0.5 / 3 * np.cos((x + y) / 3)
    slope_x, slope_y = 2 / 5 * np.cos(x / 5) + common_slope, -1.5 / 7 * np.sin(y / 7) + common_slope
    normals = np.column_stack([-slope_x, -slope_y, np.ones(len(points))])
    return normals / np.linalg.norm(normals, axis=1, keepdims=True)


def terrain(n, size=40.0, seed=0):
    """Return (n, 3) points of the bumpy terrain over [0, size]^2 and their upward unit normals (n, 3)."""
    x, y = np.random.default_rng(seed).uniform(0, size, (2, n))
    points = np.column_stack([x, y, terrain_height(x, y)])
    return points, terrain_normals(points)


# (x, y) of the lower corner, width along x, depth along y, height: all different, so that no motion maps the city
# onto itself.
CITY_BOXES = (
    ((5.0, 6.0), 8.0, 6.0, 12.0),
    ((20.0, 8.0), 5.0, 9.0, 7.0),
    ((34.0, 30.0), 10.0, 7.0, 18.0),
    ((10.0, 32.0), 7.0, 11.0, 5.0),
    ((40.0, 10.0), 4.0, 4.0, 9.0),
)
CITY_SIZE = 50.0


def city_faces():
    """Return faces of a city as (corner (3,), edge (3,), edge (3,), outward unit normal (3,)): ground, then boxes.

    The ground continues under the boxes, as an exact plane z = 0.
    """
    size = CITY_SIZE
    faces = [((0.0, 0.0, 0.0), (size, 0.0, 0.0), (0.0, size, 0.0), (0.0, 0.0, 1.0))]
    for (x, y), width, depth, height in CITY_BOXES:
        along, across, up = (width, 0.0, 0.0), (0.0, depth, 0.0), (0.0, 0.0, height)
        faces += [
            ((x, y, height), along, across, (0.0, 0.0, 1.0)),
            ((x, y, 0.0), along, up, (0.0, -1.0, 0.0)),
            ((x, y + depth, 0.0), along, up, (0.0, 1.0, 0.0)),
            ((x, y, 0.0), across, up, (-1.0, 0.0, 0.0)),
            ((x + width, y, 0.0), across, up, (1.0, 0.0, 0.0)),
        ]
    return [tuple(np.array(part) for part in face) for face in faces]


def city(n, noise=0.0, seed=0):
    """Sample a small city of ground and boxes uniformly by area.

    Returns:
        points (n, 3), outward unit normals (n, 3), index (n,) of the face in `city_faces()`. `noise` is the standard
        deviation of a normal error along the face's normal: the distance to the face's plane is that error.
    """
    generator = np.random.default_rng(seed)
    faces = city_faces()
    areas = np.array([np.linalg.norm(np.cross(first, second)) for _, first, second, _ in faces])
    face_rows = generator.choice(len(faces), size=n, p=areas / areas.sum())
    corner, first, second, normal = (np.array(part)[face_rows] for part in zip(*faces, strict=True))
    u, v = generator.uniform(size=(2, n, 1))
    return corner + u * first + v * second + noise * generator.normal(size=(n, 1)) * normal, normal, face_rows


def rotation(axis, angle_deg):
    """Return the rotation matrix (3, 3) by Rodrigues' formula."""
    x, y, z = np.asarray(axis, dtype=float) / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    angle = np.deg2rad(angle_deg)
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
