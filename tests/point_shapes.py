"""Arrangements of n points (n, 3) that are difficult for searches. Imports nothing from pcbench."""

import numpy as np


def uniform_points(rng, n):
    return rng.uniform(-1, 1, (n, 3))


def clustered_points(rng, n):
    centers = rng.uniform(-1000, 1000, (12, 3))
    return centers[rng.integers(0, 12, n)] + rng.normal(0, 1, (n, 3)) * 10.0 ** rng.uniform(-4, 1, (n, 1))


def planar_points(rng, n):
    return np.column_stack([rng.uniform(-50, 50, (n, 2)), np.full(n, 3.25)])


def oblique_plane(rng, n):
    return rng.uniform(-50, 50, (n, 2)) @ np.array([[0.6, 0.64, 0.48], [0.8, -0.48, -0.36]])


def collinear_points(rng, n):
    return rng.uniform(-1, 1, (n, 1)) * np.array([[3.0, -2.0, 0.5]])


def duplicated_points(rng, n):
    return rng.uniform(0, 1, (max(1, n // 5), 3))[rng.integers(0, max(1, n // 5), n)]


def grid_points(rng, n):
    return rng.integers(0, 8, (n, 3)).astype(np.float64)


def identical_points(rng, n):
    return np.full((n, 3), 7.5)


def half_at_origin(rng, n):
    return np.where(rng.random((n, 1)) < 0.5, 0.0, rng.uniform(-5, 5, (n, 3)))


def utm_points(rng, n):
    return rng.uniform(0, 300, (n, 3)) + np.array([5e5, 4.8e6, 100.0])


def tiny_points(rng, n):
    return rng.uniform(-1e-12, 1e-12, (n, 3))


def huge_points(rng, n):
    return rng.uniform(-1e12, 1e12, (n, 3))


def far_outlier(rng, n):
    points = rng.uniform(0, 1, (n, 3))
    points[0] = 1e12
    return points


SHAPES = [
    uniform_points, clustered_points, planar_points, oblique_plane, collinear_points, duplicated_points, grid_points,
    identical_points, half_at_origin, utm_points, tiny_points, huge_points, far_outlier,
]  # fmt: skip
