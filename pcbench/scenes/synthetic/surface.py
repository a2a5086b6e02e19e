"""A plan becomes a triangle mesh with textures: charts packed into pages, painted, lit by the sun and the sky."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.mesh import Mesh, MeshIndex
from pcbench.scenes.synthetic.layout import lay_out
from pcbench.scenes.synthetic.paint import Grid, Image, Painter
from pcbench.scenes.synthetic.plan import CELLS, CitySettings, Plan, Solid, Terrain, Tree

SUN = np.array([-0.52, -0.46, 0.72]) / np.linalg.norm([-0.52, -0.46, 0.72])  # towards it: an afternoon, south-west
_SUN_COLOR = np.array([0.70, 0.65, 0.56], dtype=np.float32)
_SKY_COLOR = np.array([0.50, 0.53, 0.58], dtype=np.float32)
_MARGIN = 4  # texels around a chart, painted as it goes on: mipmaps take their colours from there
_PAGE = 4096  # texels along a page, which every OpenGL can hold
_LEAVES = 256  # texels along the foliage
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
    texel: float

    @property
    def size(self) -> tuple[float, float]:
        return float(np.linalg.norm(self.u)), float(np.linalg.norm(self.v))

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns without the margin."""
        width, height = self.size
        return max(2, round(height / self.texel)), max(2, round(width / self.texel))


@dataclass(frozen=True, eq=False)
class CitySurface:
    """A city to photograph: the mesh is the truth, the rest is how it looks."""

    plan: Plan
    mesh: Mesh
    uv: NDArray[np.float32]  # (F, 3, 2) of each face's corners on its page
    page: IntArray  # (F,)
    shade: NDArray[np.uint8]  # (F, 3) light at the corners of trees, 255 where the texture holds it
    pages: list[NDArray[np.uint8]]  # (rows, columns, 3); row 0 is at v = 0


@dataclass
class _Faces:
    """Vertices and faces as they come."""

    vertices: list[FloatArray] = field(default_factory=list)
    faces: list[IntArray] = field(default_factory=list)
    uv: list[FloatArray] = field(default_factory=list)  # (F, 3, 2) in the chart
    chart: list[int] = field(default_factory=list)
    shade: list[FloatArray] = field(default_factory=list)  # (F, 3)
    count: int = 0

    def add(self, vertices: FloatArray) -> int:
        first = self.count
        self.vertices.append(vertices)
        self.count += len(vertices)
        return first

    def cover(self, faces: IntArray, uv: FloatArray, chart: int, shade: FloatArray | None = None) -> None:
        self.faces.append(faces)
        self.uv.append(uv)
        self.chart += [chart] * len(faces)
        self.shade.append(np.ones((len(faces), 3)) if shade is None else shade)


def build_city(settings: CitySettings, texel: float | None = None) -> CitySurface:
    """Lay out, mesh, paint and light a city; about 8 CPU seconds for the default one.

    Args:
        settings: what kind of city.
        texel: metres of a texel in the city; by default 0.15, more where the city is larger than 400 m.
    """
    texel = texel or 0.15 * max(1.0, settings.extent / 400)
    plan = lay_out(settings)
    faces, charts = _Faces(), list[Chart]()
    _ground(plan.terrain, settings, texel, faces, charts)
    for solid in plan.solids:
        _solid(solid, texel, faces, charts)
    leaves = len(charts)
    charts.append(Chart("leaves", "", 0, np.zeros(3), np.array([1.0, 0, 0]), np.array([0, 1.0, 0]), 1 / _LEAVES))
    for tree in plan.trees:
        _tree(tree, leaves, faces)
    mesh = Mesh(np.concatenate(faces.vertices), np.concatenate(faces.faces), unit="m")

    index = MeshIndex(mesh)
    places = _pack(charts)
    pages = _paint(plan, charts, places, index)
    chart = np.array(faces.chart)
    corner = np.array([[p.x, p.y] for p in places]) + _MARGIN
    extent = np.array([c.shape[::-1] for c in charts])
    sides = np.array([page.shape[1::-1] for page in pages])
    page = np.array([p.page for p in places])[chart]
    uv = (corner[chart][:, None] + np.concatenate(faces.uv) * extent[chart][:, None]) / sides[page][:, None]
    shade = np.round(255 * np.concatenate(faces.shade)).astype(np.uint8)
    return CitySurface(plan, mesh, uv.astype(np.float32), page, shade, pages)


