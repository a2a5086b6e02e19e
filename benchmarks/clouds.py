"""Synthetic clouds of three densities, for benchmarks."""

import numpy as np
from numpy.typing import NDArray

Points = NDArray[np.float64]

BLOCKS, SIZE = 20, 1000.0  # city blocks per side; side in metres


def _city(rng: np.random.Generator, xy: Points) -> Points:
    """Return points on the ground, roofs and walls of box buildings at positions in the plane."""
    layout = np.random.default_rng(5)
    heights, widths = (
        layout.uniform(6, 40, (BLOCKS, BLOCKS)),
        layout.uniform(0.4, 0.7, (BLOCKS, BLOCKS)) * SIZE / BLOCKS,
    )
    block = ((xy / SIZE + 0.5) * BLOCKS).astype(int).clip(0, BLOCKS - 1)
    center = ((block + 0.5) / BLOCKS - 0.5) * SIZE
    height, width = heights[block[:, 0], block[:, 1]], widths[block[:, 0], block[:, 1]]
    on_roof = (np.abs(xy - center) < width[:, None] / 2).all(axis=1)
    flat = np.column_stack([xy, np.where(on_roof, height, 0.0)])
    along, side = rng.uniform(-0.5, 0.5, len(xy)) * width, rng.choice([-0.5, 0.5], len(xy)) * width
    faces_x = rng.random((len(xy), 1)) < 0.5
    wall_xy = center + np.where(faces_x, np.column_stack([side, along]), np.column_stack([along, side]))
    walls = np.column_stack([wall_xy, rng.random(len(xy)) * height])
    return np.where(rng.random((len(xy), 1)) < 0.35, walls, flat)


def uniform_city(rng: np.random.Generator, count: int) -> Points:
    """Sample a city evenly."""
    return _city(rng, rng.uniform(-SIZE / 2, SIZE / 2, (count, 2)))


def centre_heavy(rng: np.random.Generator, count: int) -> Points:
    """Sample a city more densely in its centre."""
    return _city(rng, rng.normal(0, SIZE / 7, (count, 2)).clip(-SIZE / 2, SIZE / 2))


def scan_lines(rng: np.random.Generator, count: int) -> Points:
    """Simulate a spinning LiDAR of 64 rings at a few stations between walls: dense along its lines, sparse across."""
    station = rng.integers(0, 9, count)
    elevation = np.radians(np.linspace(-24, 4, 64))[rng.integers(0, 64, count)]
    azimuth = np.radians(0.1 * rng.integers(0, 3600, count) + rng.normal(0, 0.005, count))
    to_wall = 25 / np.maximum(np.abs(np.cos(azimuth)), np.abs(np.sin(azimuth)))
    to_ground = np.where(elevation < 0, 1.8 / np.maximum(-np.tan(elevation), 1e-9), np.inf)
    reach = np.minimum(to_wall, to_ground) + rng.normal(0, 0.01, count)
    x = 60.0 * (station % 3) + reach * np.cos(azimuth)
    y = 60.0 * (station // 3) + reach * np.sin(azimuth)
    return np.column_stack([x, y, 1.8 + reach * np.tan(elevation)])


DENSITIES = {"uniform city": uniform_city, "centre-heavy": centre_heavy, "scan lines": scan_lines}


def pair(density: str, count: int) -> tuple[Points, Points]:
    """Return a reference, and a candidate with a fifth of its points and 3 cm of noise."""
    rng = np.random.default_rng(count)
    reference = DENSITIES[density](rng, count)
    # A city is photographed from around its centre, so the candidate is denser there.
    candidate = (centre_heavy if density == "uniform city" else DENSITIES[density])(rng, count // 5)
    return reference, candidate + rng.normal(0, 0.03, candidate.shape)
