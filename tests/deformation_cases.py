"""Pairs of clouds with a known deformation: none, a smooth bend, or a moved part; for tests and benchmarks.

Scenes: a city of boxes, rolling terrain, a forest, and real clouds cut into random halves. Noise: white, and correlated
displacements of the candidate's points along each axis, even or uneven over the scene.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from data_folder import data_folder
from scipy import ndimage

from pcbench import Cloud, read_cloud
from pcbench.deformation import Side
from pcbench.deformation.pairs import PairSearch
from pcbench.geometry.neighbors import Index
from pcbench.geometry.normals import Surface
from pcbench.registration import local_origin, register
from pcbench.scenes.synthetic import city

SIZE = 400.0  # m
SIGMA = 0.02  # m, of the white noise, and of the correlated
Points = np.ndarray


class Pair(NamedTuple):
    reference: Cloud
    candidate: Cloud
    bend: Callable[[Points], Points] | None = None  # displacements (N, 3) of the candidate at positions (N, 3)


def correlated_noise(points: Points, length: float, rng: np.random.Generator, kernel: str = "gauss") -> Points:
    """Return displacements (N, 3) of unit variance along each axis.

    They are correlated as exp(-d^2 / 2 l^2) ("gauss") or, as a sum of such, about as exp(-d / l) ("exp").
    """
    if kernel == "exp":
        components = [(0.45, 0.5), (0.35, 1.2), (0.2, 2.5)]  # share and length
        fields = [np.sqrt(share) * correlated_noise(points, scale * length, rng) for share, scale in components]
        return np.sum(fields, axis=0)
    lower = points.min(axis=0) - 4 * length
    step = length / 2.5
    shape = np.ceil((np.ptp(points, axis=0) + 8 * length) / step).astype(int) + 2
    grid_positions = ((points - lower) / step).T
    displacements = np.empty_like(points)
    for axis in range(3):
        grid = rng.normal(size=shape).astype(np.float32)
        grid = ndimage.gaussian_filter(grid, 2.5 / np.sqrt(2), mode="wrap", truncate=4)
        displacements[:, axis] = ndimage.map_coordinates(grid / grid.std(), grid_positions, order=1)
    return displacements / displacements.std()


def add_noise(
    points: Points, rng: np.random.Generator, length: float, kernel: str = "gauss", uneven: float = 1.0
) -> Points:
    """Add white and correlated noise of `SIGMA` each; `uneven` is the ratio of its largest to its smallest size."""
    size = np.ones(len(points))
    if uneven != 1.0:
        direction = rng.normal(size=2) / SIZE
        wave = np.sin(
            2 * np.pi * (points[:, :2] @ (direction / np.linalg.norm(direction))) / SIZE * rng.uniform(0.5, 1.2)
            + rng.uniform(0, 6)
        )
        size = uneven ** (0.5 * wave)
    noise = rng.normal(0, SIGMA, points.shape)
    if length:
        noise += SIGMA * correlated_noise(points, length, rng, kernel)
    return points + size[:, None] * noise


def city_points(count: int, rng: np.random.Generator, seed: int) -> Points:
    return city(seed).sample(count, rng)[0]


def terrain_points(count: int, rng: np.random.Generator, seed: int) -> Points:
    """Return rolling ground with waves of 40 to 150 m."""
    shape = np.random.default_rng(seed)
    xy = rng.uniform(-SIZE / 2, SIZE / 2, (count, 2))
    z = np.zeros(count)
    for _ in range(12):
        angle, wave = shape.uniform(0, 2 * np.pi), shape.uniform(40, 150)
        z += 0.015 * wave * np.sin(2 * np.pi / wave * (xy @ [np.cos(angle), np.sin(angle)]) + shape.uniform(0, 6))
    return np.column_stack([xy, z])


def forest_points(count: int, rng: np.random.Generator, seed: int, size: float = 120.0) -> Points:
    """Return points of rolling ground under tree crowns that fill ellipsoids."""
    shape = np.random.default_rng(seed)
    trees = int(size**2 / 30)
    stems = shape.uniform(-size / 2, size / 2, (trees, 2))
    radius, height = shape.uniform(1.5, 3.5, trees), shape.uniform(8, 25, trees)

    def ground(xy: Points) -> Points:
        return 3 * np.sin(xy[:, 0] / 25) * np.cos(xy[:, 1] / 31) + 0.05 * xy[:, 0]

    ground_xy = rng.uniform(-size / 2, size / 2, (count // 4, 2))
    ground_points = np.column_stack([ground_xy, ground(ground_xy) + rng.normal(0, 0.05, len(ground_xy))])
    tree_rows = rng.choice(trees, count - len(ground_xy), p=radius**2 / (radius**2).sum())
    offsets = rng.normal(size=(len(tree_rows), 3))
    offsets *= (rng.random(len(tree_rows)) ** (1 / 4) / np.linalg.norm(offsets, axis=1))[:, None]  # denser outside
    centre = np.column_stack([stems, ground(stems) + 0.65 * height])[tree_rows]
    return np.concatenate(
        [ground_points, centre + offsets * np.column_stack([radius, radius, 0.35 * height])[tree_rows]]
    )


def metric_cloud(points: Points) -> Cloud:
    return Cloud(points, unit="m")


def null_city(candidate: int, ratio: float, kernel: str = "gauss", uneven: float = 1.0) -> Callable[[int], Pair]:
    def make(seed: int) -> Pair:
        rng = np.random.default_rng(seed)
        reference = city_points(120_000, rng, seed % 5) + rng.normal(0, 0.01, (120_000, 3))
        return Pair(
            metric_cloud(reference),
            metric_cloud(
                add_noise(city_points(candidate, rng, seed % 5), rng, SIZE / ratio if ratio else 0.0, kernel, uneven)
            ),
        )

    return make


def null_sparse(seed: int) -> Pair:
    """Return the city with points metres apart, as in a sparse reconstruction: half of the planes bridge edges."""
    rng = np.random.default_rng(seed)
    reference, candidate = city_points(60_000, rng, seed % 5), city_points(8_000, rng, seed % 5)
    return Pair(metric_cloud(reference), metric_cloud(candidate + rng.normal(0, 0.03, candidate.shape)))


def null_terrain(ratio: float, uneven: float = 1.0) -> Callable[[int], Pair]:
    def make(seed: int) -> Pair:
        rng = np.random.default_rng(seed)
        reference = terrain_points(120_000, rng, seed) + rng.normal(0, 0.01, (120_000, 3))
        return Pair(
            metric_cloud(reference),
            metric_cloud(add_noise(terrain_points(40_000, rng, seed), rng, SIZE / ratio, uneven=uneven)),
        )

    return make


def null_forest(count: int) -> Callable[[int], Pair]:
    def make(seed: int) -> Pair:
        rng = np.random.default_rng(seed)
        return Pair(metric_cloud(forest_points(count, rng, seed)), metric_cloud(forest_points(count, rng, seed)))

    return make


def cloud_halves(folder: str, file: str, ground: bool = False, bend: float = 0.0) -> Callable[[int], Pair]:
    """Return halves of a real cloud, undeformed or with a cubic bend of this RMS in its unit."""

    def make(seed: int) -> Pair:
        cloud = read_cloud(data_folder(folder) / file, on_warning=lambda _: None)
        rng = np.random.default_rng(seed)
        points = cloud.points
        is_used = points.any(axis=1)  # scanners write (0, 0, 0) for missing returns
        if ground:
            is_used &= cloud.attributes["classification"] == 2
        is_in_first = rng.random(len(points)) < 0.5
        classes = {key: values for key, values in cloud.attributes.items() if key == "classification"}

        def take_half(is_in_half: np.ndarray, candidate_points: Points) -> Cloud:
            return Cloud(
                candidate_points[is_in_half],
                unit=cloud.unit,
                crs=cloud.crs,
                attributes={key: values[is_in_half] for key, values in classes.items()},
            )

        candidate_points, field = points, None
        if bend:
            centre, half_size = points.mean(axis=0), 0.5 * np.ptp(points[:, :2], axis=0).max()

            def field(places: Points) -> Points:
                x, y = ((places - centre) / half_size)[:, :2].T
                shape = x**3 - 1.5 * x * y**2 + 0.5 * x * y
                return bend * np.stack([0 * x, 0 * x, shape / 0.45], axis=1)

            candidate_points = points + field(points)
        return Pair(
            take_half(is_in_first & is_used, points), take_half(~is_in_first & is_used, candidate_points), field
        )

    return make


def bent_city(kind: str, times: float, ratio: float = 50) -> Callable[[int], Pair]:
    """Return the city and a candidate bent by `times` the noise (RMS length over the surface)."""
    fields = {
        "dome": lambda x, y, z: (0 * x, 0 * x, -(x**2 + y**2)),
        "saddle": lambda x, y, z: (0 * x, 0 * x, x**2 - y**2),
        "twist": lambda x, y, z: (-y * x, x * x, 0 * x),
        "cubic": lambda x, y, z: (0 * x, 0 * x, x**3 - x * y**2),
        "height shear": lambda x, y, z: (z * z, 0 * x, 0 * x),
    }

    def make(seed: int) -> Pair:
        rng = np.random.default_rng(seed)
        reference = city_points(120_000, rng, seed % 5) + rng.normal(0, 0.01, (120_000, 3))
        surface = city_points(40_000, rng, seed % 5)
        scale = times * SIGMA * np.sqrt(2)

        def unit_displacements(places: Points) -> Points:
            x, y = (places[:, :2] / (SIZE / 2)).T
            return np.stack(fields[kind](x, y, places[:, 2] / 20), axis=1)

        amplitude = scale / float(np.sqrt(np.mean(np.square(unit_displacements(surface)).sum(axis=1))))
        return Pair(
            metric_cloud(reference),
            metric_cloud(add_noise(surface + amplitude * unit_displacements(surface), rng, SIZE / ratio)),
            lambda places: amplitude * unit_displacements(places),
        )

    return make


def subsidence(depth: float) -> Callable[[int], Pair]:
    """Return the city with 5 % of its area lowered."""

    def make(seed: int) -> Pair:
        rng = np.random.default_rng(seed)
        pair = null_city(40_000, 50)(seed)
        centre = rng.uniform(-100, 100, 2)
        points = pair.candidate.points.copy()
        points[np.hypot(*(points[:, :2] - centre).T) < SIZE * np.sqrt(0.05 / np.pi), 2] -= depth
        return Pair(pair.reference, metric_cloud(points))

    return make


def moved_block(shift: tuple[float, float, float]) -> Callable[[int], Pair]:
    """Return the city with one block of buildings moved."""

    def make(seed: int) -> Pair:
        rng = np.random.default_rng(seed)
        pair = null_city(40_000, 50)(seed)
        points = pair.candidate.points.copy()
        lower = 50.0 * rng.integers(-3, 3, 2) + 5
        is_in_block = ((points[:, :2] > lower) & (points[:, :2] < lower + 40)).all(axis=1) & (points[:, 2] > 4)
        points[is_in_block] += shift
        return Pair(pair.reference, metric_cloud(points))

    return make


def offset_strips(offset: float) -> Callable[[int], Pair]:
    """Return two strips of a flight with an offset between them."""

    def make(seed: int) -> Pair:
        rng = np.random.default_rng(seed)
        pair = null_city(40_000, 50)(seed)
        points = pair.candidate.points.copy()
        points[points[:, 0] > rng.uniform(-60, 60)] += offset * np.array([0.5, 0.3, 1.0])
        return Pair(pair.reference, metric_cloud(points))

    return make


def turned_city(degrees: float) -> Callable[[int], Pair]:
    def make(seed: int) -> Pair:
        pair = null_city(40_000, 50)(seed)
        c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
        rotation = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        return Pair(pair.reference, metric_cloud(pair.candidate.points @ rotation.T))

    return make


def true_rms(pair: Pair) -> tuple[float, float]:
    """Return the RMS of a pair's known bend along the normals, beyond an affine field.

    The first value is over the pairs with their weights, the second over the surface by its area.
    """
    assert pair.bend is not None
    origin = local_origin(pair.reference)
    registration = register(pair.reference, pair.candidate)
    registered_points = registration.T_local.apply(pair.candidate.points - origin)
    sides = [
        Side(Surface(Index(points)), np.ones(len(points), dtype=bool), cloud)
        for points, cloud in ((pair.reference.points - origin, pair.reference), (registered_points, pair.candidate))
    ]
    search = PairSearch.of(*sides)
    assert search is not None
    pairs = search.find(follow=True)
    assert pairs is not None
    nearest = sides[1].surface.index.query(pairs.places).indices.reshape(-1)
    along_normals = (pair.bend(pair.candidate.points[nearest]) * pairs.normals).sum(axis=1)
    affine = np.hstack([np.ones((len(along_normals), 1)), pairs.places / np.abs(pairs.places).max()])
    columns = (pairs.normals[:, :, None] * affine[:, None]).reshape(len(along_normals), -1)

    def rms_beyond_affine(weights: np.ndarray) -> float:
        root = np.sqrt(weights)
        residual = (
            along_normals - columns @ np.linalg.lstsq(columns * root[:, None], along_normals * root, rcond=None)[0]
        )
        return float(np.sqrt(np.average(np.square(residual), weights=weights)))

    return rms_beyond_affine(pairs.weights), rms_beyond_affine(pairs.areas)


NULLS: dict[str, Callable[[int], Pair]] = {
    "city, L/100": null_city(40_000, 100),
    "city, L/50": null_city(40_000, 50),
    "city, L/25": null_city(40_000, 25),
    "city, L/50 exp": null_city(40_000, 50, "exp"),
    "city sparse, white": null_sparse,
    "city, L/10": null_city(40_000, 10),
    "city dense, L/50": null_city(200_000, 50),
    "city uneven, L/50": null_city(40_000, 50, uneven=4),
    "terrain, L/100": null_terrain(100),
    "terrain, L/50": null_terrain(50),
    "terrain uneven, L/50": null_terrain(50, uneven=4),
    "forest": null_forest(40_000),
    "conifer halves": cloud_halves("wild", "MixedConifer.laz"),
    "topography halves": cloud_halves("wild", "Topography.laz"),
    "conifer ground": cloud_halves("wild", "MixedConifer.laz", ground=True),
    "topography ground": cloud_halves("wild", "Topography.laz", ground=True),
    "autzen halves": cloud_halves("autzen", "autzen_trim.las"),
    "street scan halves": cloud_halves("small_gicp", "target.ply"),
    "vehicle scan halves": cloud_halves("scans", "vehicle0.xyz"),
    "terrestrial scan halves": cloud_halves("scans", "webots1.xyz"),
}
BENDS: dict[str, Callable[[int], Pair]] = {
    **{
        f"{kind} {times}": bent_city(kind, times)
        for kind in ("dome", "saddle", "twist", "cubic", "height shear")
        for times in (0.5, 1.0, 2.0)
    },
    "conifer bent 0.7": cloud_halves("wild", "MixedConifer.laz", bend=0.7),
    "topography bent 0.7": cloud_halves("wild", "Topography.laz", bend=0.7),
    "autzen bent 1": cloud_halves("autzen", "autzen_trim.las", bend=1.0),
}
PARTS: dict[str, Callable[[int], Pair]] = {
    "subsidence 0.3": subsidence(0.3),
    "subsidence 1": subsidence(1.0),
    "house 0.5": moved_block((0.5, 0.3, 0.0)),
    "strips 0.1": offset_strips(0.1),
    "strips 0.5": offset_strips(0.5),
}
