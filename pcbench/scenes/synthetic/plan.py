"""The plan of a city: terrain, streets, blocks, and what stands on them, before it has faces or colours."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from pcbench.errors import InputError
from pcbench.geometry.arrays import FloatArray

CELLS = 80  # of the terrain's grid along the city; the countryside around it is half a city wide


@dataclass(frozen=True)
class CitySettings:
    """What kind of city.

    Args:
        extent: side of the built square in metres; the countryside reaches as far again.
        density: share of the lots that are built on, 0 to 1.
        height: median height of the houses in metres; the towers in the centre are up to five times as high.
        relief: RMS height of the terrain's waves under the city in metres.
        texture: 1 is rich, 0 leaves walls blank and the ground plain.
        water: some blocks are lakes.
        repeated: all buildings wear one facade and one roof.
        symmetric: half a turn brings the city onto itself, but for its shadows and the fields around it.
        seed: of everything.

    Raises:
        InputError: a value is out of its range.
    """

    extent: float = 400.0
    density: float = 0.85
    height: float = 9.0
    relief: float = 2.0
    texture: float = 1.0
    water: bool = False
    repeated: bool = False
    symmetric: bool = False
    seed: int = 0

    def __post_init__(self) -> None:
        if not (100 <= self.extent <= 2000):
            raise InputError(f"expected a city of 100 to 2000 metres, got {self.extent:g}")
        if not (0 <= self.density <= 1 and 0 <= self.texture <= 1):
            raise InputError(f"expected density and texture from 0 to 1, got {self.density:g} and {self.texture:g}")
        if not (3 <= self.height <= 50):
            raise InputError(f"expected a median height of 3 to 50 metres, got {self.height:g}")
        if not (0 <= self.relief <= 0.03 * self.extent):
            raise InputError(f"expected a relief of 0 to {0.03 * self.extent:g} metres (3 %), got {self.relief:g}")
        if self.seed < 0:
            raise InputError(f"expected a seed of at least 0, got {self.seed}")

    def hard(self) -> CitySettings:
        """The same city without what feature matching lives on: plain walls, lakes, repeated facades."""
        return replace(self, texture=0.1, water=True, repeated=True)


@dataclass(frozen=True)
class Solid:
    """A box that stands in the ground, with a flat or a gabled roof; the ridge runs along its depth."""

    kind: str  # "house", "block", "tower", "hall", "clutter", "chimney" or "car"
    x: float
    y: float
    yaw: float  # radians from +x towards +y
    width: float
    depth: float
    bottom: float
    eaves: float
    rise: float
    seed: int

    def local(self, points: FloatArray) -> FloatArray:
        """x and y (N, 2) of points (N, 2 or 3) along the width and the depth, from the centre."""
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        x, y = points[:, 0] - self.x, points[:, 1] - self.y
        return np.stack([c * x + s * y, c * y - s * x], axis=1)

    def world(self, local: FloatArray) -> FloatArray:
        """The inverse of `local`, (N, 2)."""
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        return np.stack(
            [self.x + c * local[:, 0] - s * local[:, 1], self.y + s * local[:, 0] + c * local[:, 1]], axis=1
        )

    def footprint(self) -> FloatArray:
        """Corners (4, 2), anticlockwise from above."""
        return self.world(np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * [self.width / 2, self.depth / 2])

    def contains(self, points: FloatArray, skin: float) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
        """Which of points (N, 3) are deeper inside than `skin`."""
        x, y = np.abs(self.local(points)).T
        roof = self.eaves + self.rise * (1 - x / (self.width / 2))
        inside: np.ndarray[tuple[int], np.dtype[np.bool_]] = (
            (x < self.width / 2 - skin) & (y < self.depth / 2 - skin) & (points[:, 2] < roof - 2 * skin)
        )
        return inside


class Tree(NamedTuple):
    x: float
    y: float
    base: float
    height: float
    radius: float
    seed: int


class Block(NamedTuple):
    """Ground between four streets."""

    kind: str  # "core", "houses", "hall", "park" or "lake"
    low: tuple[float, float]
    high: tuple[float, float]
    seed: int


class Street(NamedTuple):
    axis: int  # it runs at a constant x (0) or y (1)
    at: float
    width: float


@dataclass(frozen=True, eq=False)
class Terrain:
    """Heights on a regular grid of square cells about the origin, linear on the two triangles of each."""

    heights: FloatArray  # (n + 1, n + 1): [i, j] at x of j, y of i
    step: float

    @property
    def half(self) -> float:
        return self.step * (len(self.heights) - 1) / 2

    def at(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Height of the faces at any x, y of one shape."""
        n = len(self.heights) - 1
        u, v = (x + self.half) / self.step, (y + self.half) / self.step
        j, i = np.clip(np.floor(u).astype(int), 0, n - 1), np.clip(np.floor(v).astype(int), 0, n - 1)
        s, t = u - j, v - i
        h = self.heights
        h00, h01, h10, h11 = h[i, j], h[i, j + 1], h[i + 1, j], h[i + 1, j + 1]
        result: FloatArray = np.where(
            s >= t, h00 + s * (h01 - h00) + t * (h11 - h01), h00 + t * (h10 - h00) + s * (h11 - h10)
        )
        return result


