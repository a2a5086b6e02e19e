"""Scenes for the search for changes: two disjoint samples of the same surface each, at their true pose."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cache, partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from data_folder import data_root
from deformation_cases import correlated_noise, forest_points, terrain_points
from scipy.spatial import cKDTree
from stereo_cases import PAIRS, match_pair, read_pair

from pcbench import read_cloud
from pcbench.errors import InputError
from pcbench.scenes.synthetic import city

MAX_POINTS = 30_000  # of each cloud
NEIGHBOURS = 16  # of the local planes that give a cloud's roughness
POINT_FILES = {".las", ".laz", ".ply", ".pcd", ".xyz", ".csv", ".e57", ".bin", ".txt", ".npy"}
# In the data folder; the vertical of the first ones is z.
SCANS = (
    "halves/car400.csv",
    "halves/kitti3.bin",
    "halves/samp11.pcd",
    "halves/samp22.pcd",
    "halves/samp42.pcd",
    "halves/hexbin.las",
    "halves/spTLS.laz",
    "halves/spruce.laz",
    "halves/mvk.las",
    "scans/webots1.xyz",
    "scans/vehicle0.xyz",
    "small_gicp/source.ply",
    "small_gicp/target.ply",
    "wild/MixedConifer.laz",
    "wild/Topography.laz",
    "autzen/autzen_trim.las",
    "copc/lone-star.copc.laz",
)
OBJECTS = ("halves/mug.pcd", "halves/rgt.pcd", "halves/mincut.pcd", "e57/bunnyInt32.e57")
Points = np.ndarray


class Sample(NamedTuple):
    """Two disjoint samples of a surface, (N, 3) and (M, 3), with the standard deviation of their noise."""

    reference: Points
    candidate: Points
    noise: float


class Scene(NamedTuple):
    """A scene.

    Args:
        name: its name.
        group: its kind, for tables.
        make: function of a seed that returns a sample.
        is_upright: whether z is the vertical.
    """

    name: str
    group: str
    make: Callable[[int], Sample]
    is_upright: bool = True


def extent(points: Points) -> float:
    """Return the side of the cube that holds the middle 98 % of points (N, 3)."""
    low, high = np.percentile(points, [1, 99], axis=0)
    return float((high - low).max())


def roughness(points: Points, count: int = 2_000) -> float:
    """Return the median distance of points (N, 3) from the planes through their neighbours, as a standard deviation."""
    rows = np.random.default_rng(0).permutation(len(points))[:count]
    _, near = cKDTree(points).query(points[rows], NEIGHBOURS)
    patches = points[near] - points[near].mean(axis=1, keepdims=True)
    smallest = np.linalg.eigvalsh(np.einsum("nki,nkj->nij", patches, patches))[:, 0]
    return float(np.median(np.sqrt(np.maximum(smallest, 0) / (NEIGHBOURS - 3))))


def scenes(scan_folders: list[Path], cloud_folders: list[Path]) -> Iterator[Scene]:
    """Yield all scenes whose data are there.

    Args:
        scan_folders: folders of further scans, with vertical z unless their name ends in `objects`.
        cloud_folders: folders of reconstructed cities: `city` of `pcbench synth city`, and `cloud.ply`.
    """
    root = data_root()
    files = [] if root is None else [(root / file, file in SCANS) for file in (*SCANS, *OBJECTS)]
    for folder in scan_folders:
        found = sorted(file for file in folder.rglob("*") if file.suffix.lower() in POINT_FILES and readable(file))
        files += [(path, not folder.name.endswith("objects")) for path in found]
    for path, is_upright in files:
        yield Scene(path.stem, "scans" if is_upright else "objects", partial(halves, path), is_upright)
    if root is not None:
        for name in PAIRS:
            yield Scene(f"stereo {name}", "dense stereo", partial(stereo_halves, root / "stereo" / name), False)
    for folder in cloud_folders:
        yield Scene(f"mvs {folder.name}", "dense stereo", partial(halves, folder / "cloud.ply"))
        yield Scene(f"mvs {folder.name} to truth", "stereo to truth", partial(against_truth, folder))
    for name, make in GENERATED.items():
        yield Scene(name, "generated", make)


def halves(path: Path, seed: int) -> Sample:
    """Return disjoint random halves of a cloud; every second seed adds noise of half its roughness."""
    return _halves(_points(path), seed)


def stereo_halves(folder: Path, seed: int) -> Sample:
    """Return disjoint random halves of the cloud that the bundled matcher makes of two photographs."""
    return _halves(_stereo_points(folder), seed)


def against_truth(folder: Path, seed: int) -> Sample:
    """Return the true surface of a city, hidden parts included, and a random part of its reconstructed cloud."""
    rng = np.random.default_rng([seed, 22])
    truth, cloud = _points(folder / "city/truth/cloud.ply"), _points(folder / "cloud.ply")
    candidate = _some(cloud, rng)
    return Sample(_some(truth, rng), candidate, roughness(candidate))


def generated(surface: Callable[[int, np.random.Generator, int], Points], sigma: float, length: float, seed: int):
    """Return two samples of a surface with white noise, and with correlated noise of the same size if it has a length.

    Args:
        surface: function of number of points, generator and seed that returns points.
        sigma: standard deviation of the noise.
        length: correlation length; 0 for white noise alone.
        seed: seed of the scene and its samples.
    """
    rng = np.random.default_rng([seed, 23])
    clouds = [surface(MAX_POINTS, rng, seed) for _ in range(2)]
    noise = [rng.normal(0, sigma, cloud.shape) for cloud in clouds]
    if length:
        noise[1] += sigma * correlated_noise(clouds[1], length, rng)
    return Sample(clouds[0] + noise[0], clouds[1] + noise[1], sigma)


def parked_cars(count: int, rng: np.random.Generator, seed: int) -> Points:
    """Return points of rolling ground with cars, bushes and trees that stand apart."""
    shape = np.random.default_rng([seed, 24])
    ground = terrain_points(count, rng, seed)
    ground[:, :2] /= 4  # 100 m
    ground[:, 2] /= 8
    sites = np.stack(np.meshgrid(*[np.linspace(-42, 42, 8)] * 2), axis=-1).reshape(-1, 2)
    sites = (sites + shape.uniform(-2, 2, sites.shape))[shape.permutation(64)[:40]]
    tree = cKDTree(ground[:, :2])
    for number, site in enumerate(sites):
        size = ((4.2, 1.8, 1.5), (2.0, 2.0, 1.6), (5.0, 5.0, 9.0))[number % 3] * shape.uniform(0.8, 1.2, 3)
        angle = shape.uniform(0, np.pi)
        across = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        bottom = ground[tree.query(site)[1], 2]
        inside = (np.abs((ground[:, :2] - site) @ across.T) < size[:2] / 2).all(axis=1)
        directions = rng.normal(size=(max(40, int(2.5 * inside.sum())), 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        if number % 3 == 2:  # a crown
            directions *= rng.random((len(directions), 1)) ** 0.25
        body = directions * size / 2
        body[:, :2] = body[:, :2] @ across
        ground = np.concatenate([ground[~inside], body + [*site, bottom + size[2] / 2]])
        tree = cKDTree(ground[:, :2])
    return ground


GENERATED: dict[str, Callable[[int], Sample]] = {
    "city": partial(generated, lambda count, rng, seed: city(seed % 5).sample(count, rng)[0], 0.05, 0.0),
    "correlated city": partial(generated, lambda count, rng, seed: city(seed % 5).sample(count, rng)[0], 0.05, 8.0),
    "terrain": partial(generated, terrain_points, 0.05, 0.0),
    "correlated terrain": partial(generated, terrain_points, 0.05, 8.0),
    "forest": partial(generated, forest_points, 0.02, 0.0),
    "parked cars": partial(generated, parked_cars, 0.02, 0.0),
}


@cache
def _points(path: Path) -> Points:
    if path.suffix == ".bin":  # x, y, z, intensity
        points = np.fromfile(path, np.float32).reshape(-1, 4)[:, :3].astype(np.float64)
    else:
        points = read_cloud(path, on_warning=lambda _: None).points
    points = np.unique(points[points.any(axis=1)], axis=0)  # scanners write (0, 0, 0) for missing returns
    return points - np.median(points, axis=0)


@cache
def _stereo_points(folder: Path) -> Points:
    pair = read_pair(folder)
    disparity = match_pair(pair)
    row, column = np.nonzero(np.isfinite(disparity))
    k, baseline = pair.left.camera.intrinsics, pair.right.camera.position[0] - pair.left.camera.position[0]
    depth = k.fx * baseline / (disparity[row, column] + pair.offset)
    rays = np.column_stack([(column + 0.5 - k.cx) / k.fx, (row + 0.5 - k.cy) / k.fy, np.ones(len(row))])
    points: Points = rays * depth[:, None]
    return points


def _halves(points: Points, seed: int) -> Sample:
    rng = np.random.default_rng([seed, 21])
    rows = rng.permutation(len(points))[: 2 * MAX_POINTS]
    first, second = points[rows[: len(rows) // 2]], points[rows[len(rows) // 2 :]]
    noise = roughness(points)
    if seed % 2:
        first, second = (half + rng.normal(0, noise / 2, half.shape) for half in (first, second))
        noise *= np.hypot(1, 0.5)
    return Sample(first, second, float(noise))


def _some(points: Points, rng: np.random.Generator) -> Points:
    return points[rng.permutation(len(points))[:MAX_POINTS]]


def readable(path: Path) -> bool:
    """Return whether a file holds a cloud with enough points for halves."""
    try:
        return len(_points(path)) >= 2_000
    except InputError:
        return False
