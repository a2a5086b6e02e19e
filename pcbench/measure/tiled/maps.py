"""Deviation maps of clouds on disk: all points as LAZ tiles, and a sample for pages and pictures."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.io.map_tiles import map_tile_extension, write_map_tile, write_overview, write_tile_index
from pcbench.measure.deviation import DeviationMap, Spread
from pcbench.measure.tiled.columns import column_file, load_column
from pcbench.measure.tiled.directions import DISTANCE, MEASURED, PLANE_DISTANCE, MeasuredDirection
from pcbench.measure.tiled.steps import Steps, tile_tasks
from pcbench.tasks.files import record_file

MAP_SAMPLE = 300_000
"""Points of the map that a report shows, besides the largest deviations."""
LARGEST_SHARE = 1e-4
"""Share of the points with the largest deviations, all of which are shown, up to `MAP_SAMPLE`."""

_SIGNS = {"distance": 1, "completeness": -1}  # a point of the reference below the candidate has a negative distance


class MapPoints(NamedTuple):
    """Points of a map: (N, 3) in local coordinates, their rows (N,), and their distances (N,) to points and planes."""

    points: FloatArray
    rows: IntArray
    distances: FloatArray
    plane_distances: FloatArray


def sample_map(tiles: Path, folder: Path, number: int, step: int, least: float) -> MapPoints:
    """Return the points of a tile of a map whose rows are multiples of a step, and those with large distances.

    Args:
        tiles: folder of the tiles of the points.
        folder: folder of their distances.
        number: number of the tile.
        step: interval of the rows.
        least: smallest distance of points that are kept whatever their rows.
    """
    points = _map_points(tiles, folder, number)
    kept = np.flatnonzero((points.rows % step == 0) | (points.distances >= least))
    return MapPoints(points.points[kept], points.rows[kept], points.distances[kept], points.plane_distances[kept])


def write_tile_of_map(
    tiles: Path, folder: Path, number: int, sign: int, origin: FloatArray, crs: str | None, path: Path
) -> bool:
    """Write all points of a tile of a map; see `pcbench.io.map_tiles.write_map_tile`. Return whether there are any."""
    points = _map_points(tiles, folder, number)
    if not len(points.points):
        return False
    write_map_tile(path, points.points + origin, points.distances, sign * points.plane_distances, crs=crs)
    record_file(path)
    return True


def _map_points(tiles: Path, folder: Path, number: int) -> MapPoints:
    points, rows = load_column(tiles, number, "points"), load_column(tiles, number, "rows")
    if column_file(folder, number, MEASURED).exists():
        inside = load_column(folder, number, MEASURED)
        points, rows = points[inside], rows[inside]
    return MapPoints(points, rows, load_column(folder, number, DISTANCE), load_column(folder, number, PLANE_DISTANCE))


def deviation_map(
    parts: Iterable[MapPoints],
    count: int,
    step: int,
    spreads: Mapping[str, Spread],
    origin: FloatArray,
    *,
    with_planes: bool,
) -> DeviationMap:
    """Return a map from the sampled points of its tiles, in the order of their rows.

    Args:
        parts: sampled points.
        count: number of points that were measured.
        step: interval of the rows of the even sample, as in `sample_map`.
        spreads: summary statistics of all of them.
        origin: (3,) offset that was subtracted from all coordinates.
        with_planes: whether the map has distances to planes.
    """
    sampled = list(parts)
    rows = np.concatenate([part.rows for part in sampled])
    order = np.argsort(rows, kind="stable")
    scalars = {DISTANCE: np.concatenate([part.distances for part in sampled])[order]}
    if with_planes:
        scalars[PLANE_DISTANCE] = np.concatenate([part.plane_distances for part in sampled])[order]
    is_sample = len(rows) < count
    return DeviationMap(
        np.concatenate([part.points for part in sampled])[order] + origin,
        rows[order],
        scalars,
        sampled_from=count if is_sample else None,
        known_spreads={name: spread for name, spread in spreads.items() if name in scalars},
        sample_step=step if is_sample else None,
    )


def show_direction(
    steps: Steps,
    direction: MeasuredDirection,
    spreads: Mapping[str, Spread],
    origin: FloatArray,
    *,
    with_planes: bool,
) -> DeviationMap:
    """Return a map of sampled points, for pages and pictures."""
    distances, tiles = direction.sums.totals.distances, direction.queries
    step = -(-distances.count // MAP_SAMPLE)
    share_shown = min(LARGEST_SHARE, MAP_SAMPLE / distances.count)
    least = distances.histogram.approximate_percentile(100 * (1 - share_shown)) if step > 1 else 0.0
    tasks = tile_tasks(tiles, lambda number: (tiles.folder, direction.folder, number, step, least))
    parts = steps.results(f"{direction.stage}-map", sample_map, tasks, "sampling the map")
    return deviation_map(parts, distances.count, step, spreads, origin, with_planes=with_planes)


def write_direction(
    steps: Steps,
    direction: MeasuredDirection,
    maps: Path,
    name: str,
    kind: str,
    *,
    origin: FloatArray,
    crs: str | None,
    unit: str | None,
) -> None:
    """Write a map of all points, its index and its overview.

    Args:
        steps: the steps of the comparison.
        direction: its distances.
        maps: folder of all maps, which exists.
        name: name of the candidate.
        kind: kind of the map, see `pcbench.io.map_tiles.write_overview`.
        origin: (3,) offset that was subtracted from all coordinates.
        crs: coordinate system of the points, if known.
        unit: unit of lengths, if known.
    """
    folder, tiles = maps / f"{name}_{kind}", direction.queries
    folder.mkdir(exist_ok=True)

    def arguments(number: int) -> tuple[Any, ...]:
        path = folder / f"tile_{number:04d}{map_tile_extension()}"
        return tiles.folder, direction.folder, number, _SIGNS[kind], origin, crs, path

    tasks = tile_tasks(tiles, arguments)
    steps.results(f"{direction.stage}-files", write_tile_of_map, tasks, f"{name}: writing maps")
    write_tile_index(folder, crs)
    if (local := direction.overview) is not None:
        overview = replace(local, west=local.west + float(origin[0]), north=local.north + float(origin[1]))
        write_overview(maps, name, overview, kind=kind, crs=crs, unit=unit)