@dataclass(frozen=True, eq=False)
class Plan:
    """A city, laid out."""

    settings: CitySettings
    terrain: Terrain
    streets: list[Street]
    blocks: list[Block]
    solids: list[Solid]
    trees: list[Tree]

    @property
    def top(self) -> float:
        """Height of the tallest roof."""
        return max([s.eaves + s.rise for s in self.solids], default=float(self.terrain.heights.max()))


def lay_out(settings: CitySettings) -> Plan:
    """A city of these settings; the same for the same settings."""
    rng = np.random.default_rng([settings.seed, 1])
    terrain = _terrain(settings, rng)
    lines = [_streets(settings, axis, rng) for axis in (0, 1)]
    blocks = _blocks(settings, lines, rng)
    _level(terrain, [block for block in blocks if block.kind == "lake"])
    solids: list[Solid] = []
    trees: list[Tree] = []
    for block in blocks:
        if settings.symmetric and _is_second(block):
            continue
        stands, grows = _fill(block, settings, terrain)
        solids += stands
        trees += grows
        if settings.symmetric:
            solids += [replace(s, x=-s.x, y=-s.y, yaw=s.yaw + np.pi) for s in stands]
            trees += [t._replace(x=-t.x, y=-t.y) for t in grows]
    if not settings.symmetric:
        solids += _cars(lines, terrain, settings, rng)
        trees += _countryside(settings, terrain, rng)
    return Plan(settings, terrain, [*lines[0], *lines[1]], blocks, solids, trees)


def _blocks(settings: CitySettings, lines: list[list[Street]], rng: np.random.Generator) -> list[Block]:
    blocks: list[Block] = []
    for west, east in pairwise(lines[0]):
        for south, north in pairwise(lines[1]):
            low = (west.at + west.width / 2, south.at + south.width / 2)
            high = (east.at - east.width / 2, north.at - north.width / 2)
            centre = (low[0] + high[0]) / 2, (low[1] + high[1]) / 2
            block = Block(_kind(centre, settings, rng), low, high, int(rng.integers(1 << 30)))
            if settings.symmetric and np.hypot(*centre) < 1e-6:
                continue  # a square: chance would not fill it the same after half a turn
            if not (settings.symmetric and _is_second(block)):
                blocks.append(block)
    if settings.symmetric:
        turned = [Block(b.kind, (-b.high[0], -b.high[1]), (-b.low[0], -b.low[1]), b.seed) for b in blocks]
        blocks += turned
    return blocks


def _is_second(block: Block) -> bool:
    """Whether half a turn about the origin brings the block to where another is made."""
    x, y = block.low[0] + block.high[0], block.low[1] + block.high[1]
    return y < -1e-6 or (abs(y) <= 1e-6 and x < -1e-6)


def _level(terrain: Terrain, lakes: list[Block]) -> None:
    """Water is level: the terrain's vertices in and next to a lake take its lowest height."""
    n = len(terrain.heights)
    at = (np.arange(n) - (n - 1) / 2) * terrain.step
    for lake in lakes:
        i, j = (np.flatnonzero((at > lake.low[a] - terrain.step) & (at < lake.high[a] + terrain.step)) for a in (1, 0))
        terrain.heights[np.ix_(i, j)] = terrain.heights[np.ix_(i, j)].min()


