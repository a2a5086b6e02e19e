"""Objects on the ground of a city: buildings, cars and trees."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from pcbench.scenes.synthetic.plan import Block, CitySettings, Solid, Street, Terrain, Tree


def fill_block(block: Block, settings: CitySettings, terrain: Terrain) -> tuple[list[Solid], list[Tree]]:
    """Create the solids and trees of a block, reproducibly from the seeds of city and block."""
    rng = np.random.default_rng([settings.seed, block.seed])
    makers = {"core": _core, "houses": _houses, "hall": _hall}  # parks and lakes have no buildings
    solids = list(makers[block.kind](block, settings, terrain, rng)) if block.kind in makers else []
    count = {"core": 5, "houses": 16, "hall": 4, "park": 34, "lake": 8}[block.kind]
    return solids, list(_trees(block, count, solids, terrain, rng))


class _BuildingPlacer(NamedTuple):
    """Places solids on the terrain."""

    settings: CitySettings
    terrain: Terrain
    rng: np.random.Generator

    def __call__(
        self, kind: str, x: float, y: float, width: float, depth: float, height: float, rise: float = 0, yaw: float = 0
    ) -> Solid:
        seed = 0 if self.settings.repeated else int(self.rng.integers(1 << 30))
        flat = Solid(kind, x, y, yaw, width, depth, 0.0, 0.0, rise, seed)
        s, t = np.meshgrid(np.linspace(-0.5, 0.5, 7) * width, np.linspace(-0.5, 0.5, 7) * depth)
        ground = self.terrain.at(*flat.world(np.stack([s.ravel(), t.ravel()], axis=1)).T)
        # The base is below the lowest ground under the building; heights count from the mean ground.
        return replace(flat, bottom=float(ground.min()) - 0.5, eaves=float(ground.mean()) + height)

    def on_roof(self, below: Solid, kind: str, x: float, y: float, width: float, depth: float, height: float) -> Solid:
        """Place a box at local x, y on a flat roof, sunk 20 cm into it, because coplanar faces would flicker."""
        position = below.world(np.array([[x, y]]))[0]
        seed = 0 if self.settings.repeated else int(self.rng.integers(1 << 30))
        bottom, eaves = below.eaves - 0.2, below.eaves + height
        return Solid(kind, float(position[0]), float(position[1]), below.yaw, width, depth, bottom, eaves, 0.0, seed)


def _core(block: Block, settings: CitySettings, terrain: Terrain, rng: np.random.Generator) -> Iterator[Solid]:
    """Yield the buildings of four or six lots, with flat roofs or steep gables; towers near the centre."""
    place_building = _BuildingPlacer(settings, terrain, rng)
    low, high = np.array(block.low) + 2.5, np.array(block.high) - 2.5
    cuts = [np.concatenate([[0], np.sort(rng.uniform(0.3, 0.7, 1)), [1]]) * (high - low)[a] + low[a] for a in (0, 1)]
    if rng.random() < 0.4:
        cuts[0] = np.linspace(low[0], high[0], 4)
    for xa, xb in pairwise(cuts[0]):
        for ya, yb in pairwise(cuts[1]):
            if rng.random() > settings.density:
                continue
            gap = rng.uniform(0.4, 2.5)
            width, depth = xb - xa - 2 * gap, yb - ya - 2 * gap
            if min(width, depth) < 5:
                continue  # a yard
            x, y = (xa + xb) / 2, (ya + yb) / 2
            near = np.exp(-((np.hypot(x, y) / (0.22 * settings.extent)) ** 2))
            height = settings.height * (1.3 * np.exp(rng.normal(0, 0.25)) + 2.6 * near * rng.uniform(0.2, 1) ** 1.5)
            if height < 2 * settings.height and width < 18 and rng.random() < 0.5:
                yield place_building("block", x, y, width, depth, height, 0.35 * width)
                continue
            if height > 2.2 * settings.height and min(width, depth) > 12:
                podium = place_building("block", x, y, width, depth, rng.uniform(0.5, 0.8) * settings.height)
                inset = rng.uniform(0.55, 0.75, 2)
                tower = place_building("tower", x, y, width * inset[0], depth * inset[1], height)
                tower = replace(tower, bottom=podium.eaves - 0.2)
                yield from (podium, tower, *_clutter(tower, place_building, rng))
                continue
            body = place_building("block", x, y, width, depth, height)
            yield from (body, *_clutter(body, place_building, rng))


def _clutter(body: Solid, place_building: _BuildingPlacer, rng: np.random.Generator) -> Iterator[Solid]:
    """Yield roof structures such as stair heads and machines, at most one in each quarter of a flat roof."""
    for sx, sy in ((-1, -1), (1, -1), (1, 1), (-1, 1)):
        width, depth = rng.uniform(1.5, 4.5, 2)
        if rng.random() < 0.5 and width < 0.3 * body.width and depth < 0.3 * body.depth:
            x, y = sx * body.width * rng.uniform(0.2, 0.28), sy * body.depth * rng.uniform(0.2, 0.28)
            yield place_building.on_roof(body, "clutter", x, y, width, depth, rng.uniform(0.8, 2.8))


def _houses(block: Block, settings: CitySettings, terrain: Terrain, rng: np.random.Generator) -> Iterator[Solid]:
    """Yield gabled houses with chimneys along the longer side, in two rows if there is space."""
    place_building = _BuildingPlacer(settings, terrain, rng)
    low, high = np.array(block.low) + 3, np.array(block.high) - 3
    along = int(high[1] - low[1] > high[0] - low[0])
    lots = max(1, int((high - low)[along] // 15))
    lot = (high - low)[along] / lots
    across = (high - low)[1 - along]
    for row in (0.24, 0.76) if across > 26 else (0.5,) if across > 9 else ():
        for k in range(lots):
            if rng.random() > settings.density:
                continue
            position = np.empty(2)
            position[along] = low[along] + (k + 0.5) * lot + rng.uniform(-1, 1)
            position[1 - along] = low[1 - along] + row * across + rng.uniform(-1.5, 1.5)
            width, depth = rng.uniform(7.5, 10), rng.uniform(9, 11.5)
            quarter = int(rng.random() < 0.5)
            yaw = float(rng.normal(0, 0.04) + quarter * np.pi / 2)
            height = 0.55 * settings.height * float(np.exp(rng.normal(0, 0.15)))
            house = place_building(
                "house",
                float(position[0]),
                float(position[1]),
                width,
                depth,
                height,
                float(rng.uniform(0.3, 0.5)) * width,
                yaw,
            )
            yield house
            if rng.random() < 0.7:
                seat = replace(house, eaves=house.eaves + 0.4 * house.rise)
                yield place_building.on_roof(seat, "chimney", 0.25 * width, 0.3 * depth, 0.8, 0.8, 0.75 * house.rise)


def _hall(block: Block, settings: CitySettings, terrain: Terrain, rng: np.random.Generator) -> Iterator[Solid]:
    """Yield one large flat building and the cars of its car park."""
    place_building = _BuildingPlacer(settings, terrain, rng)
    low, high = np.array(block.low) + 4, np.array(block.high) - 4
    size = (high - low) * [0.55, 0.9]
    if rng.random() < settings.density:
        body = place_building(
            "hall", low[0] + size[0] / 2, (low[1] + high[1]) / 2, size[0], size[1], 0.7 * settings.height
        )
        yield from (body, *_clutter(body, place_building, rng))
    for x in (low[0] + 0.68 * (high - low)[0], low[0] + 0.9 * (high - low)[0]):
        for y in np.arange(low[1] + 2, high[1] - 2, 2.7):
            if rng.random() < 0.6:
                yield _car(place_building, x, float(y), float(rng.normal(0, 0.03)))


def _car(place_building: _BuildingPlacer, x: float, y: float, yaw: float) -> Solid:
    car = place_building("car", x, y, 4.3, 1.8, float(place_building.rng.uniform(1.35, 1.6)), yaw=yaw)
    return replace(car, seed=int(place_building.rng.integers(1 << 30)))


def place_cars(
    lines: list[list[Street]], terrain: Terrain, settings: CitySettings, rng: np.random.Generator
) -> Iterator[Solid]:
    """Yield parked and driving cars on the right-hand side of each street."""
    place_building = _BuildingPlacer(settings, terrain, rng)
    for street in (s for line in lines for s in line):
        crossings = [(s.center, s.width / 2 + 6) for s in lines[1 - street.axis]]
        for station in np.arange(-settings.extent / 2 + 5, settings.extent / 2 - 5, 7.5):
            if any(abs(station - position) < reach for position, reach in crossings):
                continue
            for side in (-1, 1):
                if rng.random() < 0.22:
                    offset = street.center + side * street.width * rng.uniform(0.25, 0.34)
                    where = (offset, float(station)) if street.axis == 0 else (float(station), offset)
                    yield _car(place_building, *where, float(rng.normal(0, 0.02) + (street.axis == 0) * np.pi / 2))


def _trees(block: Block, count: int, solids: list[Solid], terrain: Terrain, rng: np.random.Generator) -> Iterator[Tree]:
    """Yield trees clear of buildings and of each other."""
    kept: list[Tree] = []
    area = (block.high[0] - block.low[0]) * (block.high[1] - block.low[1])
    for _ in range(round(count * area / 2000)):
        height = float(rng.uniform(4, 11))
        radius = height * float(rng.uniform(0.26, 0.38))
        x, y = (float(rng.uniform(block.low[a] + 1, block.high[a] - 1)) for a in (0, 1))
        if block.kind == "lake":  # on the shore
            x = block.low[0] + 1.5 if rng.random() < 0.5 else block.high[0] - 1.5
        position = np.array([[x, y]])
        clear = [np.abs(s.local(position))[0] - [s.width / 2, s.depth / 2] for s in solids]
        if any(gap.max() < 1.25 * radius for gap in clear):  # crowns bulge by up to a fifth of the radius
            continue
        if any(np.hypot(x - t.x, y - t.y) < radius + t.radius for t in kept):
            continue
        kept.append(_tree(x, y, height, radius, terrain, rng))
    yield from kept


def place_groves(settings: CitySettings, terrain: Terrain, rng: np.random.Generator) -> Iterator[Tree]:
    """Yield the trees of groves around the city."""
    half = settings.extent / 2
    spots: list[tuple[float, float, float]] = []
    for _ in range(26):
        centre = rng.uniform(-1.9, 1.9, 2) * half
        for _ in range(int(rng.integers(4, 26))):
            x, y = centre + rng.normal(0, 0.06, 2) * settings.extent
            height = float(rng.uniform(5, 13))
            radius = height * float(rng.uniform(0.28, 0.4))
            if max(abs(x), abs(y)) < half + radius or max(abs(x), abs(y)) > 2 * half - radius - 2:
                continue
            if any(np.hypot(x - a, y - b) < radius + r for a, b, r in spots):
                continue
            spots.append((x, y, radius))
            yield _tree(float(x), float(y), height, radius, terrain, rng)


def _tree(x: float, y: float, height: float, radius: float, terrain: Terrain, rng: np.random.Generator) -> Tree:
    base = float(terrain.at(np.array([x]), np.array([y]))[0])
    return Tree(x, y, base, height, radius, int(rng.integers(1 << 30)))
