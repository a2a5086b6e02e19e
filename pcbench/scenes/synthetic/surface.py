"""Convert a plan to a textured triangle mesh: charts packed into texture pages, painted, and lit by sun and sky."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.cameras import Camera
from pcbench.geometry.mesh import Mesh, MeshIndex
from pcbench.geometry.visibility import pixel_sizes
from pcbench.scenes.synthetic.layout import lay_out
from pcbench.scenes.synthetic.light import CHART_MARGIN, SUN_DIRECTION, Chart, compute_lights, upsample_light
from pcbench.scenes.synthetic.noise import Grid
from pcbench.scenes.synthetic.paint import Paint, Painter
from pcbench.scenes.synthetic.plan import CityPlan, CitySettings, Solid, Terrain, Tree

_PAGE_TEXELS = 4096  # along a side of a texture page; supported by all OpenGL implementations
_LEAVES_TEXELS = 256  # along a side of the foliage texture
_GROUND_TILE_CELLS = 10  # terrain cells along a ground tile with a separate texture
_MAX_TEXELS = 120e6  # per city: 0.4 GB, and minutes of painting


@dataclass(frozen=True, eq=False)
class CitySurface:
    """City to photograph: the true mesh and its appearance."""

    plan: CityPlan
    mesh: Mesh
    uv: NDArray[np.float32]  # (F, 3, 2) texture coordinates of each face's corners on its page
    page: IntArray  # (F,)
    shade: NDArray[np.uint8]  # (F, 3) light at the corners of trees, 255 if the texture includes the light
    pages: list[NDArray[np.uint8]]  # (rows, columns, 3); row 0 is at v = 0
    mirrors: list[NDArray[np.uint8] | None]  # (rows, columns) reflectance of glass and water in thousandths


@dataclass
class _FaceBuilder:
    """Collects vertices and faces."""

    vertices: list[FloatArray] = field(default_factory=list)
    faces: list[IntArray] = field(default_factory=list)
    uv: list[FloatArray] = field(default_factory=list)  # (F, 3, 2) in the chart
    chart: list[int] = field(default_factory=list)
    shade: list[FloatArray] = field(default_factory=list)  # (F, 3)
    count: int = 0

    def add(self, vertices: FloatArray) -> int:
        """Add vertices; return the index of the first."""
        first = self.count
        self.vertices.append(vertices)
        self.count += len(vertices)
        return first

    def cover(self, faces: IntArray, uv: FloatArray, chart: int, shade: FloatArray | None = None) -> None:
        """Add faces with their texture coordinates in a chart."""
        self.faces.append(faces)
        self.uv.append(uv)
        self.chart += [chart] * len(faces)
        self.shade.append(np.ones((len(faces), 3)) if shade is None else shade)


def build_city(
    city: CitySettings | CityPlan, texel: float | None = None, cameras: Sequence[Camera] = ()
) -> CitySurface:
    """Lay out, mesh, paint and light a city; about 20 CPU seconds with default settings.

    Args:
        city: settings of a city, or its plan.
        texel: texel size in metres on city surfaces without a camera nearby; fields get four times as much. Default:
            0.15, or more in proportion if the city is larger than 400 m.
        cameras: cameras of the images. Surfaces that they observe get texels at most as large as the smallest pixel
            there, unless the city would have too many texels. Foliage is not refined.
    """
    plan = lay_out(city) if isinstance(city, CitySettings) else city
    texel = texel or 0.15 * max(1.0, plan.settings.extent / 400)
    faces, charts = _FaceBuilder(), list[Chart]()
    _add_ground(plan.terrain, plan.settings, texel, faces, charts)
    for solid in plan.solids:
        _add_solid(solid, texel, faces, charts)
    charts = _refine_texels(plan.terrain, charts, cameras)
    leaves = len(charts)
    side = 1 / _LEAVES_TEXELS
    charts.append(Chart("leaves", "", 0, np.zeros(3), np.array([1.0, 0, 0]), np.array([0, 1.0, 0]), side, side))
    for tree in plan.trees:
        _add_tree(tree, leaves, faces)
    mesh = Mesh(np.concatenate(faces.vertices), np.concatenate(faces.faces), unit="m")

    index = MeshIndex(mesh)
    positions = _pack(charts)
    pages, mirrors = _paint_pages(plan, charts, positions, index)
    chart = np.array(faces.chart)
    corner = np.array([[p.x, p.y] for p in positions]) + CHART_MARGIN
    extent = np.array([c.shape[::-1] for c in charts])
    sides = np.array([page.shape[1::-1] for page in pages])
    page = np.array([p.page for p in positions])[chart]
    uv = (corner[chart][:, None] + np.concatenate(faces.uv) * extent[chart][:, None]) / sides[page][:, None]
    shade = np.round(255 * np.concatenate(faces.shade)).astype(np.uint8)
    return CitySurface(plan, mesh, uv.astype(np.float32), page, shade, pages, mirrors)


# ---- faces ----


def _add_ground(
    terrain: Terrain, settings: CitySettings, texel: float, faces: _FaceBuilder, charts: list[Chart]
) -> None:
    """Add square ground tiles with separate textures, so that tiles far from all cameras can be coarse."""
    n = len(terrain.heights)
    coordinates = (np.arange(n) - (n - 1) / 2) * terrain.step
    x, y = np.meshgrid(coordinates, coordinates)
    first = faces.add(np.stack([x, y, terrain.heights], axis=2).reshape(-1, 3))
    i = first + np.arange(n * n).reshape(n, n)
    flat = np.stack([x, y], axis=2).reshape(-1, 2)
    side = _GROUND_TILE_CELLS * terrain.step
    for row in range(0, n - 1, _GROUND_TILE_CELLS):
        for column in range(0, n - 1, _GROUND_TILE_CELLS):
            corner = np.array([coordinates[column], coordinates[row], 0])
            town = np.abs(corner[:2] + side / 2).max() < settings.extent / 2
            size = texel if town else 4 * texel
            u, v = np.array([side, 0, 0]), np.array([0, side, 0])
            charts.append(Chart("town" if town else "country", "", 0, corner, u, v, size, size))
            part = i[row : row + _GROUND_TILE_CELLS + 1, column : column + _GROUND_TILE_CELLS + 1]
            a, b, c, d = (p.ravel() for p in (part[:-1, :-1], part[:-1, 1:], part[1:, 1:], part[1:, :-1]))
            triangles = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
            faces.cover(triangles, (flat[triangles - first] - corner[:2]) / side, len(charts) - 1)


def _add_solid(solid: Solid, texel: float, faces: _FaceBuilder, charts: list[Chart]) -> None:
    foot = solid.footprint()
    low = np.column_stack([foot, np.full(4, solid.bottom)])
    high = np.column_stack([foot, np.full(4, solid.eaves)])
    # The ridge joins the midpoints of sides 0 and 2.
    ridge = np.column_stack([(foot[[0, 2]] + foot[[1, 3]]) / 2, np.full(2, solid.eaves + solid.rise)])
    first = faces.add(np.concatenate([low, high, ridge]))
    vertices = np.concatenate([low, high, ridge])

    def cover(side: str, corner: FloatArray, u: FloatArray, v: FloatArray, polygon: list[int]) -> None:
        charts.append(Chart(solid.kind, side, solid.seed, corner, u, v, texel, texel))
        d = vertices[polygon] - corner
        uv = np.stack([d @ u / (u @ u), d @ v / (v @ v)], axis=1)
        fan = np.array([[0, k, k + 1] for k in range(1, len(polygon) - 1)])
        faces.cover(first + np.array(polygon)[fan], uv[fan], len(charts) - 1)

    for k in range(4):
        next_corner = (k + 1) % 4
        gable = solid.rise > 0 and k % 2 == 0
        up = np.array([0, 0, solid.eaves - solid.bottom + (solid.rise if gable else 0)])
        polygon = [k, next_corner, 4 + next_corner, *([8 + k // 2] if gable else []), 4 + k]
        cover(f"wall{k}", low[k], low[next_corner] - low[k], up, polygon)
    if solid.rise > 0:
        cover("slope0", high[3], high[0] - high[3], ridge[1] - high[3], [7, 4, 8, 9])
        cover("slope1", high[1], high[2] - high[1], ridge[0] - high[1], [5, 6, 9, 8])
    else:
        cover("roof", high[0], high[1] - high[0], high[3] - high[0], [4, 5, 6, 7])


def tree_shape(tree: Tree, rng: np.random.Generator) -> tuple[FloatArray, IntArray]:
    """Return a trunk and a crown, an irregular solid of revolution: vertices (V, 3) and triangles (F, 3)."""
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
    return vertices, np.concatenate(triangles)


def _add_tree(tree: Tree, chart: int, faces: _FaceBuilder) -> None:
    """Add a tree with its foliage."""
    rng = np.random.default_rng(tree.seed)
    vertices, faces_ = tree_shape(tree, rng)
    first = faces.add(vertices)
    # Project leaves from above at a random position, so that there are no visible seams between faces.
    spread = (
        (vertices[:, :2] - [tree.x, tree.y]) * 0.045 + rng.uniform(0.3, 0.7, 2) + 0.02 * (vertices[:, 2:] - tree.base)
    )
    uv = np.clip(spread, 0.0, 1.0)[faces_]
    out = (vertices - [tree.x, tree.y, tree.base + 0.5 * tree.height]) / [tree.radius, tree.radius, 0.5 * tree.height]
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    light = 0.42 + 0.22 * out[:, 2] + 0.44 * np.maximum(out @ SUN_DIRECTION, 0)
    tint = rng.uniform(0.85, 1.15)
    faces.cover(first + faces_, uv, chart, np.clip(light * tint, 0.15, 1.0)[faces_])


# ---- textures ----


class _PagePosition(NamedTuple):
    """Position of a chart's corner on a page, in texels."""

    page: int
    x: int
    y: int


