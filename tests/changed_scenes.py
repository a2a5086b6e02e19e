"""Rolling terrain in two independent samples, and objects that stand on it."""

import numpy as np

NOISE = 0.02
SIZE = 100.0
_DENSITY = 2.0  # points per square unit


def height(x, y):
    """Height of the terrain."""
    return 1.5 * np.sin(x / 9) + np.cos(y / 7)


def ground(seed):
    """Return 20,000 points of the terrain with noise."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(-SIZE / 2, SIZE / 2, (2, int(_DENSITY * SIZE**2)))
    return np.column_stack([x, y, height(x, y)]) + rng.normal(0, NOISE, (len(x), 3))


def box(center, size, seed, density=4.0):
    """Return points of the walls and the top of a box on the terrain."""
    rng = np.random.default_rng(seed)
    faces = []
    for axis, sides in ((0, (0, 1)), (1, (0, 1)), (2, (1,))):
        others = [k for k in range(3) if k != axis]
        for side in sides:
            count = int(density * size[others[0]] * size[others[1]])
            points = rng.uniform(0, 1, (count, 3))
            points[:, axis] = side
            faces.append(points * size)
    corner = np.array([*center, height(*center)]) - [size[0] / 2, size[1] / 2, 0]
    points = np.concatenate(faces) + corner
    return points + rng.normal(0, NOISE, points.shape)


def disc(points, radius, center=(10.0, 5.0)):
    """Return (N,) whether points lie in a vertical cylinder."""
    return np.hypot(*(points[:, :2] - center).T) < radius
