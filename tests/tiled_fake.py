"""A comparison in tiles as its outputs see it: computed in memory, with maps that are samples, and files of maps."""

import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np

from pcbench import read_cloud
from pcbench.io import map_tiles
from pcbench.io.pieces import CloudFile, CloudOnDisk
from pcbench.measure import comparison
from pcbench.measure.results import CANDIDATE_TO_REFERENCE, LeftOut, Tiling

SAMPLE = 400  # points of a map


def compare_on_disk(reference, candidates, settings, tiling, *, workspace, maps, on_step):
    """Compare in memory, and return the result as `pcbench.measure.tiled.compare.compare_on_disk` does."""
    on_step("sorting the reference")
    (workspace / "sorted.bin").write_bytes(b"sorted")
    clouds = {name: joined(path) for name, path in candidates.items()}
    full = comparison.compare(joined(reference), clouds, settings)
    for candidate in full if maps is not None else ():
        write_maps(maps, candidate, full.reference.crs)
    return as_tiled(full, tiling, sample=SAMPLE)


def as_tiled(full, tiling, sample, left_out=(), censored=None):
    """Return a comparison as if it were computed in tiles: its maps are samples of the measured points."""
    tiles = Tiling(
        tiling.tile_points or 1000, 7, sample, tiling.max_distance, tuple(LeftOut(*file) for file in left_out)
    )
    shares = censored or {}
    candidates = tuple(
        replace(
            candidate,
            deviation=sampled(candidate.deviation, sample),
            completeness=sampled(candidate.completeness, sample),
            censored=shares,
            metrics=replace(candidate.metrics, presets=without_mpeg(candidate.metrics.presets)),
        )
        for candidate in full
    )
    return replace(full, candidates=candidates, tiling=tiles)


def without_mpeg(presets):
    return {name: preset for name, preset in presets.items() if name != "mpeg"}


def sampled(map_, count):
    rows = np.sort(np.random.default_rng(0).permutation(len(map_.points))[:count])
    scalars = {name: values[rows] for name, values in map_.scalars.items()}
    return replace(
        map_,
        points=map_.points[rows],
        rows=map_.rows[rows],
        scalars=scalars,
        sampled_from=len(map_.points),
        known_spreads=map_.spreads,
    )


def write_maps(maps, candidate, crs):
    """Write all points of a candidate's map as two tiles, and an overview."""
    deviation = candidate.deviation
    folder = maps / f"{candidate.name}_deviation"
    folder.mkdir(parents=True, exist_ok=True)
    for k in (0, 1):
        part = {name: values[k::2] for name, values in deviation.scalars.items()}
        path = folder / f"tile_{k:04}{map_tiles.map_tile_extension()}"
        map_tiles.write_map_tile(path, deviation.points[k::2], part["distance"], part.get("plane_distance"), crs=crs)
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
    total = np.bincount(at, map_.scalars["distance"], minlength=rows * (columns + 1)).reshape(shape)
    with np.errstate(invalid="ignore"):
        mean = total / count
    return map_tiles.MapOverview(mean, np.where(count > 0, largest, np.nan), count, low[0], high[1], pixel)


def files_of(path):
    path = Path(path)
    if path.is_dir():
        return sorted(path.iterdir())
    return sorted(path.parent.glob(path.name))


def joined(path):
    """Read all files of a path as one cloud."""
    clouds = [read_cloud(file, on_warning=lambda _: None) for file in files_of(path)]
    first = clouds[0]
    if len(clouds) == 1:
        return first
    return replace(first, points=np.concatenate([c.points for c in clouds]), normals=None, colors=None, attributes={})


def open_cloud(path, *, classes=None, returns=None, piece_points=0, skip_bad=False):
    """Describe a cloud on disk by reading it."""
    found = files_of(path)
    counts = {file: len(read_cloud(file, on_warning=lambda _: None)) for file in found}
    files = tuple(CloudFile(file, count, nbytes_in_memory=24 * count) for file, count in counts.items())
    return CloudOnDisk(Path(path), files, (), warnings=(f"{path}: a warning of the header",))


def install(monkeypatch, compare=compare_on_disk):
    """Replace the computation in tiles, and what reads the headers, by the fakes."""
    from pcbench.report import on_disk, reading

    module = ModuleType("pcbench.measure.tiled.compare")
    module.compare_on_disk = compare
    monkeypatch.setitem(sys.modules, module.__name__, module)
    for room in (on_disk, reading):
        monkeypatch.setattr(room, "open_cloud", open_cloud)
    monkeypatch.setattr(on_disk, "is_in_pieces", lambda path: Path(path).is_dir() or "*" in str(path))


__all__ = ["CANDIDATE_TO_REFERENCE", "as_tiled", "compare_on_disk", "install"]