def _pack(charts: list[Chart]) -> list[_PagePosition]:
    """Return positions on pages for charts with their margins: shelf packing, the tallest first."""
    positions: list[_PagePosition | None] = [None] * len(charts)
    page, x, y, shelf = 0, 0, 0, 0
    for k in sorted(range(len(charts)), key=lambda k: -charts[k].shape[0]):
        rows, columns = (n + 2 * CHART_MARGIN for n in charts[k].shape)
        if max(rows, columns) > _PAGE_TEXELS:
            raise AssertionError(f"a chart of {rows} x {columns} texels does not fit a page")
        if x + columns > _PAGE_TEXELS:
            x, y, shelf = 0, y + shelf, 0
        if y + rows > _PAGE_TEXELS:
            page, x, y, shelf = page + 1, 0, 0, 0
        positions[k] = _PagePosition(page, x, y)
        x, shelf = x + columns, max(shelf, rows)
    return [position for position in positions if position is not None]


def _refine_texels(terrain: Terrain, charts: list[Chart], cameras: Sequence[Camera]) -> list[Chart]:
    """Refine the charts' texels to slightly less than the smallest pixel at 49 points of each chart.

    The pixel size may be smaller between these points. If there are too many texels, or a chart is too large for a
    page, all texels are enlarged by one factor.
    """
    s, t = (x.ravel() for x in np.meshgrid(np.linspace(0, 1, 7), np.linspace(0, 1, 7)))
    positions = np.stack([c.corner + s[:, None] * c.u + t[:, None] * c.v for c in charts])
    ground = np.array([c.kind in ("town", "country") for c in charts])
    positions[ground, :, 2] = terrain.at(positions[ground, :, 0], positions[ground, :, 1])
    smallest = np.full(len(charts), np.inf)
    for camera in cameras:
        pixels = pixel_sizes(camera, positions.reshape(-1, 3), beyond=0.1)
        np.fmin(smallest, pixels.reshape(len(charts), -1).min(axis=1), out=smallest)
    texels = np.fmin([c.texel for c in charts], 0.9 * smallest)
    sides = np.array([c.size for c in charts])
    excess = max(
        float(np.sqrt((sides.prod(axis=1) / texels**2).sum() / _MAX_TEXELS)),
        float((sides.max(axis=1) / texels).max() / (_PAGE_TEXELS - 2 * CHART_MARGIN - 1)),
    )
    return [replace(c, texel=float(texel)) for c, texel in zip(charts, texels * max(1.0, excess), strict=True)]


