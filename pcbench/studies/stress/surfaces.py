"""Surfaces of the built-in scenes as meshes: their exact distances and normals are the truth of the study."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.mesh import Mesh, MeshIndex
from pcbench.scenes.synthetic import city, relief
from pcbench.scenes.synthetic.plan import Tree
from pcbench.scenes.synthetic.surface import tree_shape

CITY_SIDE = 150.0  # metres
_UP = np.array([0.0, 0.0, 1.0])
_GROUND_STEP = 3.0  # metres between the ground's vertices: its waves deviate from the mesh by at most 0.5 mm
_TERRAIN_SIDE, _TERRAIN_STEP = 160.0, 1.5
_TREES = 300  # trees to place in the wooded city; those without space are left out
_ROOM = np.array([4.2, 5.6, 2.6])


def city_surface(seed: int) -> Mesh:
    """Return the middle of the synthetic city, with its curved ground as triangles."""
    patches = city(seed).patches
    middle = patches.corner + (patches.u + patches.v) / 2
    patches = patches.take(np.flatnonzero(np.abs(middle[:, :2]).max(axis=1) < CITY_SIDE / 2 + 25))
    parts = []
    for corner, u, v, triangle, kind in zip(*patches, strict=True):
        if triangle:
            parts.append((np.array([corner, corner + u, corner + v]), np.array([[0, 1, 2]])))
            continue
        step = _GROUND_STEP if kind == 0 else np.inf
        vertices, faces = _grid(corner, u, v, step)
        if kind == 0:
            vertices[:, 2] = relief(vertices[:, 0], vertices[:, 1])
        parts.append((vertices, faces))
    return _joined(parts)


def wooded_surface(seed: int) -> tuple[Mesh, IntArray]:
    """Return the city with trees of `pcbench synth city` on its ground, and the tree (F,) of each face or -1."""
    ground = city_surface(seed)
    index, rng = MeshIndex(ground), np.random.default_rng([seed, 5])
    parts, owners = [(ground.vertices, ground.faces)], [np.full(len(ground.faces), -1)]
    kept: list[Tree] = []
    for _ in range(_TREES):
        x, y = rng.uniform(-CITY_SIDE / 2, CITY_SIDE / 2, 2)
        height = float(rng.uniform(4, 11))
        radius = height * float(rng.uniform(0.26, 0.38))
        base = float(relief(x, y))
        tree = Tree(float(x), float(y), base, height, radius, int(rng.integers(1 << 30)))
        crown = np.array([x, y, base + 0.6 * height])
        # Crowns bulge by up to a fifth of the radius, and are clear of buildings and of each other.
        if index.query(crown[None]).distances[0] < 1.25 * radius or index.is_occluded(crown[None], _UP[None])[0]:
            continue
        if any(np.hypot(x - t.x, y - t.y) < 1.25 * (radius + t.radius) for t in kept):
            continue
        vertices, faces = tree_shape(tree, np.random.default_rng(tree.seed))
        parts.append((vertices, faces))
        owners.append(np.full(len(faces), len(kept)))
        kept.append(tree)
    return _joined(parts), np.concatenate(owners)


def terrain_surface(seed: int) -> Mesh:
    """Return rolling ground of 160 m: waves of 8 to 80 m, higher the longer they are."""
    rng = np.random.default_rng([seed, 1])
    vertices, faces = _grid(
        np.array([-_TERRAIN_SIDE / 2, -_TERRAIN_SIDE / 2, 0.0]),
        np.array([_TERRAIN_SIDE, 0.0, 0.0]),
        np.array([0.0, _TERRAIN_SIDE, 0.0]),
        _TERRAIN_STEP,
    )
    lengths, headings, phases = np.geomspace(8, 80, 24), rng.uniform(0, 2 * np.pi, 24), rng.uniform(0, 2 * np.pi, 24)
    waves = 2 * np.pi / lengths * np.stack([np.cos(headings), np.sin(headings)])
    vertices[:, 2] = np.sin(vertices[:, :2] @ waves + phases) @ (0.02 * lengths)
    return _joined([(vertices, faces)])


def room_surface(seed: int) -> Mesh:
    """Return the inside of a room of 4.2 m x 5.6 m x 2.6 m with a dozen boxes on its floor."""
    rng = np.random.default_rng([seed, 2])
    parts = _box(np.zeros(3), _ROOM, floor=True)
    for _ in range(12):
        size = rng.uniform(0.3, 1.2, 3) * [1, 1, 1.3]
        corner = np.append(rng.uniform(0, _ROOM[:2] - size[:2]), 0.0)
        parts += _box(corner, size)
    return _joined(parts)


def object_surface(seed: int) -> Mesh:
    """Return a bumpy ball of radius 0.5 m: a sphere with waves in ten directions."""
    rng = np.random.default_rng([seed, 3])
    vertices, faces = _ball(96)
    waves, phases = rng.normal(0, 2.5, (3, 10)), rng.uniform(0, 2 * np.pi, 10)
    radius = 0.5 * (1 + 0.05 * np.sin(vertices @ waves + phases).sum(axis=1))
    return _joined([(vertices * radius[:, None], faces)])


def plane_surface(_: int) -> Mesh:
    """Return a plane of 40 m: three motions are free."""
    return _joined([_grid(np.zeros(3), np.array([40.0, 0, 0]), np.array([0, 40.0, 0]), np.inf)])


def cylinder_surface(_: int) -> Mesh:
    """Return a cylinder of 40 m with a radius of 5 m: it slides and turns along its axis."""
    vertices, faces = _grid(np.zeros(3), np.array([40.0, 0, 0]), np.array([0, 2 * np.pi, 0]), np.pi / 48)
    x, angle, _z = vertices.T
    return _joined([(np.column_stack([x, 5 * np.cos(angle), 5 * np.sin(angle)]), faces)])


def sphere_surface(_: int) -> Mesh:
    """Return a sphere with a radius of 10 m: every rotation is free."""
    vertices, faces = _ball(96)
    return _joined([(10 * vertices, faces)])


def corridor_surface(_: int) -> Mesh:
    """Return a corridor of 40 m x 3 m x 3 m without ends: it slides along its axis."""
    along, wide, high = np.diag([40.0, 3.0, 3.0])
    sides = [(np.zeros(3), wide), (high, wide), (np.zeros(3), high), (wide, high)]
    return _joined([_grid(corner, along, across, np.inf) for corner, across in sides])


def facade_surface(_: int) -> Mesh:
    """Return a facade of 60 m x 12 m with ground before it: twelve equal bays, and a porch at one of them."""
    parts = [_grid(np.array([0.0, -10.0, 0.0]), np.array([60.0, 0, 0]), np.array([0, 10.0, 0]), np.inf)]
    for bay in range(12):
        x = 5.0 * bay
        parts.append(_grid(np.array([x, 0, 0]), np.array([5.0, 0, 0]), np.array([0, 0, 12.0]), np.inf))
        parts += _box(np.array([x + 1.5, -0.4, 5.0]), np.array([2.0, 0.4, 2.5]), floor=True)
    parts += _box(np.array([21.5, -1.5, 0.0]), np.array([2.0, 1.5, 3.0]))
    return _joined(parts)


def half_turn_surface(_: int) -> Mesh:
    """Return a building on level ground that half a turn maps to itself, but for its chimney."""
    ground = _grid(np.array([-20.0, -15.0, 0.0]), np.array([40.0, 0, 0]), np.array([0, 30.0, 0]), np.inf)
    parts = [ground, *_box(np.array([-10.0, -6.0, 0.0]), np.array([20.0, 12.0, 8.0]))]
    parts += _box(np.array([-14.0, -3.0, 0.0]), np.array([4.0, 4.0, 5.0]))
    parts += _box(np.array([10.0, -1.0, 0.0]), np.array([4.0, 4.0, 5.0]))
    parts += _box(np.array([5.0, 3.0, 8.0]), np.array([1.0, 1.0, 1.5]))
    return _joined(parts)


SURFACES: dict[str, Callable[[int], Mesh]] = {
    "city": city_surface,
    "terrain": terrain_surface,
    "room": room_surface,
    "object": object_surface,
}
# Surfaces whose geometry leaves motions free, or nearly has a symmetry.
DEGENERATE: dict[str, Callable[[int], Mesh]] = {
    "plane": plane_surface,
    "cylinder": cylinder_surface,
    "sphere": sphere_surface,
    "corridor": corridor_surface,
    "repeated facade": facade_surface,
    "half-turn building": half_turn_surface,
}
FREE = frozenset(("plane", "cylinder", "sphere", "corridor"))  # the geometry does not determine the pose


def _grid(corner: FloatArray, u: FloatArray, v: FloatArray, step: float) -> tuple[FloatArray, IntArray]:
    """Return a parallelogram as triangles whose sides along u and v are at most `step`."""
    m, n = (max(1, int(np.ceil(np.linalg.norm(side) / step))) for side in (u, v))
    s, t = (x.ravel() for x in np.meshgrid(np.linspace(0, 1, m + 1), np.linspace(0, 1, n + 1), indexing="ij"))
    i = np.arange((m + 1) * (n + 1)).reshape(m + 1, n + 1)
    a, b, c, d = (part.ravel() for part in (i[:-1, :-1], i[1:, :-1], i[1:, 1:], i[:-1, 1:]))
    return corner + s[:, None] * u + t[:, None] * v, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])


def _box(corner: FloatArray, size: FloatArray, *, floor: bool = False) -> list[tuple[FloatArray, IntArray]]:
    """Return the sides and the top of a box, and its floor if asked for."""
    x, y, z = np.diag(size)
    sides = [(corner, x, z), (corner + y, x, z), (corner, y, z), (corner + x, y, z), (corner + z, x, y)]
    if floor:
        sides.append((corner, x, y))
    return [_grid(*side, np.inf) for side in sides]


def _ball(rows: int) -> tuple[FloatArray, IntArray]:
    """Return a unit sphere as triangles between meridians and parallels."""
    vertices, faces = _grid(np.zeros(3), np.array([np.pi, 0, 0]), np.array([0, 2 * np.pi, 0]), np.pi / rows)
    polar, azimuth, _ = vertices.T
    ball = np.stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], axis=1)
    return ball, faces


def _joined(parts: list[tuple[FloatArray, IntArray]]) -> Mesh:
    starts = np.cumsum([0, *(len(vertices) for vertices, _ in parts)])
    faces = [faces + start for (_, faces), start in zip(parts, starts[:-1], strict=True)]
    return Mesh(np.concatenate([vertices for vertices, _ in parts]), np.concatenate(faces), unit="m")
