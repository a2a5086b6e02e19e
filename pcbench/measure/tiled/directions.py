"""Distances of the points of one tile to the other cloud, and their sums for the metrics."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.regions import Region
from pcbench.measure.intervals import CorrelationGrid
from pcbench.measure.metrics import plane_distances
from pcbench.measure.tiled.columns import column_file, save_column
from pcbench.measure.tiled.overview import PixelGrid, PixelSums
from pcbench.measure.tiled.search import nearest_in_tiles
from pcbench.measure.tiled.sums import GroupSums
from pcbench.measure.tiled.tiles import TiledCloud
from pcbench.measure.tiled.totals import DirectionTotals
from pcbench.tasks.results import read_shared

DISTANCE, PLANE_DISTANCE, MEASURED = "distance", "plane_distance", "measured"
_MERGED_AT_ONCE = 32  # tiles whose sums are in memory


@dataclass(frozen=True, eq=False)
class TiledPair:
    """A reference and an aligned candidate in tiles, with all that the tasks of a candidate have in common.

    Attributes:
        reference: tiles of the reference, with normals.
        candidate: tiles of the aligned candidate.
        forth: folder for the distances of the candidate's points.
        back: folder for the distances of the reference's points.
        grid: correlation cells of the intervals.
        voxel, corner: side and origin (3,) of the voxels of area weighting.
        thresholds: distance thresholds of the F-score.
        max_distance: length beyond which no closest point is searched.
        overlap_distance: distance within which a point lies on the other cloud.
        pixels: grid of the overview; None: none is made.
    """

    reference: TiledCloud
    candidate: TiledCloud
    forth: Path
    back: Path
    grid: CorrelationGrid
    voxel: float
    corner: FloatArray
    thresholds: tuple[float, ...]
    max_distance: float
    overlap_distance: float
    pixels: PixelGrid | None


class DistanceSums(NamedTuple):
    """Sums over the distances of one tile or of several.

    Attributes:
        totals: counts and sums for the metrics.
        near: sums over the points within the overlap distance of squared distances to planes, as `square`.
        pixels: sums per pixel of the overview, if one is made.
    """

    totals: DirectionTotals
    near: GroupSums
    pixels: PixelSums | None

    @classmethod
    def merge(cls, parts: Iterable[DistanceSums]) -> DistanceSums:
        """Return the sums over all tiles of one or several parts, which are merged some at a time to limit memory."""
        merged: list[DistanceSums] = []
        for part in parts:
            merged.append(part)
            if len(merged) == _MERGED_AT_ONCE:
                merged = [_merge(merged)]
        return _merge(merged)


@dataclass(frozen=True, eq=False)
class MeasuredDirection:
    """The measured distances of one direction.

    Attributes:
        stage: start of the names of its stages.
        queries: tiles of the points from which distances were measured.
        folder: folder of the distances.
        sums: sums over all of them.
    """

    stage: str
    queries: TiledCloud
    folder: Path
    sums: DistanceSums

    def files(self, column: str) -> list[Path]:
        """Return the files of a column of the distances, such as `DISTANCE`, of all tiles with points."""
        return [column_file(self.folder, number, column) for number in self.queries.occupied]


def _merge(parts: Sequence[DistanceSums]) -> DistanceSums:
    pixels = [part.pixels for part in parts if part.pixels is not None]
    return DistanceSums(
        DirectionTotals.merge([part.totals for part in parts]),
        GroupSums.merge([part.near for part in parts]),
        PixelSums.merge(pixels) if pixels else None,
    )


def measure_candidate_tile(file: Path, key: str, number: int, region: Region | None) -> DistanceSums:
    """Measure and store the distances of the points of a tile of the candidate to the reference.

    Args:
        file: the shared `TiledPair`.
        key: identifies its content.
        number: number of the tile.
        region: measured region in local coordinates; None: everything.
    """
    pair = read_shared(file, key, TiledPair)
    points, rows, inside = _queries(pair.candidate, number, region)
    matches = nearest_in_tiles(points, pair.reference, 1, pair.max_distance)
    closest = matches.column(pair.reference, "points")[:, 0]
    planes = plane_distances(points, closest, matches.column(pair.reference, pair.reference.normals)[:, 0])
    # Intervals count a distance where the reference is.
    cells = pair.grid.cells_of(np.where(np.isnan(closest), points, closest))
    return _store(pair, pair.forth, number, inside, _Distances(points, rows, cells, matches.distances[:, 0], planes))


def measure_reference_tile(file: Path, key: str, number: int, region: Region | None) -> DistanceSums:
    """Measure and store the distances of the points of a tile of the reference to the candidate.

    Arguments are as for `measure_candidate_tile`.
    """
    pair = read_shared(file, key, TiledPair)
    points, rows, inside = _queries(pair.reference, number, region)
    matches = nearest_in_tiles(points, pair.candidate, 1, pair.max_distance)
    closest = matches.column(pair.candidate, "points")[:, 0]
    normals = pair.reference.load(number, pair.reference.normals)
    planes = plane_distances(points, closest, normals if inside is None else normals[inside])
    cells = pair.grid.cells_of(points)
    return _store(pair, pair.back, number, inside, _Distances(points, rows, cells, matches.distances[:, 0], planes))


class _Distances(NamedTuple):
    """The queries of a tile and their distances."""

    points: FloatArray  # (n, 3)
    rows: IntArray  # (n,)
    cells: IntArray  # (n,) correlation cells
    to_points: FloatArray  # (n,)
    to_planes: FloatArray  # (n,)


def _queries(cloud: TiledCloud, number: int, region: Region | None) -> tuple[FloatArray, IntArray, IntArray | None]:
    """Return the points of a tile inside the region, their rows, and their positions in the tile; None: all."""
    points, rows = cloud.load(number, "points"), cloud.load(number, "rows")
    if region is None:
        return points, rows, None
    inside = np.flatnonzero(region.contains(points))
    return points[inside], rows[inside], inside


def _store(pair: TiledPair, folder: Path, number: int, inside: IntArray | None, found: _Distances) -> DistanceSums:
    """Store the distances of a tile and add them up."""
    save_column(folder, number, DISTANCE, found.to_points)
    save_column(folder, number, PLANE_DISTANCE, found.to_planes)
    if inside is not None:
        save_column(folder, number, MEASURED, inside)
    is_censored = np.isnan(found.to_planes) if pair.max_distance < np.inf else np.zeros(len(found.rows), bool)
    found = found._replace(to_planes=np.where(is_censored, 0.0, found.to_planes))
    totals = DirectionTotals.of(
        *found,
        thresholds=pair.thresholds,
        voxel=pair.voxel,
        corner=pair.corner,
        is_censored=is_censored,
    )
    is_near = (found.to_points <= pair.overlap_distance) & ~is_censored
    near = GroupSums.of(None, {"square": np.square(found.to_planes[is_near])})
    pixels = None if pair.pixels is None else PixelSums.of(pair.pixels, found.points, found.to_points)
    return DistanceSums(totals, near, pixels)
