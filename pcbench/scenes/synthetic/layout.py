"""City layout: terrain, streets, the blocks between them, and the objects in each block."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np

from pcbench.scenes.synthetic.buildings import fill_block, place_cars, place_groves
from pcbench.scenes.synthetic.plan import TERRAIN_CELLS, Block, CityPlan, CitySettings, Solid, Street, Terrain, Tree


def lay_out(settings: CitySettings) -> CityPlan:
    """Lay out a city; the same settings give the same city."""
    rng = np.random.default_rng([settings.seed, 1])
    terrain = _terrain(settings, rng)
    lines = [_streets(settings, axis, rng) for axis in (0, 1)]
    blocks = _blocks(settings, lines, rng)
    _level_lakes(terrain, [block for block in blocks if block.kind == "lake"])
    solids: list[Solid] = []
    trees: list[Tree] = []
    for block in blocks:
        if settings.symmetric and _is_rotated_copy(block):
            continue
        block_solids, block_trees = fill_block(block, settings, terrain)
        solids += block_solids
        trees += block_trees
        if settings.symmetric:
            solids += [replace(s, x=-s.x, y=-s.y, yaw=s.yaw + np.pi) for s in block_solids]
            trees += [t._replace(x=-t.x, y=-t.y) for t in block_trees]
    if not settings.symmetric:
        solids += place_cars(lines, terrain, settings, rng)
        trees += place_groves(settings, terrain, rng)
    return CityPlan(settings, terrain, [*lines[0], *lines[1]], blocks, solids, trees)


def _blocks(settings: CitySettings, lines: list[list[Street]], rng: np.random.Generator) -> list[Block]:
    blocks: list[Block] = []
    for west, east in pairwise(lines[0]):
        for south, north in pairwise(lines[1]):
            low = (west.center + west.width / 2, south.center + south.width / 2)
            high = (east.center - east.width / 2, north.center - north.width / 2)
            centre = (low[0] + high[0]) / 2, (low[1] + high[1]) / 2
            block = Block(_choose_kind(centre, settings, rng), low, high, int(rng.integers(1 << 30)))
            if settings.symmetric and np.hypot(*centre) < 1e-6:
                continue  # central square: random objects would not be symmetric under a half turn
            if not (settings.symmetric and _is_rotated_copy(block)):
                blocks.append(block)
    if settings.symmetric:
        rotated = [Block(b.kind, (-b.high[0], -b.high[1]), (-b.low[0], -b.low[1]), b.seed) for b in blocks]
        blocks += rotated
    return blocks


def _is_rotated_copy(block: Block) -> bool:
    """Return whether a half turn about the origin maps another block to this one; the northern one is the original."""
    x, y = block.low[0] + block.high[0], block.low[1] + block.high[1]
    return y < -1e-6 or (abs(y) <= 1e-6 and x < -1e-6)


def _level_lakes(terrain: Terrain, lakes: list[Block]) -> None:
    """Flatten the terrain in and next to each lake to its lowest height there."""
    n = len(terrain.heights)
    coordinates = (np.arange(n) - (n - 1) / 2) * terrain.step
    for lake in lakes:
        i, j = (
            np.flatnonzero((coordinates > lake.low[a] - terrain.step) & (coordinates < lake.high[a] + terrain.step))
            for a in (1, 0)
        )
        terrain.heights[np.ix_(i, j)] = terrain.heights[np.ix_(i, j)].min()


def _terrain(settings: CitySettings, rng: np.random.Generator) -> Terrain:
    """Return terrain as a sum of waves, higher in the countryside."""
    n = 2 * TERRAIN_CELLS
    step = settings.extent / TERRAIN_CELLS
    coordinates = (np.arange(n + 1) - n / 2) * step
    x, y = np.meshgrid(coordinates, coordinates)
    waves = np.zeros_like(x)
    for length in (0.45, 0.6, 0.9):
        angle, phase = rng.uniform(0, 2 * np.pi, 2)
        k = 2 * np.pi / (length * settings.extent)
        # Cosines without a phase are the same at -x, -y.
        phase = 0.0 if settings.symmetric else phase
        waves += length * np.cos(k * (np.cos(angle) * x + np.sin(angle) * y) + phase)
    beyond = np.maximum(np.maximum(np.abs(x), np.abs(y)) / (settings.extent / 2) - 1, 0)
    inside = beyond == 0
    scale = settings.relief / np.sqrt(np.mean(np.square(waves[inside] - waves[inside].mean())))
    return Terrain(scale * (waves - waves[inside].mean()) * (1 + 4 * beyond), step)


def _streets(settings: CitySettings, axis: int, rng: np.random.Generator) -> list[Street]:
    """Return the streets along one axis: every 45 to 65 m, every third an avenue; the first and last bound the city."""
    half = settings.extent / 2
    if settings.symmetric:
        positions = [0.0] if rng.random() < 0.5 else [float(rng.uniform(22, 32))]
        while positions[-1] + 65 < half:
            positions.append(positions[-1] + float(rng.uniform(45, 60)))
        positions = [p for p in positions if p < half - 30] or [0.0]
        positions = sorted({-p for p in positions} | set(positions))
    else:
        positions = [-half + float(rng.uniform(45, 60))]
        while positions[-1] + 65 < half - 30:
            positions.append(positions[-1] + float(rng.uniform(45, 65)))
    inner = [Street(axis, p, 14.0 if (abs(i - len(positions) // 2) % 3) == 0 else 9.0) for i, p in enumerate(positions)]
    return [Street(axis, -half + 3.5, 7.0), *inner, Street(axis, half - 3.5, 7.0)]


def _choose_kind(centre: tuple[float, float], settings: CitySettings, rng: np.random.Generator) -> str:
    distance = np.hypot(*centre) / (settings.extent / 2)
    draw = rng.random()
    if settings.water and draw < 0.22 and distance > 0.2:
        return "lake"
    if rng.random() < 0.1 and distance > 0.15:
        return "park"
    core = 1 / (1 + np.exp((distance - 0.62) / 0.1))
    if draw < core:
        return "core"
    return "hall" if rng.random() < 0.15 else "houses"
