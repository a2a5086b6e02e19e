"""Plan of a city: terrain, streets, blocks and objects, before faces and colours are added.

`layout` creates it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from pcbench.errors import InputError
from pcbench.geometry.arrays import FloatArray

TERRAIN_CELLS = 80  # terrain cells along the city; the countryside adds half as many on each side


@dataclass(frozen=True)
class CitySettings:
    """Settings of a synthetic city.

    Args:
        extent: side of the built square in metres; the entire terrain is twice as wide.
        density: share of the lots that are built on, 0 to 1.
        height: median height of the houses in metres; towers in the centre are up to five times as high.
        relief: RMS height of the terrain's waves under the city in metres.
        texture: texture contrast: 1 is rich, 0 leaves walls blank and the ground plain.
        water: whether some blocks are lakes.
        repeated: whether all buildings have the same facade and roof.
        symmetric: whether a half turn maps the city to itself, except for its shadows and the fields around it.
        seed: random seed.

    Raises:
        InputError: a value is out of range.
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
        """Return the same city made hard for feature matching: faint textures, lakes, and one facade for all."""
        return replace(self, texture=0.1, water=True, repeated=True)


@dataclass(frozen=True)
class Solid:
    """Box on the ground, with a flat or a gabled roof; the ridge runs along its depth. Lengths are in metres."""

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
        """Return x and y (N, 2) of points (N, 2 or 3) along the width and the depth, relative to the centre."""
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        x, y = points[:, 0] - self.x, points[:, 1] - self.y
        return np.stack([c * x + s * y, c * y - s * x], axis=1)

    def world(self, local: FloatArray) -> FloatArray:
        """Return world coordinates (N, 2) of local ones; the inverse of `local`."""
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        return np.stack(
            [self.x + c * local[:, 0] - s * local[:, 1], self.y + s * local[:, 0] + c * local[:, 1]], axis=1
        )

    def footprint(self) -> FloatArray:
        """Return the corners (4, 2), anticlockwise from above."""
        return self.world(np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * [self.width / 2, self.depth / 2])

    def contains(self, points: FloatArray, skin: float) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
        """Return which points (N, 3) are inside by more than `skin` metres."""
        x, y = np.abs(self.local(points)).T
        roof = self.eaves + self.rise * (1 - x / (self.width / 2))
        inside: np.ndarray[tuple[int], np.dtype[np.bool_]] = (
            (x < self.width / 2 - skin) & (y < self.depth / 2 - skin) & (points[:, 2] < roof - 2 * skin)
        )
        return inside


class Tree(NamedTuple):
    """Tree on the terrain; lengths in metres."""

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
    """Street parallel to the y axis (0) or the x axis (1)."""

    axis: int  # the street has a constant x (0) or y (1)
    center: float  # that coordinate of its centre line
    width: float


@dataclass(frozen=True, eq=False)
class Terrain:
    """Heights on a regular grid of square cells about the origin, linear on the two triangles of each cell."""

    heights: FloatArray  # (n + 1, n + 1) in metres; row i has constant y, column j constant x
    step: float

    @property
    def half(self) -> float:
        """Half the side of the terrain in metres."""
        return self.step * (len(self.heights) - 1) / 2

    def at(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return the heights at x and y, two arrays of the same shape."""
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
class CityPlan:
    """Layout of a city."""

    settings: CitySettings
    terrain: Terrain
    streets: list[Street]
    blocks: list[Block]
    solids: list[Solid]
    trees: list[Tree]

    @property
    def top(self) -> float:
        """Height of the tallest roof in metres."""
        return max([s.eaves + s.rise for s in self.solids], default=float(self.terrain.heights.max()))
