"""Charts, the parts of a city's surface with a texture of their own, and the light of sun and sky on them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.mesh import MeshIndex
from pcbench.scenes.synthetic.paint import Image
from pcbench.scenes.synthetic.plan import CityPlan

SUN = np.array([-0.52, -0.46, 0.72]) / np.linalg.norm([-0.52, -0.46, 0.72])  # towards it: an afternoon, south-west
MARGIN = 4  # texels around a chart, painted as it goes on: mipmaps take their colours from there
_SUN_COLOR = np.array([0.70, 0.65, 0.56], dtype=np.float32)
_SKY_COLOR = np.array([0.50, 0.53, 0.58], dtype=np.float32)
_LIFT = 0.02  # m, from a surface to where its rays of light start


@dataclass(frozen=True, eq=False)
class Chart:
    """A parallelogram of the surface with a texture of its own: corner + s * u + t * v, s and t from 0 to 1.

    The ground's charts lie at z = 0 and follow the terrain.
    """

    kind: str  # of the solid, or "town", "country" or "leaves"
    side: str
    seed: int
    corner: FloatArray
    u: FloatArray
    v: FloatArray
    texel: float  # metres
    nominal: float  # metres: what `texel` is where no camera is near; light is as coarse as that asks for

    @property
    def ring(self) -> int:
        """Cells of light beyond each edge: ground goes on there, and its light without a seam."""
        return int(self.kind in ("town", "country"))

    @property
    def size(self) -> tuple[float, float]:
        return float(np.linalg.norm(self.u)), float(np.linalg.norm(self.v))

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns without the margin."""
        width, height = self.size
        return max(2, round(height / self.texel)), max(2, round(width / self.texel))


class _Lattice(NamedTuple):
    """Points of a chart at which light is computed; it is linear between them."""

    columns: int  # the ring's too
    rows: int
    points: FloatArray  # (rows * columns, 3), lifted off the surface
    normal: FloatArray  # (3,) or (rows * columns, 3)


def lights(plan: CityPlan, charts: list[Chart], index: MeshIndex) -> list[Image | None]:
    """Light (rows, columns, 3) on a lattice over each chart: sun where it reaches, sky by the open share of it."""
    sun = [None if c.kind == "leaves" else _lattice(plan, c, 2 * c.nominal) for c in charts]
    sky = [None if c.kind == "leaves" else _lattice(plan, c, 8 * c.nominal) for c in charts]
    sunny = ~index.blocked(*_rays([s.points for s in sun if s], SUN))
    directions = _hemisphere(12)
    open_ = np.zeros(sum(len(s.points) for s in sky if s), dtype=np.float32)
    weight = np.zeros_like(open_)
    points = np.concatenate([s.points for s in sky if s])
    normals = np.concatenate([np.broadcast_to(s.normal, s.points.shape) for s in sky if s])
    for direction in directions:
        facing = normals @ direction
        upper = np.flatnonzero(facing > 0.02)
        free = ~index.blocked(points[upper], np.broadcast_to(direction, (len(upper), 3)), limit=60.0)
        open_[upper] += (free * facing[upper]).astype(np.float32)
    for direction in directions:
        weight += np.maximum(0, direction[2])
    lights: list[Image | None] = []
    at_sun = at_sky = 0
    for chart, a, b in zip(charts, sun, sky, strict=True):
        if a is None or b is None:
            lights.append(None)
            continue
        direct = sunny[at_sun : at_sun + len(a.points)] * np.maximum(0, np.broadcast_to(a.normal, a.points.shape) @ SUN)
        ambient = open_[at_sky : at_sky + len(b.points)] / weight[at_sky : at_sky + len(b.points)]
        at_sun, at_sky = at_sun + len(a.points), at_sky + len(b.points)
        inner = a.rows - 2 * chart.ring, a.columns - 2 * chart.ring
        fine = _linear(ambient.reshape(b.rows, b.columns), chart.ring, inner, chart.ring)
        direct = direct.reshape(a.rows, a.columns).astype(np.float32) / np.float32(SUN[2])
        # A part of the sky's light comes from the ground: walls in the shade are not black.
        lights.append(direct[..., None] * _SUN_COLOR + (0.25 + 0.75 * fine[..., None]) * _SKY_COLOR)
    return lights


def _rays(points: list[FloatArray], direction: FloatArray) -> tuple[FloatArray, FloatArray]:
    starts = np.concatenate(points)
    return starts, np.broadcast_to(direction, starts.shape)


def _lattice(plan: CityPlan, chart: Chart, step: float) -> _Lattice:
    width, height = chart.size
    columns, rows = max(2, round(width / step)), max(2, round(height / step))
    s, t = np.meshgrid(*((np.arange(-chart.ring, n + chart.ring) + 0.5) / n for n in (columns, rows)))
    rows, columns = s.shape
    points = chart.corner + s.reshape(-1, 1) * chart.u + t.reshape(-1, 1) * chart.v
    if chart.ring:
        terrain, d = plan.terrain, 0.5
        x, y = points[:, 0], points[:, 1]
        points[:, 2] = terrain.at(x, y)
        slope_x = (terrain.at(x + d, y) - terrain.at(x - d, y)) / (2 * d)
        slope_y = (terrain.at(x, y + d) - terrain.at(x, y - d)) / (2 * d)
        normal = np.stack([-slope_x, -slope_y, np.ones_like(x)], axis=1)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        return _Lattice(columns, rows, points + [0, 0, _LIFT], normal)
    normal = np.cross(chart.u, chart.v)
    normal /= np.linalg.norm(normal)
    return _Lattice(columns, rows, points + _LIFT * normal, normal)


def _hemisphere(count: int) -> FloatArray:
    """Directions (count, 3) spread evenly over the upper half of the sphere."""
    k = np.arange(count) + 0.5
    z, angle = 1 - k / count, np.pi * (3 - np.sqrt(5)) * k
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=1)


def upsampled(light: Image, chart: Chart) -> Image:
    """The lattice's light at texels, the margin's too."""
    return np.stack([_linear(light[..., k], chart.ring, chart.shape, MARGIN) for k in range(3)], axis=2)


def _linear(plane: NDArray[np.float32], ring: int, shape: tuple[int, int], beyond: int) -> NDArray[np.float32]:
    """Resampled to cell centres of another grid (rows, columns) over the same rectangle, linear along each axis.

    Args:
        ring: cells of the plane beyond each edge of the rectangle; where they end, light stays as it is.
        beyond: cells that are wanted beyond each edge of it.
    """
    for size in shape:
        count = len(plane) - 2 * ring
        at = (np.arange(-beyond, size + beyond) + 0.5) * count / size - 0.5 + ring
        at = np.clip(at, 0, len(plane) - 1)
        low = np.minimum(at.astype(int), len(plane) - 2)
        part = (at - low).astype(np.float32)[:, None]
        plane = ((1 - part) * plane[low] + part * plane[low + 1]).T
    return plane