def _paint_pages(
    plan: CityPlan, charts: list[Chart], positions: list[_PagePosition], index: MeshIndex
) -> tuple[list[NDArray[np.uint8]], list[NDArray[np.uint8] | None]]:
    painter = Painter(plan.settings)
    placed = list(zip(charts, positions, strict=True))
    heights = [
        max(p.y + c.shape[0] + 2 * CHART_MARGIN for c, p in placed if p.page == page)
        for page in range(1 + max(p.page for p in positions))
    ]
    pages = [np.zeros((rows, _PAGE_TEXELS, 3), dtype=np.uint8) for rows in heights]
    mirrors: list[NDArray[np.uint8] | None] = [None] * len(pages)
    for chart, position, light in zip(charts, positions, compute_lights(plan, charts, index), strict=True):
        grid = _grid(chart)
        image, mirror = _albedo(painter, plan, chart, grid)
        if light is not None:
            image = image * upsample_light(light, chart)
        rows, columns = grid.shape
        target = np.s_[position.y : position.y + rows, position.x : position.x + columns]
        texels = np.clip(image, 0, 1, out=image)
        texels *= 255
        texels += 0.5
        pages[position.page][target] = texels
        if mirror is not None:
            page_mirror = mirrors[position.page]
            if page_mirror is None:
                page_mirror = mirrors[position.page] = np.zeros(pages[position.page].shape[:2], dtype=np.uint8)
            page_mirror[target] = np.round(1000 * mirror)
    return pages, mirrors


def _grid(chart: Chart) -> Grid:
    (rows, columns), (width, height) = chart.shape, chart.size
    u = (np.arange(-CHART_MARGIN, columns + CHART_MARGIN) + 0.5) * width / columns
    v = (np.arange(-CHART_MARGIN, rows + CHART_MARGIN) + 0.5) * height / rows
    return Grid(u, v, width, height)


def _albedo(painter: Painter, plan: CityPlan, chart: Chart, grid: Grid) -> Paint:
    if chart.kind == "leaves":
        return painter.paint_leaves(grid.shape[0])
    if chart.kind not in ("town", "country"):
        return painter.paint_face(chart.kind, chart.side, chart.seed, grid)
    half = plan.settings.extent * (0.5 if chart.kind == "town" else 1.0)
    city_grid = Grid(grid.u + chart.corner[0] + half, grid.v + chart.corner[1] + half, 2 * half, 2 * half)
    return painter.paint_town(plan, city_grid) if chart.kind == "town" else painter.paint_countryside(city_grid)
