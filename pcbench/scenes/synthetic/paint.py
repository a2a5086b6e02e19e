"""Procedural textures: albedo of the ground, walls, roofs, cars and leaves of a city.

All patterns are defined in metres at texel centres, and their noise has detail at all scales, so that features are
found at any distance. They are painted at full contrast and then faded towards one plain colour per surface, depending
on `CitySettings.texture`. Less texture also makes optional elements (windows, hatches, solar panels) rarer.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray
from pcbench.scenes.synthetic.noise import FractalNoise, Grid, Plane
from pcbench.scenes.synthetic.plan import Block, CityPlan, CitySettings

Image = NDArray[np.float32]  # (rows, columns, 3), 0 to 1; row 0 is at v = 0

_FACADES = [
    (0.80, 0.74, 0.64),
    (0.70, 0.46, 0.36),
    (0.86, 0.83, 0.78),
    (0.62, 0.60, 0.58),
    (0.78, 0.62, 0.44),
    (0.55, 0.36, 0.30),
    (0.72, 0.74, 0.70),
    (0.88, 0.78, 0.58),
]
_TILES = [(0.58, 0.32, 0.25), (0.50, 0.28, 0.23), (0.40, 0.36, 0.35), (0.62, 0.40, 0.29), (0.33, 0.31, 0.33)]
_FLAT_ROOFS = [(0.62, 0.61, 0.58), (0.48, 0.47, 0.46), (0.74, 0.72, 0.68), (0.40, 0.42, 0.44), (0.58, 0.52, 0.45)]
_CARS = [
    (0.85, 0.85, 0.86),
    (0.15, 0.16, 0.18),
    (0.55, 0.57, 0.60),
    (0.62, 0.12, 0.10),
    (0.12, 0.22, 0.45),
    (0.8, 0.7, 0.3),
]
_GRASS = (0.38, 0.46, 0.27)
_ASPHALT = (0.37, 0.37, 0.38)
_PAVING = (0.60, 0.58, 0.55)
_WATER = (0.20, 0.33, 0.38)
_PLAIN_GROUND = (0.44, 0.43, 0.40)  # ground without texture
_GLASS_REFLECTANCE = 0.08  # ((1.5 - 1) / (1.5 + 1))^2 at both sides of a pane: Fresnel at normal incidence
_WATER_REFLECTANCE = 0.02  # ((1.33 - 1) / (1.33 + 1))^2
_FINEST_CELL = 0.075  # m, of the noise in a city of up to 400 m
_BURIED_WALL_HEIGHT = 1.2  # m of a wall assumed to be in the ground


class Paint(NamedTuple):
    """Appearance of a surface: its colour, and its reflectance at normal incidence per texel."""

    color: Image
    mirror: Plane | None = None  # (rows, columns), 0 without reflection


class Painter:
    """Paints the surfaces of a city."""

    def __init__(self, settings: CitySettings) -> None:
        self.settings = settings
        self.noise = FractalNoise(settings.seed, _FINEST_CELL * max(1.0, settings.extent / 400))

    def paint_face(self, kind: str, side: str, seed: int, grid: Grid) -> Paint:
        """Paint a wall, roof or gable of a solid."""
        rng = np.random.default_rng([self.settings.seed, seed, 3])  # the same for the entire building
        side_rng = np.random.default_rng([self.settings.seed, seed, *side.encode()])  # different for each side
        if kind == "car":
            return self._car(side, grid, rng)
        if kind in ("clutter", "chimney"):
            base = (0.62, 0.62, 0.63) if kind == "clutter" else (0.55, 0.33, 0.27)
            return self._fade(self._add_noise(base, grid, side_rng, 0.10), base)
        if side.startswith("wall"):
            return self._wall(kind, grid, rng, side_rng)
        if side.startswith("slope"):
            return self._tiles(grid, rng, side_rng)
        return self._flat_roof(grid, rng, side_rng)

    def _fade(self, image: Image, plain: tuple[float, ...] | Image, mirror: Plane | None = None) -> Paint:
        """Reduce the image's contrast towards a plain colour, depending on `texture`."""
        tone = np.asarray(plain, dtype=np.float32)
        return Paint(tone + np.float32(self.settings.texture) * (image - tone), mirror)

    def _add_noise(
        self, color: tuple[float, float, float], grid: Grid, rng: np.random.Generator, contrast: float
    ) -> Image:
        return _tint(color, 1 + np.float32(contrast) * self.noise(grid, rng))

    def _wall(self, kind: str, grid: Grid, rng: np.random.Generator, side_rng: np.random.Generator) -> Paint:
        """Paint storeys of framed windows, each pane with a random tone; some blocks have shops."""
        base = _FACADES[rng.integers(len(_FACADES))]
        storey, bay = rng.uniform(2.9, 3.4), rng.uniform(2.2, 4.0)
        glass = kind == "tower" and rng.random() < 0.6
        width, height = (0.86, 0.80) if glass else (rng.uniform(0.38, 0.6), rng.uniform(0.45, 0.62))  # in bays, storeys
        image = self._add_noise(base, grid, side_rng, 0.10)
        if rng.random() >= self.settings.texture or (kind == "hall" and rng.random() < 0.5):
            return self._fade(image, base)  # a blank wall
        above = grid.v - _BURIED_WALL_HEIGHT
        bays = max(1, round(grid.width / bay))
        storeys = max(1, int((grid.height - _BURIED_WALL_HEIGHT) // storey) + 1)
        column, row = np.floor(grid.u / grid.width * bays).astype(int), np.floor(above / storey).astype(int)
        s, t = grid.u / grid.width * bays - column, above / storey - row
        # No windows in an incomplete storey under the eaves.
        is_complete = (row >= 0) & ((row + 1) * storey < grid.height - _BURIED_WALL_HEIGHT + 0.3)

        def opening(scale: float) -> NDArray[np.bool_]:
            across, up = np.abs(s - 0.5) < scale * width / 2, np.abs(t - 0.55) < scale * height / 2
            mask: NDArray[np.bool_] = (up & is_complete)[:, None] & across[None, :]
            return mask

        image[opening(1.18)] = (0.55, 0.54, 0.52) if glass else (0.92, 0.90, 0.87)
        panes = side_rng.uniform(0.25, 1.0, (storeys, bays + 2)) ** 1.6
        if self.settings.repeated:
            panes[:] = 0.5
        tones = 0.16 + 0.42 * panes[np.ix_(np.clip(row, 0, storeys - 1), np.clip(column, -1, bays) + 1)]
        mask = opening(1.0)
        image[mask] = tones[mask][:, None] * np.array([0.80, 0.95, 1.1])
        if kind == "block" and rng.random() < 0.7:
            image[(above > 0) & (above < 2.6)] *= np.array(
                side_rng.uniform(0.6, 1.0) * side_rng.uniform(0.85, 1.1, 3), dtype=np.float32
            )
        return self._fade(image, base, _reflectance_map(mask, _GLASS_REFLECTANCE))

    def _tiles(self, grid: Grid, rng: np.random.Generator, side_rng: np.random.Generator) -> Paint:
        rng.random(8)  # decouple the roof's random numbers from the walls'
        base = _TILES[rng.integers(len(_TILES))]
        r = self.settings.texture
        rows = 1 + 0.10 * np.sin(2 * np.pi * grid.v / 0.9)
        counts = int(grid.height // 0.9) + 1, int(grid.width // 0.7) + 1
        up, across = (
            np.clip(np.floor(x / size).astype(int), 0, count - 1)
            for x, size, count in zip((grid.v, grid.u), (0.9, 0.7), counts, strict=True)
        )
        blotch = side_rng.normal(0, 0.07, counts)[np.ix_(up, across)]
        image = _tint(base, rows[:, None] + blotch + 0.15 * self.noise(grid, side_rng))
        glass = np.zeros(grid.shape, dtype=bool)
        if side_rng.random() < 0.35 * r:  # solar panels
            low, high = np.array([0.15, 0.25]), np.array([side_rng.uniform(0.5, 0.85), 0.8])
            s, t = grid.u / grid.width, grid.v / grid.height
            on = ((t > low[1]) & (t < high[1]))[:, None] & ((s > low[0]) & (s < high[0]))
            frame = (np.mod(grid.v, 1.6) < 0.12)[:, None] | (np.mod(grid.u, 1.0) < 0.12)
            image[on] = (0.10, 0.13, 0.24)
            image[on & frame] = (0.45, 0.47, 0.52)
            glass = on & ~frame
        elif side_rng.random() < 0.6 * r:  # skylights
            for _ in range(int(side_rng.integers(1, 4))):
                left, lower = (
                    side_rng.uniform(1, max(1.1, grid.width - 2)),
                    side_rng.uniform(1, max(1.1, grid.height - 2)),
                )
                where = _rectangle(grid, left, lower, 0.9, 1.2)
                image[where], glass[where] = (0.30, 0.36, 0.42), True
        return self._fade(image, base, _reflectance_map(glass, _GLASS_REFLECTANCE))

    def _flat_roof(self, grid: Grid, rng: np.random.Generator, side_rng: np.random.Generator) -> Paint:
        rng.random(8)  # decouple the roof's random numbers from the walls'
        r = self.settings.texture
        base = _FLAT_ROOFS[rng.integers(len(_FLAT_ROOFS))]
        image = self._add_noise(base, grid, side_rng, 0.17)
        sheet = rng.uniform(2.5, 5)
        image *= np.float32(1) - np.float32(0.10) * (np.mod(grid.u, sheet) < 0.25)[None, :, None].astype(np.float32)
        for _ in range(round(r * grid.width * grid.height / 45)):  # hatches, vents, patches
            w, h = side_rng.uniform(0.5, 2.4, 2)
            s, t = side_rng.uniform(1, max(1.1, grid.width - 3)), side_rng.uniform(1, max(1.1, grid.height - 3))
            image[_rectangle(grid, s, t, w, h)] = side_rng.uniform(0.25, 0.85) * np.array([1, 1, 1.02])
        rim = np.minimum(grid.u, grid.width - grid.u)[None, :], np.minimum(grid.v, grid.height - grid.v)[:, None]
        image[np.minimum(*rim) < 0.5] = (0.80, 0.79, 0.76)
        return self._fade(image, base)

    def _car(self, side: str, grid: Grid, rng: np.random.Generator) -> Paint:
        image: Image = np.empty((*grid.shape, 3), dtype=np.float32)
        base = _CARS[rng.integers(len(_CARS))]
        image[:] = base
        if side == "roof":  # bonnet, windscreen, roof, rear window
            s = grid.u / grid.width
            image[:, ((s > 0.24) & (s < 0.36)) | ((s > 0.78) & (s < 0.88))] = (0.10, 0.12, 0.15)
        else:
            image[grid.v < 0.75] = (0.08, 0.08, 0.09)
            image[grid.v > 1.5] = (0.15, 0.17, 0.20)
        return self._fade(image, base)

    def paint_leaves(self, side: int) -> Paint:
        """Paint foliage (side, side, 3); trees use parts of it."""
        rng = np.random.default_rng([self.settings.seed, 4])
        texels = 2 * _FINEST_CELL * np.arange(side, dtype=np.float64)  # noise as fine as the texels
        noise = 0.30 * self.noise(Grid(texels, texels, texels[-1], texels[-1]), rng)
        green = (0.27, 0.40, 0.16)
        return self._fade(_tint(green, 1 + noise + rng.normal(0, 0.15, (side, side)).astype(np.float32)), green)

    def paint_town(self, plan: CityPlan, grid: Grid) -> Paint:
        """Paint a part of the city's ground; the grid starts at the city's south-western corner."""
        if not self.settings.symmetric:
            return self._paint_town(plan, grid)
        # The northern half is the southern half after a half turn.
        here, rotated = (self._paint_town(plan, g) for g in (grid, _rotate_grid(grid)))
        north = (grid.v > grid.height / 2)[:, None]
        color = np.where(north[..., None], rotated.color[::-1, ::-1], here.color)
        if here.mirror is None and rotated.mirror is None:
            return Paint(color)
        nothing = np.zeros(grid.shape, dtype=np.float32)
        planes = [nothing if paint.mirror is None else paint.mirror for paint in (here, rotated)]
        return Paint(color, np.where(north, planes[1][::-1, ::-1], planes[0]))

    def _paint_town(self, plan: CityPlan, grid: Grid) -> Paint:
        half = self.settings.extent / 2
        rng = np.random.default_rng([self.settings.seed, 5])
        x, y = grid.u - half, grid.v - half
        image = self._add_noise(_ASPHALT, grid, rng, 0.10)
        plain: Image = np.empty_like(image)
        plain[:] = _PLAIN_GROUND
        mirror: Plane | None = None
        for street in plan.streets:
            self._markings(image, plan, street.axis, street.center, street.width, x, y)
        for block in plan.blocks:
            i = slice(*np.searchsorted(y, [block.low[1], block.high[1]]))
            j = slice(*np.searchsorted(x, [block.low[0], block.high[0]]))
            if i.start == i.stop or j.start == j.stop:
                continue
            size = block.high[0] - block.low[0], block.high[1] - block.low[1]
            part = Grid(x[j] - block.low[0], y[i] - block.low[1], *size)
            image[i, j], inside = self._block(block, part)
            if block.kind == "lake":  # water keeps its colour without texture
                plain[i, j][inside] = _WATER
                mirror = np.zeros(grid.shape, dtype=np.float32) if mirror is None else mirror
                mirror[i, j][inside] = _WATER_REFLECTANCE
        image *= (np.float32(1) + np.float32(0.05) * self.noise(grid, rng))[..., None]
        return self._fade(image, plain, mirror)

    def _markings(
        self, image: Image, plan: CityPlan, axis: int, center: float, width: float, x: FloatArray, y: FloatArray
    ) -> None:
        """Paint a dashed centre line, lines at the kerbs, and zebra crossings at junctions."""
        across, along = (x, y) if axis == 0 else (y, x)
        view = image if axis == 0 else image.transpose(1, 0, 2)
        near = np.abs(across - center)
        crossing = np.zeros(len(along), dtype=bool)
        zebra = np.zeros(len(along), dtype=bool)
        for other in plan.streets:
            if other.axis != axis:
                gap = np.abs(along - other.center) - other.width / 2
                crossing |= gap < 5
                zebra |= (gap > 0.8) & (gap < 3.8)
        white = np.array([0.84, 0.84, 0.80], dtype=np.float32)
        dashes = (np.mod(along, 6.0) < 3.0) & ~crossing
        view[np.ix_(dashes, near < 0.14)] = white
        view[np.ix_(~crossing, np.abs(near - (width / 2 - 0.4)) < 0.12)] = white * 0.85
        bars = (np.mod(across - center, 1.1) < 0.55) & (near < width / 2 - 0.3)
        view[np.ix_(zebra, bars)] = white

    def _block(self, block: Block, grid: Grid) -> tuple[Image, NDArray[np.bool_]]:
        """Paint the ground between four streets; return it with a mask of the area inside the pavement."""
        rng = np.random.default_rng([self.settings.seed, block.seed, 6])
        u, v = grid.u[None, :], grid.v[:, None]
        rim = np.minimum(np.minimum(u, grid.width - u), np.minimum(v, grid.height - v))
        noise = self.noise(grid, rng)
        paving = _tint(_PAVING, 1 + 0.09 * noise)
        seams = (np.mod(u, 2.0) < 0.2) | (np.mod(v, 2.0) < 0.2)
        paving[seams & np.ones_like(noise, dtype=bool)] *= np.float32(0.88)
        if block.kind == "core":
            inner = _tint(tuple(rng.uniform(0.42, 0.62) * np.array([1.0, 0.97, 0.92])), 1 + 0.13 * noise)
        elif block.kind == "hall":
            inner = _tint(_ASPHALT, 1 + 0.12 * noise)
            lines = (np.mod(v, 2.7) < 0.15) & (u > 0.58 * grid.width)
            inner[lines & np.ones_like(noise, dtype=bool)] = 0.8
        elif block.kind == "lake":
            inner = _tint(_WATER, 1 + 0.015 * noise)
        else:
            other = self.noise(grid, rng)[..., None]
            inner = _tint(_GRASS, 1 + 0.22 * noise)
            inner += np.float32(0.05) * other * np.array([1.2, 0.5, -0.2], dtype=np.float32)
            if block.kind == "park":
                angle, wave_number = rng.uniform(0, np.pi), rng.uniform(0.08, 0.2)
                for turn in (0, rng.uniform(0.8, 2.2)):
                    c, s = np.cos(angle + turn), np.sin(angle + turn)
                    a, b = u - grid.width / 2, v - grid.height / 2
                    path = np.abs(s * a - c * b + 5 * np.sin(wave_number * (c * a + s * b)))
                    inner[path < 1.6] = paving[path < 1.6] * np.array([1.05, 0.98, 0.85], dtype=np.float32)
            else:
                long = int(grid.height > grid.width)
                lots = max(1, int((max(grid.width, grid.height) - 6) // 15))
                side = np.mod((v if long else u) - 3, (max(grid.width, grid.height) - 6) / lots)
                hedge = (side < 0.7) & (rim > 3)
                inner[hedge & np.ones_like(noise, dtype=bool)] *= np.float32(0.55)
                drive = (side > 1.2) & (side < 3.8)
                far = np.abs((u - grid.width / 2) if long else (v - grid.height / 2))
                drive = drive & (far > 0.22 * min(grid.width, grid.height))
                inner[drive & np.ones_like(noise, dtype=bool)] = _PAVING
        walk = rim < 2.2
        inner[walk] = paving[walk]
        inner[rim < 0.25] = 0.72
        return inner, ~walk

    def paint_countryside(self, grid: Grid) -> Paint:
        """Paint a part of the fields around the city: patches around random seeds, each with its furrow direction.

        The grid starts at the south-western corner of the entire terrain.
        """
        rng = np.random.default_rng([self.settings.seed, 8])
        count = 110
        seeds = rng.uniform(0, 1, (count, 2)) * [grid.width, grid.height]
        colors = np.array(
            [(0.42, 0.47, 0.22), (0.60, 0.55, 0.30), (0.36, 0.44, 0.20), (0.48, 0.40, 0.28), (0.52, 0.56, 0.28)]
        )
        color = (colors[rng.integers(0, len(colors), count)] * rng.uniform(0.85, 1.1, (count, 1))).astype(np.float32)
        angle, pitch = rng.uniform(0, np.pi, count), rng.uniform(3, 7, count)
        u, v = grid.u[None, :].astype(np.float32), grid.v[:, None].astype(np.float32)
        first = np.full(grid.shape, np.inf, dtype=np.float32)
        second, which = first.copy(), np.zeros(grid.shape, dtype=np.int16)
        for k in _nearby_seeds(seeds, grid):
            d = np.hypot(u - np.float32(seeds[k, 0]), v - np.float32(seeds[k, 1]))
            closer = d < first
            second = np.where(closer, first, np.minimum(second, d))
            which[closer] = k
            np.minimum(first, d, out=first)
        furrow = np.sin(2 * np.pi * (np.cos(angle)[which] * u + np.sin(angle)[which] * v) / pitch[which])
        noise = self.noise(grid, rng, 4.0)
        image = color[which] * (1 + 0.06 * furrow + 0.16 * noise).astype(np.float32)[..., None]
        image[second - first < 2.0] = (0.30, 0.36, 0.18)  # hedges
        lane = (second - first > 5.0) & (second - first < 7.5) & (which % 3 == 0)
        image[lane] = (0.62, 0.57, 0.48)
        return self._fade(image, _PLAIN_GROUND)


def _nearby_seeds(seeds: FloatArray, grid: Grid) -> NDArray[np.int64]:
    """Return the seeds (S, 2) that can be nearest or second nearest to a position of the grid."""
    low, high = (np.array([side(grid.u), side(grid.v)]) for side in (np.min, np.max))
    distances = np.linalg.norm(seeds - (low + high) / 2, axis=1)
    return np.flatnonzero(distances <= np.sort(distances)[1] + np.linalg.norm(high - low))


def _rotate_grid(grid: Grid) -> Grid:
    """Return the grid after a half turn about its centre."""
    return grid._replace(u=(grid.width - grid.u)[::-1], v=(grid.height - grid.v)[::-1])


def _reflectance_map(where: NDArray[np.bool_], share: float) -> Plane | None:
    return np.where(where, np.float32(share), np.float32(0)) if where.any() else None


def _tint(color: tuple[float, ...], tone: NDArray[np.floating]) -> Image:
    image: Image = np.asarray(tone, dtype=np.float32)[..., None] * np.array(color, dtype=np.float32)
    return image


def _rectangle(grid: Grid, u: float, v: float, width: float, height: float) -> tuple[slice, slice]:
    """Return the rows and columns of the texels in a rectangle at u, v."""
    return slice(*np.searchsorted(grid.v, [v, v + height])), slice(*np.searchsorted(grid.u, [u, u + width]))
