"""Scenes for the registration trials: clouds that are cut into independent halves, one of which is moved.

Some have surfaces everywhere (objects, a room, a town), others do not (forest, hills, a scanned street). Some need real
data (environment variable PCBENCH_DATA) and are left out without it.
"""

import os
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from pcbench import Mesh, read_cloud, read_mesh
from pcbench.geometry.arrays import FloatArray
from pcbench.scenes.synthetic import city

_MAX_POINTS = 80_000

Scene = Callable[[int], FloatArray]


def forest(_: int) -> FloatArray:
    """Airborne scan of a conifer forest."""
    return _read_scan("wild/MixedConifer.laz")


def hills(_: int) -> FloatArray:
    """Airborne scan of hills."""
    return _read_scan("wild/Topography.laz")


def street(_: int) -> FloatArray:
    """Vehicle scan of a street."""
    return _read_scan("small_gicp/target.ply")


def crossing(_: int) -> FloatArray:
    """Vehicle scan of a crossing."""
    return _read_scan("small_gicp/source.ply")


def stadium(_: int) -> FloatArray:
    """Airborne scan of a stadium."""
    return _read_scan("autzen/autzen_trim.las")


def town(seed: int) -> FloatArray:
    """Part of a synthetic town, 150 m wide."""
    rng = np.random.default_rng(seed)
    points = city(seed).sample(350_000, rng)[0]
    return points[np.abs(points[:, :2]).max(axis=1) < 75]


def room(seed: int) -> FloatArray:
    """Depth image of a room of 4.2 m x 5.6 m x 2.6 m with a dozen boxes: dense nearby, sparse far away."""
    rng = np.random.default_rng(seed)
    size = np.array([4.2, 5.6, 2.6])
    half_size = rng.uniform(0.15, 0.6, (12, 3)) * [1, 1, 1.3]
    center = np.column_stack([rng.uniform(0.5, 3.7, 12), rng.uniform(1.5, 5.2, 12), half_size[:, 2]])
    eye = np.array([2.1, 0.3, 1.5])
    u, v = (grid.ravel() for grid in np.meshgrid(np.linspace(-0.75, 0.75, 320), np.linspace(-0.56, 0.56, 240)))
    rays = np.column_stack([u, np.ones_like(u), v - 0.15])
    depth = np.where(rays > 0, (size - eye) / rays, -eye / rays).min(axis=1)
    for box_center, box_half_size in zip(center, half_size, strict=True):
        enter, leave = np.sort(
            [(box_center - box_half_size - eye) / rays, (box_center + box_half_size - eye) / rays], axis=0
        )
        entry_depth, exit_depth = enter.max(axis=1), leave.min(axis=1)
        depth = np.where((entry_depth < exit_depth) & (entry_depth > 0), np.minimum(depth, entry_depth), depth)
    return eye + rays * (depth + rng.normal(0, 0.002, len(depth)) * depth**2)[:, None]


def bumps(seed: int) -> FloatArray:
    """Sphere of radius 1 with waves in ten directions."""
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(60_000, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    waves, phases = rng.normal(0, 2.5, (10, 3)), rng.uniform(0, 2 * np.pi, 10)
    return directions * (1 + 0.05 * np.sin(directions @ waves.T + phases).sum(axis=1))[:, None]


def knot(seed: int) -> FloatArray:
    """Trefoil knot of a tube with varying thickness."""
    rng = np.random.default_rng(seed)
    t, tube_angle = rng.uniform(0, 2 * np.pi, (2, 60_000))
    middle, next_middle = _trefoil(t), _trefoil(t + 1e-4)
    tangent = (next_middle - middle) / np.linalg.norm(next_middle - middle, axis=1)[:, None]
    side = np.cross(tangent, [0.3, 0.5, 0.8])
    side /= np.linalg.norm(side, axis=1)[:, None]
    radial = np.cos(tube_angle)[:, None] * side + np.sin(tube_angle)[:, None] * np.cross(tangent, side)
    return middle + (0.35 + 0.12 * np.sin(t + 1))[:, None] * radial


def rough_ground(seed: int) -> FloatArray:
    """Rolling ground of 200 m with shrubs, whose returns are up to 3 m high, on a third of it."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform(-100, 100, (60_000, 2))
    waves, phases = rng.normal(0, 0.12, (25, 2)), rng.uniform(0, 2 * np.pi, 25)
    heights = np.sin(xy @ waves.T + phases) @ (0.25 / np.linalg.norm(waves, axis=1).clip(0.05))
    has_shrub = np.sin(xy @ rng.normal(0, 0.4, (6, 2)).T).sum(axis=1) > 1
    return np.column_stack([xy, heights + has_shrub * rng.uniform(0, 3, len(xy)) + rng.normal(0, 0.1, len(xy))])


# Thresholds were tuned on the first group, and on other trials of the hills.
TUNED: dict[str, Scene] = {"forest": forest, "street": street, "town": town, "room": room, "bumps": bumps}
HELD_OUT: dict[str, Scene] = {
    "hills": hills,
    "crossing": crossing,
    "stadium": stadium,
    "rough ground": rough_ground,
    "knot": knot,
}


def mesh_scenes(folder: Path) -> dict[str, Scene]:
    """Return one scene per mesh in a folder, with 60,000 points each."""
    meshes = {path.stem: read_mesh(path) for path in sorted(folder.iterdir())}
    return {name: partial(_sample, mesh) for name, mesh in meshes.items()}


def available_scenes(scenes: dict[str, Scene]) -> dict[str, Scene]:
    """Return the scenes whose data exist."""
    result = {}
    for name, scene in scenes.items():
        try:
            scene(0)
        except FileNotFoundError:
            continue
        result[name] = scene
    return result


def _sample(mesh: Mesh, seed: int) -> FloatArray:
    return mesh.sample(60_000, seed).points


def _trefoil(t: FloatArray) -> FloatArray:
    return np.column_stack([np.sin(t) + 2 * np.sin(2 * t), np.cos(t) - 2 * np.cos(2 * t), -np.sin(3 * t)])


def _read_scan(name: str) -> FloatArray:
    path = Path(os.environ.get("PCBENCH_DATA", Path(__file__).parents[2] / "shared" / "data"), name)
    if not path.exists():
        raise FileNotFoundError(path)
    points = read_cloud(path).points
    return _subsample(points - np.floor(points.mean(axis=0)))


def _subsample(points: FloatArray) -> FloatArray:
    """Return at most 80,000 of the points."""
    return points if len(points) <= _MAX_POINTS else np.random.default_rng(0).permutation(points)[:_MAX_POINTS]
