"""Tiles of a cloud: its points in compact boxes, in the coordinates in which everything is measured."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray, bounds
from pcbench.geometry.normals import unit
from pcbench.geometry.transform import Similarity
from pcbench.measure.tiled.runs import CloudRuns


class TileSummary(NamedTuple):
    """What a tile contains: its number, the number of its points, and the corners (3,) of their box."""

    number: int
    count: int
    low: FloatArray
    high: FloatArray


@dataclass(frozen=True)
class Tiles:
    """The tiles of a cloud, stored in a folder, one array per tile and column.

    Columns are `points` (N, 3), minus the local origin and aligned; `rows` (N,) in the cloud, ascending; and what later
    steps add, such as `normals` (N, 3).

    Attributes:
        folder: folder of the files.
        counts: (T,) number of points of each tile.
        low, high: (T, 3) corners of the box of each tile; without meaning where a tile is empty.
    """

    folder: Path
    counts: NDArray[np.int64]
    low: FloatArray
    high: FloatArray

    @classmethod
    def of(cls, folder: Path, summaries: Iterable[TileSummary]) -> Tiles:
        """Return the tiles with these contents, in their order."""
        _, counts, low, high = zip(*summaries, strict=True)
        return cls(folder, np.array(counts, np.int64), np.array(low), np.array(high))

    def __len__(self) -> int:
        return len(self.counts)

    @property
    def occupied(self) -> list[int]:
        """Numbers of the tiles with points."""
        return [int(number) for number in np.flatnonzero(self.counts)]

    def file(self, number: int, column: str) -> Path:
        """Return the file of a column of a tile."""
        return self.folder / f"{number:06d}.{column}.npy"

    def load(self, number: int, column: str) -> NDArray[Any]:
        """Return a column of a tile as an array in memory."""
        values: NDArray[Any] = np.load(self.file(number, column))
        return values

    def open(self, number: int, column: str) -> NDArray[Any]:
        """Return a column of a tile as a memory map."""
        values: NDArray[Any] = np.load(self.file(number, column), mmap_mode="r")
        return values

    def has(self, number: int, column: str) -> bool:
        """Return whether a tile has a column."""
        return self.file(number, column).exists()

    def save(self, number: int, column: str, values: NDArray[Any]) -> None:
        """Store a column of a tile."""
        save_column(self.folder, number, column, values)


def save_column(folder: Path, number: int, column: str, values: NDArray[Any]) -> None:
    """Store a column of a tile under a temporary name and rename it: a killed task leaves no partial column."""
    temporary = folder / f"{number:06d}.{column}.partial"
    with temporary.open("wb") as file:
        np.save(file, values)
    temporary.replace(folder / f"{number:06d}.{column}.npy")


def make_tile(
    runs: CloudRuns,
    number: int,
    code_range: tuple[int, int],
    origin: FloatArray,
    pose: Similarity | None,
    folder: Path,
) -> TileSummary:
    """Store the points of a range of the Morton curve as a tile.

    Args:
        runs: the cloud.
        number: number of the tile.
        code_range: half-open range of codes.
        origin: (3,) local origin of the reference, which is subtracted.
        pose: motion between local coordinates that is applied then, as for clouds in memory; None: none.
        folder: folder for the files, which exists.
    """
    found = runs.read([code_range])
    if not len(found.points):
        return TileSummary(number, 0, np.zeros(3), np.zeros(3))
    points = found.points - origin
    if pose is not None:
        points = pose.apply(points)
    columns = {"points": points, "rows": found.rows, "classes": found.classes}
    if found.normals is not None and pose is None:
        directions, is_valid = unit(found.normals)
        directions[~is_valid] = np.nan
        columns["normals"] = directions
    for name, values in columns.items():
        if values is not None:
            save_column(folder, number, name, values)
    return TileSummary(number, len(points), *bounds(points))
