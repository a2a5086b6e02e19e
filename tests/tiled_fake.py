"""A comparison in tiles as its outputs see it: computed in memory, with maps that are samples, and files of maps."""

import sys
from dataclasses import replace
from types import ModuleType

import numpy as np

from pcbench import compare, read_cloud
from pcbench.io import map_tiles
from pcbench.measure.results import LeftOut, Tiling

STEP = 4  # of the sample in a map


def compare_in_tiles(clouds, settings, tiling, *, key, workspace, maps, on_step):
    """Compare in memory, and return the result as `pcbench.comparison.in_tiles.compare_in_tiles` does."""
    on_step("sorting the reference")
    (workspace / "sorted.bin").write_bytes(b"sorted")
    candidates = {name: joined(cloud.path) for name, cloud in clouds.candidates.items()}
    full = compare(joined(clouds.reference.path), candidates, settings)
    for candidate in full if maps is not None else ():
        write_maps(maps, candidate, full.reference.crs)
    return as_tiled(full, tiling, step=STEP)


def as_tiled(full, tiling, step, left_out=(), censored=None):
    """Return a comparison as if it were computed in tiles: its maps are samples of the measured points."""
    tiles = Tiling(tiling.tile_points or 1000, 7, 1000, tiling.max_distance, tuple(LeftOut(*file) for file in left_out))
    shares = censored or {}
    candidates = tuple(
        replace(
            candidate,
            deviation=sampled(candidate.deviation, step),
            completeness=sampled(candidate.completeness, step),
            censored=shares,
            metrics=replace(candidate.metrics, presets=without_mpeg(candidate.metrics.presets)),
        )
        for candidate in full
    )
    return replace(full, candidates=candidates, tiling=tiles)


def without_mpeg(presets):
    return {name: preset for name, preset in presets.items() if name != "mpeg"}


def sampled(map_, step):
    """Return every n-th point of a map, and those that deviate most."""
    distances = map_.scalars["distance"]
    keep = map_.rows % step == 0
    keep[np.argsort(-distances)[: len(distances) // 20]] = True
    return replace(
        map_,
        points=map_.points[keep],
        rows=map_.rows[keep],
        scalars={name: values[keep] for name, values in map_.scalars.items()},
        sampled_from=len(map_.points),
        known_spreads=map_.spreads,
        sample_step=step,
    )


def write_maps(maps, candidate, crs):
    """Write all points of a candidate's map as two tiles, and an overview."""
    deviation = candidate.deviation
    folder = maps / f"{candidate.name}_distance"
    folder.mkdir(parents=True, exist_ok=True)
    for k in (0, 1):
        part = {name: values[k::2] for name, values in deviation.scalars.items()}
        path = folder / f"tile_{k:04}{map_tiles.map_tile_extension()}"
        map_tiles.write_map_tile(path, deviation.points[k::2], part["distance"], part.get("plane_distance"), crs=crs)
    map_tiles.write_tile_index(folder, crs)
    map_tiles.write_overview(maps, candidate.name, overview(deviation), crs=crs)
    map_tiles.write_overview(maps, candidate.name, overview(candidate.completeness), kind="completeness", crs=crs)


def overview(map_, columns=60):
    """Return the raster of a map."""
    low, high = map_.points.min(axis=0), map_.points.max(axis=0)
    pixel = (high - low)[0] / columns
    rows = int((high - low)[1] // pixel) + 1
    column = ((map_.points[:, 0] - low[0]) / pixel).astype(int)
    row = ((high[1] - map_.points[:, 1]) / pixel).astype(int)
    at = row * (columns + 1) + column
    shape = rows, columns + 1
    count = np.bincount(at, minlength=rows * (columns + 1))[: rows * (columns + 1)].reshape(shape)
    largest = np.full(shape, -np.inf)
    np.maximum.at(largest.reshape(-1), at, map_.scalars["distance"])
    planes = map_.scalars.get("plane_distance", np.full(len(at), np.nan))
    totals = [
        np.bincount(at, values, minlength=count.size).reshape(shape) for values in (planes, map_.scalars["distance"])
    ]
    with np.errstate(invalid="ignore"):
        signed, mean = np.divide(totals, count)
    return map_tiles.MapOverview(signed, mean, np.where(count > 0, largest, np.nan), count, low[0], high[1], pixel)


def joined(path):
    return read_cloud(path, on_warning=lambda _: None)


def install(monkeypatch, compute=compare_in_tiles):
    """Replace the computation in tiles by a function."""
    module = ModuleType("pcbench.comparison.in_tiles")
    module.compare_in_tiles = compute
    monkeypatch.setitem(sys.modules, module.__name__, module)
