"""Charts (parts of a city's surface that each have a texture), and the light of sun and sky on them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.mesh import MeshIndex
from pcbench.scenes.synthetic.paint import Image
from pcbench.scenes.synthetic.plan import CityPlan

# Direction to the sun, in the south-west in the afternoon.
SUN_DIRECTION = np.array([-0.52, -0.46, 0.72]) / np.linalg.norm([-0.52, -0.46, 0.72])
CHART_MARGIN = 4  # texels painted beyond a chart's edges, because mipmaps mix them in
_SUN_COLOR = np.array([0.70, 0.65, 0.56], dtype=np.float32)
_SKY_COLOR = np.array([0.50, 0.53, 0.58], dtype=np.float32)
_RAY_OFFSET = 0.02  # m, from a surface to the origin of its light rays


@dataclass(frozen=True, eq=False)
class Chart:
    """Parallelogram of the surface with its own texture: corner + s * u + t * v, with s and t from 0 to 1.

    Ground charts lie at z = 0 and follow the terrain.
    """

    kind: str  # kind of the solid, or "town", "country" or "leaves"
    side: str
    seed: int
    corner: FloatArray
    u: FloatArray
    v: FloatArray
    texel: float  # m
    base_texel: float  # m, texel size without cameras nearby; it sets the resolution of the light

    @property
    def border_cells(self) -> int:
        """Light cells beyond each edge, so that the light on adjacent ground charts has no seams."""
        return int(self.kind in ("town", "country"))

    @property
    def size(self) -> tuple[float, float]:
        """Width and height in metres."""
        return float(np.linalg.norm(self.u)), float(np.linalg.norm(self.v))

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns without the margin."""
        width, height = self.size
        return max(2, round(height / self.texel)), max(2, round(width / self.texel))


class _Lattice(NamedTuple):
    """Points of a chart at which light is computed; it is interpolated linearly between them."""

    columns: int  # including the border cells
    rows: int
    points: FloatArray  # (rows * columns, 3), lifted off the surface
    normal: FloatArray  # (3,) or (rows * columns, 3)


def compute_lights(plan: CityPlan, charts: list[Chart], index: MeshIndex) -> list[Image | None]:
    """Compute light (rows, columns, 3) on a lattice over each chart: sunlight with shadows, and light of the sky."""
    sun = [None if c.kind == "leaves" else _lattice(plan, c, 2 * c.base_texel) for c in charts]
    sky = [None if c.kind == "leaves" else _lattice(plan, c, 8 * c.base_texel) for c in charts]
    sunny = ~index.is_occluded(*_rays([s.points for s in sun if s], SUN_DIRECTION))
    directions = _hemisphere(12)
    openness = np.zeros(sum(len(s.points) for s in sky if s), dtype=np.float32)
    weight = np.zeros_like(openness)
    points = np.concatenate([s.points for s in sky if s])
    normals = np.concatenate([np.broadcast_to(s.normal, s.points.shape) for s in sky if s])
    for direction in directions:
        facing = normals @ direction
        upper = np.flatnonzero(facing > 0.02)
        free = ~index.is_occluded(points[upper], np.broadcast_to(direction, (len(upper), 3)), limit=60.0)
        openness[upper] += (free * facing[upper]).astype(np.float32)
    for direction in directions:
        weight += np.maximum(0, direction[2])
    lights: list[Image | None] = []
    sun_start = sky_start = 0
    for chart, a, b in zip(charts, sun, sky, strict=True):
        if a is None or b is None:
            lights.append(None)
            continue
        direct = sunny[sun_start : sun_start + len(a.points)] * np.maximum(
            0, np.broadcast_to(a.normal, a.points.shape) @ SUN_DIRECTION
        )
        ambient = openness[sky_start : sky_start + len(b.points)] / weight[sky_start : sky_start + len(b.points)]
        sun_start, sky_start = sun_start + len(a.points), sky_start + len(b.points)
        inner = a.rows - 2 * chart.border_cells, a.columns - 2 * chart.border_cells
        fine = _resample(ambient.reshape(b.rows, b.columns), chart.border_cells, inner, chart.border_cells)
        direct = direct.reshape(a.rows, a.columns).astype(np.float32) / np.float32(SUN_DIRECTION[2])
        # A part of the sky light is reflected by the ground, so that walls in the shade are not black.
        lights.append(direct[..., None] * _SUN_COLOR + (0.25 + 0.75 * fine[..., None]) * _SKY_COLOR)
    return lights


def _rays(points: list[FloatArray], direction: FloatArray) -> tuple[FloatArray, FloatArray]:
    starts = np.concatenate(points)
    return starts, np.broadcast_to(direction, starts.shape)


def _lattice(plan: CityPlan, chart: Chart, step: float) -> _Lattice:
    width, height = chart.size
    columns, rows = max(2, round(width / step)), max(2, round(height / step))
    s, t = np.meshgrid(*((np.arange(-chart.border_cells, n + chart.border_cells) + 0.5) / n for n in (columns, rows)))
    rows, columns = s.shape
    points = chart.corner + s.reshape(-1, 1) * chart.u + t.reshape(-1, 1) * chart.v
    if chart.border_cells:
        terrain, d = plan.terrain, 0.5
        x, y = points[:, 0], points[:, 1]
        points[:, 2] = terrain.at(x, y)
        slope_x = (terrain.at(x + d, y) - terrain.at(x - d, y)) / (2 * d)
        slope_y = (terrain.at(x, y + d) - terrain.at(x, y - d)) / (2 * d)
        normal = np.stack([-slope_x, -slope_y, np.ones_like(x)], axis=1)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        return _Lattice(columns, rows, points + [0, 0, _RAY_OFFSET], normal)
    normal = np.cross(chart.u, chart.v)
    normal /= np.linalg.norm(normal)
    return _Lattice(columns, rows, points + _RAY_OFFSET * normal, normal)


def _hemisphere(count: int) -> FloatArray:
    """Return directions (count, 3) spread evenly over the upper hemisphere."""
    k = np.arange(count) + 0.5
    z, angle = 1 - k / count, np.pi * (3 - np.sqrt(5)) * k
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=1)


def upsample_light(light: Image, chart: Chart) -> Image:
    """Interpolate the lattice's light at all texels, including the margin."""
    return np.stack([_resample(light[..., k], chart.border_cells, chart.shape, CHART_MARGIN) for k in range(3)], axis=2)


def _resample(
    plane: NDArray[np.float32], border_cells: int, shape: tuple[int, int], beyond: int
) -> NDArray[np.float32]:
    """Resample linearly to the cell centres of another grid (rows, columns) over the same rectangle.

    Args:
        plane: (rows, columns) values, including border cells.
        border_cells: border cells of the plane beyond each edge of the rectangle; beyond them, values are constant.
        shape: rows and columns of the new grid.
        beyond: cells of the new grid beyond each edge of the rectangle.
    """
    for size in shape:
        count = len(plane) - 2 * border_cells
        rows = (np.arange(-beyond, size + beyond) + 0.5) * count / size - 0.5 + border_cells
        rows = np.clip(rows, 0, len(plane) - 1)
        low = np.minimum(rows.astype(int), len(plane) - 2)
        part = (rows - low).astype(np.float32)[:, None]
        plane = ((1 - part) * plane[low] + part * plane[low + 1]).T
    return plane
