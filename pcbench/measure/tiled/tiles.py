"""Tiles of a cloud: its points in compact boxes, in the coordinates in which everything is measured."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray, IntArray, bounds
from pcbench.geometry.neighbors import Index
from pcbench.geometry.normals import unit
from pcbench.geometry.regions import Region
from pcbench.geometry.transform import Similarity
from pcbench.measure.tiled.columns import column_file, load_column, map_column, save_column
from pcbench.measure.tiled.runs import CloudRuns

TREE = "tree"
"""Column of the search tree over the points."""
NORMALS = "normals"
"""Column of normals from as many neighbours as the settings say."""
GIVEN_NORMALS = "given_normals"
"""Column of the normals that were given with the cloud."""
CLASSES = "classes"
"""Column of LAS classes."""
WIDE_NORMALS = "wide_normals"
"""Column of normals from more neighbours, of points that have copies or lie in lines."""
VARIATIONS = {NORMALS: "variation", WIDE_NORMALS: "wide_variation"}
"""Columns of the surface variation, by those of the normals from the same neighbours."""


@dataclass(frozen=True, eq=False)
class TileSummary:
    """Number of points of a tile, and where they lie.

    Attributes:
        number: number of the tile.
        count: number of its points.
        low, high: corners (3,) of their box; zero if there are none.
        inside: number of points inside the region.
        lowest_inside: (3,) lowest coordinates of these points; infinite if there are none.
    """

    number: int
    count: int
    low: FloatArray
    high: FloatArray
    inside: int
    lowest_inside: FloatArray

    @classmethod
    def of(cls, number: int, points: FloatArray, inside: FloatArray) -> TileSummary:
        """Return the summary of a tile with points (N, 3), of which some (M, 3) are inside the region."""
        lowest = bounds(inside)[0] if len(inside) else np.full(3, np.inf)
        return cls(number, len(points), *bounds(points), len(inside), lowest)

    @classmethod
    def empty(cls, number: int) -> TileSummary:
        """Return the summary of a tile without points."""
        return cls(number, 0, np.zeros(3), np.zeros(3), 0, np.full(3, np.inf))


@dataclass(frozen=True)
class TiledCloud:
    """The tiles of a cloud, stored in a folder, one array per tile and column.

    Columns are `points` (N, 3), minus the local origin and aligned; `rows` (N,) in the cloud, ascending; the search
    `tree` over the points; and what later steps add, such as `normals` (N, 3).

    Attributes:
        folder: folder of the files.
        counts: (T,) number of points of each tile.
        low, high: (T, 3) corners of the box of each tile; without meaning where a tile is empty.
        normals: name of the column of the normals.
    """

    folder: Path
    counts: NDArray[np.int64]
    low: FloatArray
    high: FloatArray
    normals: str = NORMALS

    @classmethod
    def of(cls, folder: Path, summaries: Iterable[TileSummary]) -> TiledCloud:
        """Return the tiles with these contents, in their order."""
        tiles = list(summaries)
        counts = np.array([tile.count for tile in tiles], np.int64)
        return cls(folder, counts, np.array([tile.low for tile in tiles]), np.array([tile.high for tile in tiles]))

    def __len__(self) -> int:
        return len(self.counts)

    @property
    def count(self) -> int:
        """Number of points of all tiles."""
        return int(self.counts.sum())

    @property
    def corners(self) -> FloatArray:
        """Lowest and highest corner (2, 3) of all points."""
        occupied = self.occupied
        return np.stack([self.low[occupied].min(axis=0), self.high[occupied].max(axis=0)])

    @property
    def variation(self) -> str:
        """Name of the column of the surface variation, from the neighbours of the normals."""
        return VARIATIONS.get(self.normals, "")

    def has_column(self, name: str) -> bool:
        """Return whether all tiles with points have a column."""
        return all(self.file(number, name).exists() for number in self.occupied)

    @property
    def occupied(self) -> list[int]:
        """Numbers of the tiles with points."""
        return [int(number) for number in np.flatnonzero(self.counts)]

    def file(self, number: int, column: str) -> Path:
        """Return the file of a column of a tile."""
        return column_file(self.folder, number, column)

    def load(self, number: int, column: str) -> NDArray[Any]:
        """Return a column of a tile as an array in memory."""
        return load_column(self.folder, number, column)

    def open(self, number: int, column: str) -> NDArray[Any]:
        """Return a column of a tile as a memory map."""
        return map_column(self.file(number, column))

    def index(self, number: int) -> Index:
        """Return the index of the points of a tile, of which a search reads the part that it needs."""
        return Index.stored(self.open(number, "points"), self.open(number, TREE))


def save_points(folder: Path, number: int, points: FloatArray, rows: IntArray) -> None:
    """Store the points (N, 3) of a tile, their search tree and their rows (N,)."""
    save_column(folder, number, "points", points)
    save_column(folder, number, TREE, Index(points).tree)
    save_column(folder, number, "rows", rows)


def make_tile(
    runs: CloudRuns,
    number: int,
    code_range: tuple[int, int],
    origin: FloatArray,
    pose: Similarity | None,
    region: Region | None,
    folder: Path,
) -> TileSummary:
    """Store the points of a range of the Morton curve as a tile.

    Args:
        runs: the cloud.
        number: number of the tile.
        code_range: half-open range of codes.
        origin: (3,) local origin of the reference, which is subtracted.
        pose: motion between local coordinates that is applied then, as for clouds in memory; None: none.
        region: measured region in local coordinates; None: everything.
        folder: folder for the files, which exists.
    """
    stored = runs.read([code_range])
    if not len(stored.points):
        return TileSummary.empty(number)
    points = stored.points - origin
    if pose is not None:
        points = pose.apply(points)
    save_points(folder, number, points, stored.rows)
    if stored.normals is not None and pose is None:
        directions, is_valid = unit(stored.normals)
        directions[~is_valid] = np.nan
        save_column(folder, number, GIVEN_NORMALS, directions)
    if stored.classes is not None:
        save_column(folder, number, CLASSES, stored.classes)
    return TileSummary.of(number, points, points if region is None else points[region.contains(points)])
