"""Clouds of the synthetic city with noise and a dome, and the verdict on two of them."""

import numpy as np

from pcbench import Cloud
from pcbench.deformation import deform
from pcbench.scenes.synthetic import city


def sample_city(count, rng):
    """Return points (count, 3) of the city, in metres."""
    return city(3).sample(count, rng)[0]


def add_noise(points, rng, size=0.02):
    return points + rng.normal(0, size, points.shape)


def add_dome(points, rms):
    """Return the points, lowered towards the edge by displacements of this RMS."""
    squared_radius = np.square(points[:, :2]).sum(axis=1)
    lift = squared_radius - squared_radius.mean()
    return points + rms * (lift / lift.std())[:, None] * [0, 0, -1]


def verdict(reference, candidate, method="icp", **options):
    return deform(Cloud(reference, unit="m", **options), Cloud(candidate, unit="m"), method)[1]


def warning_codes(deformation):
    """Return the codes of the warnings."""
    return [notice.code for notice in deformation.warnings]