# ---- faces ----


def _ground(terrain: Terrain, settings: CitySettings, texel: float, faces: _Faces, charts: list[Chart]) -> None:
    n = len(terrain.heights)
    at = (np.arange(n) - (n - 1) / 2) * terrain.step
    x, y = np.meshgrid(at, at)
    first = faces.add(np.stack([x, y, terrain.heights], axis=2).reshape(-1, 3))
    i = first + np.arange(n * n).reshape(n, n)
    cell = np.arange(n - 1) - (n - 1) // 2
    inside = (cell >= -CELLS // 2) & (cell < CELLS // 2)
    town = inside[:, None] & inside[None, :]
    for kind, where, half, size in (
        ("town", town, settings.extent / 2, texel),
        ("country", ~town, settings.extent, 4 * texel),
    ):
        corner = np.array([-half, -half, 0])
        charts.append(Chart(kind, "", 0, corner, np.array([2 * half, 0, 0]), np.array([0, 2 * half, 0]), size))
        a, b, c, d = (block[where] for block in (i[:-1, :-1], i[:-1, 1:], i[1:, 1:], i[1:, :-1]))
        triangles = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
        flat = np.stack([x, y], axis=2).reshape(-1, 2)
        faces.cover(triangles, (flat[triangles - first] + half) / (2 * half), len(charts) - 1)


def _solid(solid: Solid, texel: float, faces: _Faces, charts: list[Chart]) -> None:
    foot = solid.footprint()
    low = np.column_stack([foot, np.full(4, solid.bottom)])
    high = np.column_stack([foot, np.full(4, solid.eaves)])
    # The ridge joins the middles of sides 0 and 2.
    ridge = np.column_stack([(foot[[0, 2]] + foot[[1, 3]]) / 2, np.full(2, solid.eaves + solid.rise)])
    first = faces.add(np.concatenate([low, high, ridge]))
    vertices = np.concatenate([low, high, ridge])

    def cover(side: str, corner: FloatArray, u: FloatArray, v: FloatArray, polygon: list[int]) -> None:
        charts.append(Chart(solid.kind, side, solid.seed, corner, u, v, texel))
        d = vertices[polygon] - corner
        uv = np.stack([d @ u / (u @ u), d @ v / (v @ v)], axis=1)
        fan = np.array([[0, k, k + 1] for k in range(1, len(polygon) - 1)])
        faces.cover(first + np.array(polygon)[fan], uv[fan], len(charts) - 1)

    for k in range(4):
        following = (k + 1) % 4
        gable = solid.rise > 0 and k % 2 == 0
        up = np.array([0, 0, solid.eaves - solid.bottom + (solid.rise if gable else 0)])
        polygon = [k, following, 4 + following, *([8 + k // 2] if gable else []), 4 + k]
        cover(f"wall{k}", low[k], low[following] - low[k], up, polygon)
    if solid.rise > 0:
        cover("slope0", high[3], high[0] - high[3], ridge[1] - high[3], [7, 4, 8, 9])
        cover("slope1", high[1], high[2] - high[1], ridge[0] - high[1], [5, 6, 9, 8])
    else:
        cover("roof", high[0], high[1] - high[0], high[3] - high[0], [4, 5, 6, 7])


def _tree(tree: Tree, chart: int, faces: _Faces) -> None:
    """A trunk and a crown, turned on a lathe and made irregular."""
    rng = np.random.default_rng(tree.seed)
    around = 9
    profile = np.array(  # radius in radii, height in heights
        [[0.07, -0.08], [0.06, 0.26], [0.62, 0.30], [0.95, 0.46], [1.0, 0.60], [0.78, 0.80], [0.38, 0.95]]
    )
    rings = len(profile)
    bump = np.ones((rings, around))
    bump[2:] += rng.uniform(-0.20, 0.20, (rings - 2, around))
    angle = 2 * np.pi * (np.arange(around) + rng.random()) / around
    radius = tree.radius * profile[:, :1] * bump
    z = tree.base + tree.height * profile[:, 1:] * np.ones((1, around))
    ring = np.stack([tree.x + radius * np.cos(angle), tree.y + radius * np.sin(angle), z], axis=2).reshape(-1, 3)
    vertices = np.concatenate([ring, [[tree.x, tree.y, tree.base + tree.height]]])
    first = faces.add(vertices)
    k = np.arange(around)
    triangles = [
        np.stack([j * around + k, j * around + (k + 1) % around, (j + 1) * around + (k + 1) % around], axis=1)
        for j in range(rings - 1)
    ]
    triangles += [
        np.stack([j * around + k, (j + 1) * around + (k + 1) % around, (j + 1) * around + k], axis=1)
        for j in range(rings - 1)
    ]
    triangles.append(
        np.stack([(rings - 1) * around + k, (rings - 1) * around + (k + 1) % around, 0 * k + rings * around], axis=1)
    )
    faces_ = np.concatenate(triangles)
    # Leaves from above, at a random place: seams between faces do not show in them.
    spread = (
        (vertices[:, :2] - [tree.x, tree.y]) * 0.045 + rng.uniform(0.3, 0.7, 2) + 0.02 * (vertices[:, 2:] - tree.base)
    )
    uv = np.clip(spread, 0.0, 1.0)[faces_]
    out = (vertices - [tree.x, tree.y, tree.base + 0.5 * tree.height]) / [tree.radius, tree.radius, 0.5 * tree.height]
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    light = 0.42 + 0.22 * out[:, 2] + 0.44 * np.maximum(out @ SUN, 0)
    tint = rng.uniform(0.85, 1.15)
    faces.cover(first + faces_, uv, chart, np.clip(light * tint, 0.15, 1.0)[faces_])


# ---- textures ----


class _Place(NamedTuple):
    page: int
    x: int
    y: int


def _pack(charts: list[Chart]) -> list[_Place]:
    """Places on pages for charts with their margins: shelves, the tallest first."""
    places: list[_Place | None] = [None] * len(charts)
    page, x, y, shelf = 0, 0, 0, 0
    for k in sorted(range(len(charts)), key=lambda k: -charts[k].shape[0]):
        rows, columns = (n + 2 * _MARGIN for n in charts[k].shape)
        if max(rows, columns) > _PAGE:
            raise AssertionError(f"a chart of {rows} x {columns} texels does not fit a page")
        if x + columns > _PAGE:
            x, y, shelf = 0, y + shelf, 0
        if y + rows > _PAGE:
            page, x, y, shelf = page + 1, 0, 0, 0
        places[k] = _Place(page, x, y)
        x, shelf = x + columns, max(shelf, rows)
    return [place for place in places if place is not None]


def _paint(plan: Plan, charts: list[Chart], places: list[_Place], index: MeshIndex) -> list[NDArray[np.uint8]]:
    painter = Painter(plan.settings)
    heights = [max(p.y + c.shape[0] + 2 * _MARGIN for c, p in zip(charts, places, strict=True) if p.page == page)
               for page in range(1 + max(p.page for p in places))]  # fmt: skip
    pages = [np.zeros((rows, _PAGE, 3), dtype=np.uint8) for rows in heights]
    lights = _lights(plan, charts, index)
    for chart, place, light in zip(charts, places, lights, strict=True):
        grid = _grid(chart)
        image = _albedo(painter, plan, chart, grid)
        if light is not None:
            image = image * _upsampled(light, chart, grid)
        rows, columns = grid.shape
        texels = np.clip(image, 0, 1, out=image)
        texels *= 255
        texels += 0.5
        pages[place.page][place.y : place.y + rows, place.x : place.x + columns] = texels
    return pages


def _grid(chart: Chart) -> Grid:
    (rows, columns), (width, height) = chart.shape, chart.size
    u = (np.arange(-_MARGIN, columns + _MARGIN) + 0.5) * width / columns
    v = (np.arange(-_MARGIN, rows + _MARGIN) + 0.5) * height / rows
    return Grid(u, v, width, height)


def _albedo(painter: Painter, plan: Plan, chart: Chart, grid: Grid) -> Image:
    if chart.kind == "town":
        return painter.town(plan, grid)
    if chart.kind == "country":
        return painter.country(grid)
    if chart.kind == "leaves":
        return painter.leaves(grid.shape[0])
    return painter.face(chart.kind, chart.side, chart.seed, grid)


# ---- light ----


class _Lattice(NamedTuple):
    """Points of a chart at which light is computed; it is linear between them."""

    columns: int
    rows: int
    points: FloatArray  # (rows * columns, 3), lifted off the surface
    normal: FloatArray  # (3,) or (rows * columns, 3)


def _lights(plan: Plan, charts: list[Chart], index: MeshIndex) -> list[Image | None]:
    """Light (rows, columns, 3) on a lattice over each chart: sun where it reaches, sky by the open share of it."""
    sun = [None if c.kind == "leaves" else _lattice(plan, c, 2 * c.texel) for c in charts]
    sky = [None if c.kind == "leaves" else _lattice(plan, c, 8 * c.texel) for c in charts]
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
    for a, b in zip(sun, sky, strict=True):
        if a is None or b is None:
            lights.append(None)
            continue
        direct = sunny[at_sun : at_sun + len(a.points)] * np.maximum(0, np.broadcast_to(a.normal, a.points.shape) @ SUN)
        ambient = open_[at_sky : at_sky + len(b.points)] / weight[at_sky : at_sky + len(b.points)]
        at_sun, at_sky = at_sun + len(a.points), at_sky + len(b.points)
        fine = _linear(ambient.reshape(b.rows, b.columns), a.rows, a.columns)
        direct = direct.reshape(a.rows, a.columns).astype(np.float32) / np.float32(SUN[2])
        # A part of the sky's light comes from the ground: walls in the shade are not black.
        lights.append(direct[..., None] * _SUN_COLOR + (0.25 + 0.75 * fine[..., None]) * _SKY_COLOR)
    return lights


def _rays(points: list[FloatArray], direction: FloatArray) -> tuple[FloatArray, FloatArray]:
    starts = np.concatenate(points)
    return starts, np.broadcast_to(direction, starts.shape)


def _lattice(plan: Plan, chart: Chart, step: float) -> _Lattice:
    width, height = chart.size
    columns, rows = max(2, round(width / step)), max(2, round(height / step))
    s, t = np.meshgrid((np.arange(columns) + 0.5) / columns, (np.arange(rows) + 0.5) / rows)
    points = chart.corner + s.reshape(-1, 1) * chart.u + t.reshape(-1, 1) * chart.v
    if chart.kind in ("town", "country"):
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


def _upsampled(light: Image, chart: Chart, grid: Grid) -> Image:
    """The lattice's light at texels, the margin's too: there as at the edge."""
    inner = [_linear(light[..., k], *chart.shape) for k in range(3)]
    return np.stack([np.pad(plane, _MARGIN, mode="edge") for plane in inner], axis=2)


def _linear(plane: NDArray[np.float32], rows: int, columns: int) -> NDArray[np.float32]:
    """Resampled to cell centres of another grid over the same rectangle, linear along each axis."""
    for size in (rows, columns):
        at = np.clip((np.arange(size) + 0.5) * len(plane) / size - 0.5, 0, len(plane) - 1)
        low = np.minimum(at.astype(int), len(plane) - 2)
        part = (at - low).astype(np.float32)[:, None]
        plane = ((1 - part) * plane[low] + part * plane[low + 1]).T
    return plane
