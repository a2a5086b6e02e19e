"""Analytic surfaces with independent, error-free samples of uniform or decreasing density."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Draw = Callable[[int, np.random.Generator], tuple[Floats, Floats]]


class Surface(NamedTuple):
    """Surface of size 1: `draw(n, rng)` samples points (n, 3) uniformly by area, with unit normals (n, 3)."""

    name: str
    draw: Draw

    def sample(self, count: int, rng: np.random.Generator, falling: float = 1.0) -> tuple[Floats, Floats]:
        """Sample points and normals, `falling` times denser at one end of the x axis than at the other."""
        if falling == 1:
            return self.draw(count, rng)
        points, normals = self.draw(int(count * falling), rng)
        x = points[:, 0]
        share = (x - x.min()) / np.ptp(x)
        rows = np.flatnonzero(rng.random(len(x)) < falling**-share)
        rows = np.sort(rng.permutation(rows)[:count])
        return points[rows], normals[rows]


def plane(count: int, rng: np.random.Generator) -> tuple[Floats, Floats]:
    return np.column_stack([rng.random((count, 2)), np.zeros(count)]), np.tile([0.0, 0, 1], (count, 1))


def torus(count: int, rng: np.random.Generator) -> tuple[Floats, Floats]:
    major_radius, minor_radius = 0.35, 0.15
    u = rng.uniform(0, 2 * np.pi, 3 * count)
    v = rng.uniform(0, 2 * np.pi, 3 * count)
    rows = np.flatnonzero(
        rng.random(3 * count) * (major_radius + minor_radius) < major_radius + minor_radius * np.cos(v)
    )[:count]
    u, v = u[rows], v[rows]
    normals = np.column_stack([np.cos(v) * np.cos(u), np.cos(v) * np.sin(u), np.sin(v)])
    return major_radius * np.column_stack([np.cos(u), np.sin(u), np.zeros(len(u))]) + minor_radius * normals, normals


def sphere(count: int, rng: np.random.Generator) -> tuple[Floats, Floats]:
    normals = rng.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    return 0.5 * normals, normals


def cylinder(count: int, rng: np.random.Generator) -> tuple[Floats, Floats]:
    u = rng.uniform(0, 2 * np.pi, count)
    normals = np.column_stack([np.zeros(count), np.cos(u), np.sin(u)])
    return 0.12 * normals + np.column_stack([rng.random(count), np.zeros((count, 2))]), normals


def buildings(along: int, seed: int) -> Draw:
    """Return the sampler of `along` by `along` boxes of five faces, and the ground between them."""
    layout = np.random.default_rng(seed)
    pitch = 1 / along
    widths = layout.uniform(0.4, 0.7, (along * along, 2)) * pitch
    heights = layout.uniform(0.3, 1.0, along * along) * min(pitch, 0.25)
    row, column = np.divmod(np.arange(along * along), along)
    centers = (np.column_stack([row, column]) + 0.5) * pitch
    faces = []  # corner, two edges, normal
    for (x, y), (w, d), h in zip(centers, widths, heights, strict=True):
        corner = np.array([x - w / 2, y - d / 2, 0])
        a, b, c = np.diag([w, d, h])
        faces.append((corner + c, a, b, [0, 0, 1]))
        faces += [(corner, a, c, [0, -1, 0]), (corner + b, a, c, [0, 1, 0])]
        faces += [(corner, b, c, [-1, 0, 0]), (corner + a, b, c, [1, 0, 0])]
    corners, a, b, normals = (np.array(part, float) for part in zip(*faces, strict=True))
    areas = np.linalg.norm(np.cross(a, b), axis=1)

    def draw(count: int, rng: np.random.Generator) -> tuple[Floats, Floats]:
        ground_area = 1 - np.prod(widths, axis=1).sum()
        on_ground = rng.binomial(count, ground_area / (ground_area + areas.sum()))
        ground = rng.random((8 * on_ground + 64, 2))
        box = np.floor(ground / pitch).astype(int).clip(0, along - 1) @ [along, 1]
        ground = ground[(np.abs(ground - centers[box]) > widths[box] / 2).any(axis=1)][:on_ground]
        face = rng.choice(len(areas), count - len(ground), p=areas / areas.sum())
        s, t = rng.random((2, len(face), 1))
        flat = np.column_stack([ground, np.zeros(len(ground))])
        places = np.vstack([flat, corners[face] + s * a[face] + t * b[face]])
        directions = np.vstack([np.tile([0.0, 0, 1], (len(ground), 1)), normals[face]])
        order = rng.permutation(count)
        return places[order], directions[order]

    return draw


@cache
def surface(name: str) -> Surface:
    """Return a surface: plane, torus, sphere, cylinder, boxes (3 by 3) or city (12 by 12)."""
    draws: dict[str, Draw] = {
        "plane": plane,
        "torus": torus,
        "sphere": sphere,
        "cylinder": cylinder,
        "boxes": buildings(3, seed=1),
        "city": buildings(12, seed=2),
    }
    return Surface(name, draws[name])