def _terrain(settings: CitySettings, rng: np.random.Generator) -> Terrain:
    """A sum of waves, in the countryside with hills on it."""
    n = 2 * CELLS
    step = settings.extent / CELLS
    at = (np.arange(n + 1) - n / 2) * step
    x, y = np.meshgrid(at, at)
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
    """Streets along one axis: every 45 to 65 m, every third an avenue; the first and last bound the city."""
    half = settings.extent / 2
    if settings.symmetric:
        places = [0.0] if rng.random() < 0.5 else [float(rng.uniform(22, 32))]
        while places[-1] + 65 < half:
            places.append(places[-1] + float(rng.uniform(45, 60)))
        places = [p for p in places if p < half - 30] or [0.0]
        places = sorted({-p for p in places} | set(places))
    else:
        places = [-half + float(rng.uniform(45, 60))]
        while places[-1] + 65 < half - 30:
            places.append(places[-1] + float(rng.uniform(45, 65)))
    inner = [Street(axis, p, 14.0 if (abs(i - len(places) // 2) % 3) == 0 else 9.0) for i, p in enumerate(places)]
    return [Street(axis, -half + 3.5, 7.0), *inner, Street(axis, half - 3.5, 7.0)]


def _kind(centre: tuple[float, float], settings: CitySettings, rng: np.random.Generator) -> str:
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


def _fill(block: Block, settings: CitySettings, terrain: Terrain) -> tuple[list[Solid], list[Tree]]:
    rng = np.random.default_rng([settings.seed, block.seed])
    makers = {"core": _core, "houses": _houses, "hall": _hall}  # nothing stands in parks and lakes
    solids = list(makers[block.kind](block, settings, terrain, rng)) if block.kind in makers else []
    count = {"core": 5, "houses": 16, "hall": 4, "park": 34, "lake": 8}[block.kind]
    return solids, list(_trees(block, count, solids, terrain, rng))


class _Stand(NamedTuple):
    """Places buildings on the terrain."""

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
        # Rooted below the lowest ground it stands on, and so high above the mean one.
        return replace(flat, bottom=float(ground.min()) - 0.5, eaves=float(ground.mean()) + height)

    def on_roof(self, below: Solid, kind: str, x: float, y: float, width: float, depth: float, height: float) -> Solid:
        """A box at local x, y on a flat roof, let into it a little: two faces in one plane would fight."""
        at = below.world(np.array([[x, y]]))[0]
        seed = 0 if self.settings.repeated else int(self.rng.integers(1 << 30))
        bottom, eaves = below.eaves - 0.2, below.eaves + height
        return Solid(kind, float(at[0]), float(at[1]), below.yaw, width, depth, bottom, eaves, 0.0, seed)


def _core(block: Block, settings: CitySettings, terrain: Terrain, rng: np.random.Generator) -> Iterator[Solid]:
    """Two to six lots with flat roofs or steep gables; towers near the centre."""
    stand = _Stand(settings, terrain, rng)
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
                yield stand("block", x, y, width, depth, height, 0.35 * width)
                continue
            if height > 2.2 * settings.height and min(width, depth) > 12:
                podium = stand("block", x, y, width, depth, rng.uniform(0.5, 0.8) * settings.height)
                inset = rng.uniform(0.55, 0.75, 2)
                tower = stand("tower", x, y, width * inset[0], depth * inset[1], height)
                tower = replace(tower, bottom=podium.eaves - 0.2)
                yield from (podium, tower, *_clutter(tower, stand, rng))
                continue
            body = stand("block", x, y, width, depth, height)
            yield from (body, *_clutter(body, stand, rng))


def _clutter(body: Solid, stand: _Stand, rng: np.random.Generator) -> Iterator[Solid]:
    """Stair houses and machines, one in each quarter of a flat roof at most."""
    for sx, sy in ((-1, -1), (1, -1), (1, 1), (-1, 1)):
        width, depth = rng.uniform(1.5, 4.5, 2)
        if rng.random() < 0.5 and width < 0.3 * body.width and depth < 0.3 * body.depth:
            x, y = sx * body.width * rng.uniform(0.2, 0.28), sy * body.depth * rng.uniform(0.2, 0.28)
            yield stand.on_roof(body, "clutter", x, y, width, depth, rng.uniform(0.8, 2.8))


def _houses(block: Block, settings: CitySettings, terrain: Terrain, rng: np.random.Generator) -> Iterator[Solid]:
    """Gabled houses with chimneys along the longer side, in two rows where there is room."""
    stand = _Stand(settings, terrain, rng)
    low, high = np.array(block.low) + 3, np.array(block.high) - 3
    along = int(high[1] - low[1] > high[0] - low[0])
    lots = max(1, int((high - low)[along] // 15))
    lot = (high - low)[along] / lots
    across = (high - low)[1 - along]
    for row in (0.24, 0.76) if across > 26 else (0.5,) if across > 9 else ():
        for k in range(lots):
            if rng.random() > settings.density:
                continue
            place = np.empty(2)
            place[along] = low[along] + (k + 0.5) * lot + rng.uniform(-1, 1)
            place[1 - along] = low[1 - along] + row * across + rng.uniform(-1.5, 1.5)
            width, depth = rng.uniform(7.5, 10), rng.uniform(9, 11.5)
            quarter = int(rng.random() < 0.5)
            yaw = float(rng.normal(0, 0.04) + quarter * np.pi / 2)
            height = 0.55 * settings.height * float(np.exp(rng.normal(0, 0.15)))
            house = stand(
                "house",
                float(place[0]),
                float(place[1]),
                width,
                depth,
                height,
                float(rng.uniform(0.3, 0.5)) * width,
                yaw,
            )
            yield house
            if rng.random() < 0.7:
                seat = replace(house, eaves=house.eaves + 0.4 * house.rise)
                yield stand.on_roof(seat, "chimney", 0.25 * width, 0.3 * depth, 0.8, 0.8, 0.75 * house.rise)


def _hall(block: Block, settings: CitySettings, terrain: Terrain, rng: np.random.Generator) -> Iterator[Solid]:
    """One large flat building and its car park."""
    stand = _Stand(settings, terrain, rng)
    low, high = np.array(block.low) + 4, np.array(block.high) - 4
    size = (high - low) * [0.55, 0.9]
    if rng.random() < settings.density:
        body = stand("hall", low[0] + size[0] / 2, (low[1] + high[1]) / 2, size[0], size[1], 0.7 * settings.height)
        yield from (body, *_clutter(body, stand, rng))
    for x in (low[0] + 0.68 * (high - low)[0], low[0] + 0.9 * (high - low)[0]):
        for y in np.arange(low[1] + 2, high[1] - 2, 2.7):
            if rng.random() < 0.6:
                yield _car(stand, x, float(y), float(rng.normal(0, 0.03)))


def _car(stand: _Stand, x: float, y: float, yaw: float) -> Solid:
    car = stand("car", x, y, 4.3, 1.8, float(stand.rng.uniform(1.35, 1.6)), yaw=yaw)
    return replace(car, seed=int(stand.rng.integers(1 << 30)))


def _cars(
    lines: list[list[Street]], terrain: Terrain, settings: CitySettings, rng: np.random.Generator
) -> Iterator[Solid]:
    """Parked and driving cars on the right-hand side of every street."""
    stand = _Stand(settings, terrain, rng)
    for street in (s for line in lines for s in line):
        crossings = [(s.at, s.width / 2 + 6) for s in lines[1 - street.axis]]
        for at in np.arange(-settings.extent / 2 + 5, settings.extent / 2 - 5, 7.5):
            if any(abs(at - place) < reach for place, reach in crossings):
                continue
            for side in (-1, 1):
                if rng.random() < 0.22:
                    offset = street.at + side * street.width * rng.uniform(0.25, 0.34)
                    where = (offset, float(at)) if street.axis == 0 else (float(at), offset)
                    yield _car(stand, *where, float(rng.normal(0, 0.02) + (street.axis == 0) * np.pi / 2))


def _trees(block: Block, count: int, solids: list[Solid], terrain: Terrain, rng: np.random.Generator) -> Iterator[Tree]:
    """Where there is room: clear of buildings and of each other."""
    kept: list[Tree] = []
    area = (block.high[0] - block.low[0]) * (block.high[1] - block.low[1])
    for _ in range(round(count * area / 2000)):
        height = float(rng.uniform(4, 11))
        radius = height * float(rng.uniform(0.26, 0.38))
        x, y = (float(rng.uniform(block.low[a] + 1, block.high[a] - 1)) for a in (0, 1))
        if block.kind == "lake":  # on the shore
            x = block.low[0] + 1.5 if rng.random() < 0.5 else block.high[0] - 1.5
        at = np.array([[x, y]])
        clear = [np.abs(s.local(at))[0] - [s.width / 2, s.depth / 2] for s in solids]
        if any(gap.max() < 1.25 * radius for gap in clear):  # crowns bulge by a fifth
            continue
        if any(np.hypot(x - t.x, y - t.y) < radius + t.radius for t in kept):
            continue
        kept.append(_tree(x, y, height, radius, terrain, rng))
    yield from kept


def _countryside(settings: CitySettings, terrain: Terrain, rng: np.random.Generator) -> Iterator[Tree]:
    """Groves around the city."""
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
