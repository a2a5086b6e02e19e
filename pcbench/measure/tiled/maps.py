"""Deviation maps of clouds on disk: all points as LAZ tiles, and a sample for pages and pictures."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.io.map_tiles import write_map_tile
from pcbench.measure.deviation import DeviationMap, Spread
from pcbench.measure.tiled.columns import column_file, load_column
from pcbench.measure.tiled.directions import DISTANCE, MEASURED, PLANE_DISTANCE
from pcbench.tasks.files import record_file

MAP_SAMPLE = 300_000
"""Points of the map that a report shows, besides the largest deviations."""
LARGEST_SHARE = 1e-4
"""Share of the points with the largest deviations, all of which are shown, up to `MAP_SAMPLE`."""


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
    found = _map_points(tiles, folder, number)
    kept = np.flatnonzero((found.rows % step == 0) | (found.distances >= least))
    return MapPoints(found.points[kept], found.rows[kept], found.distances[kept], found.plane_distances[kept])


def write_tile_of_map(tiles: Path, folder: Path, number: int, origin: FloatArray, crs: str | None, path: Path) -> bool:
    """Write all points of a tile of a map; see `pcbench.io.map_tiles.write_map_tile`. Return whether there are any."""
    found = _map_points(tiles, folder, number)
    if not len(found.points):
        return False
    write_map_tile(path, found.points + origin, found.distances, found.plane_distances, crs=crs)
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
    found = list(parts)
    rows = np.concatenate([part.rows for part in found])
    order = np.argsort(rows, kind="stable")
    scalars = {DISTANCE: np.concatenate([part.distances for part in found])[order]}
    if with_planes:
        scalars[PLANE_DISTANCE] = np.concatenate([part.plane_distances for part in found])[order]
    is_sample = len(rows) < count
    return DeviationMap(
        np.concatenate([part.points for part in found])[order] + origin,
        rows[order],
        scalars,
        sampled_from=count if is_sample else None,
        known_spreads={name: spread for name, spread in spreads.items() if name in scalars},
        sample_step=step if is_sample else None,
    )
