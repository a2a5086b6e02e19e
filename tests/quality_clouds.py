"""Made clouds with known noise, double walls, voids, strips and tilt, for the tests of quality without a reference."""

import numpy as np


def floor(rng, count, size, noise):
    """Return (count, 3) points of a level square with an edge, with noise in z."""
    return np.column_stack([rng.uniform(0, size, (count, 2)), rng.normal(0, noise, count)])


def wall(rng, count, length, height, noise, separation=0.0):
    """Return (count, 3) points of a wall along x, half of them a separation in front of the others."""
    offset = rng.normal(0, noise, count) + separation * (rng.random(count) < 0.5)
    return np.column_stack([rng.uniform(0, length, count), offset, rng.uniform(0, height, count)])


def building(rng, count, noise):
    """Return (count, 3) points of the walls of three by two rooms of 6 m, and of their floor."""
    parts = [floor(rng, count // 4, 18, noise)]
    sides = [(x, 0, 0, 12) for x in (0, 6, 12, 18)] + [(0, y, 18, 0) for y in (0, 6, 12)]
    for x, y, along, across in sides:
        number = int(0.75 * count * (along + across) / 102)
        s = rng.random((number, 1))
        places = np.hstack([[x, y] + s * [along, across], rng.uniform(0, 3, (number, 1))])
        places[:, 1 if along else 0] += rng.normal(0, noise, number)
        parts.append(places)
    return np.vstack(parts)


def turned(points, deg):
    """Return points (N, 3) turned about x."""
    cos, sin = np.cos(np.radians(deg)), np.sin(np.radians(deg))
    return points @ np.array([[1, 0, 0], [0, cos, -sin], [0, sin, cos]]).T
