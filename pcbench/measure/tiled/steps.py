"""Settings, workers and files that all steps of a comparison in tiles share."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from pcbench.errors import InputError
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.regions import Region
from pcbench.geometry.transform import Similarity
from pcbench.measure.settings import Settings
from pcbench.measure.tiled.ranks import FileMap
from pcbench.measure.tiled.runs import tile_ranges
from pcbench.measure.tiled.settings import TilingSettings
from pcbench.measure.tiled.stored import StoredCloud
from pcbench.measure.tiled.tiles import TiledCloud, TileSummary, make_tile
from pcbench.tasks import Task, TaskRunner
from pcbench.tasks.codec import fingerprint

T = TypeVar("T")

REFERENCE = "reference"
"""Name of the reference in stages and folders."""


@dataclass(frozen=True, eq=False)
class Steps:
    """Settings, workers and files that the steps of one comparison share.

    Attributes:
        runner: runs the tasks of all steps.
        folder: folder of intermediate files, with one folder per cloud.
        key: identifies the inputs and settings; stored results of another key are not used.
        settings: settings of the comparison.
        tiling: settings of the tiles.
        tile_points: largest number of points of a tile.
        report: progress callback.
    """

    runner: TaskRunner
    folder: Path
    key: str
    settings: Settings
    tiling: TilingSettings
    tile_points: int
    report: Callable[[str], None]

    def make_tiles(
        self,
        name: str,
        cloud: StoredCloud,
        origin: FloatArray,
        pose: Similarity | None,
        region: Region | None,
    ) -> list[TileSummary]:
        """Cut a cloud into tiles in local coordinates, after moving it by a pose if there is one."""
        folder = self.folder / name / "tiles"
        folder.mkdir(parents=True, exist_ok=True)
        tasks = []
        for number, codes in enumerate(tile_ranges(cloud.runs, self.tile_points)):
            arguments = (cloud.runs.overlapping(codes), number, codes, origin, pose, region, folder)
            tasks.append(Task(f"{number:06d}", arguments, self.tile_points))
        return list(self.results(f"{name}-tiles", make_tile, tasks, f"cutting {cloud.source.path} into tiles"))

    def check_inside(self, inside: int, cloud: StoredCloud, owner: str) -> None:
        """Raise an InputError if no point of a cloud is inside the region."""
        if inside == 0:
            crop = self.settings.crop
            text = crop if isinstance(crop, str) else crop.text
            corners = zip("xyz", cloud.low, cloud.high, strict=True)
            extent = ", ".join(f"{axis} {low:,.6g} to {high:,.6g}" for axis, low, high in corners)
            raise InputError(
                f"the crop {text!r} leaves none of {owner} {cloud.count:,} points ({extent}): check its numbers, the"
                " coordinate system and the unit"
            )

    def results(self, stage: str, function: Callable[..., T], tasks: Sequence[Task], title: str) -> Iterator[T]:
        """Run tasks, and return an iterator that loads their results one at a time."""
        results = self.runner.run(stage, function, tasks, key=self.key, title=title)
        return (result for _, result in results)

    def file_map(self, stage: str) -> FileMap:
        """Return a function that distributes calls for many files as tasks, and repeats none of them."""
        passes = itertools.count()

        def map_files(function: Callable[[Path], T], files: Sequence[Path]) -> Iterable[T]:
            if len(files) == 1:
                return map(function, files)
            tasks = [Task(f"{number:06d}", (file,), file.stat().st_size / 8) for number, file in enumerate(files)]
            key = f"{self.key}{fingerprint(getattr(function, 'keywords', {}))}"  # of a `partial`
            results = self.runner.run(f"{stage}-{next(passes)}", function, tasks, key=key, title="percentiles")
            return (result for _, result in results)

        return map_files


def tile_tasks(tiles: TiledCloud, arguments: Callable[[int], tuple[Any, ...]]) -> list[Task]:
    """Return a task for each tile with points; `arguments` returns those of the tile with a number."""
    return [Task(f"{number:06d}", arguments(number), int(tiles.counts[number])) for number in tiles.occupied]
