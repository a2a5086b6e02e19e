"""Points of a cloud on disk by their numbers among those of a region, in the order of its rows, as in memory."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray, IntArray, bounds
from pcbench.geometry.regions import Region
from pcbench.geometry.transform import Similarity
from pcbench.measure.tiled.lattice import CODE_BITS
from pcbench.measure.tiled.runs import CloudRuns
from pcbench.tasks import Task, TaskRunner
from pcbench.tasks.codec import fingerprint

EVEN_POINTS = 100_000
"""Points that an evenly thinned cloud has at least, as in `pcbench.geometry.voxels.robust_bounds`."""


@dataclass(frozen=True)
class PlacedRuns:
    """The points of runs inside a region, in the coordinates in which everything is measured.

    Attributes:
        runs: the points as in their files.
        origin: (3,) offset that is subtracted first.
        pose: motion that is applied then; None: none.
        region: the region in these coordinates; None: everything.
    """

    runs: CloudRuns
    origin: FloatArray
    pose: Similarity | None = None
    region: Region | None = None

    @property
    def parts(self) -> list[PlacedRuns]:
        """Each run by itself."""
        return [replace(self, runs=replace(self.runs, runs=(run,))) for run in self.runs.runs]

    def load(self, numbers: IntArray | None = None) -> PickedPoints:
        """Return all points inside the region, in the order of their rows; or those with numbers (M,) of one run."""
        stored = self.runs.read([(0, 1 << CODE_BITS)]) if numbers is None else self.runs.take(numbers)
        points = stored.points - self.origin
        if self.pose is not None:
            points = self.pose.apply(points)
        loaded = PickedPoints(points, stored.rows, stored.classes)
        return loaded if self.region is None else loaded.select(np.flatnonzero(self.region.contains(points)))


class PickedPoints(NamedTuple):
    """Points of a cloud, in the order of their rows."""

    points: FloatArray  # (M, 3) in the coordinates in which everything is measured
    rows: IntArray  # (M,) in the cloud
    classes: NDArray[np.uint8] | None  # (M,) LAS classes

    def select(self, which: NDArray[Any]) -> PickedPoints:
        """Return those selected by indices or by a slice."""
        classes = None if self.classes is None else self.classes[which]
        return PickedPoints(self.points[which], self.rows[which], classes)


@dataclass(frozen=True)
class Picker:
    """Picks points by their numbers, with one task for each run of the cloud.

    Attributes:
        placed: the cloud.
        counts: number of points of each run inside the region.
        lowest: (3,) their lowest coordinates; None without a region.
        runner: runs the tasks.
        stage: start of the names of the stages.
        key: key of the results.
    """

    placed: PlacedRuns
    counts: tuple[int, ...]
    lowest: FloatArray | None
    runner: TaskRunner
    stage: str
    key: str

    @classmethod
    def of(cls, placed: PlacedRuns, runner: TaskRunner, stage: str, key: str) -> Picker:
        """Return the picker of a cloud, after counting the points inside its region if it has one."""
        if placed.region is None:
            return cls(placed, tuple(run.count for run in placed.runs.runs), None, runner, stage, key)
        tasks, title = [_task(part) for part in placed.parts], "counting points inside the region"
        counted = [each for _, each in runner.run(f"{stage}-count", count_inside, tasks, key=key, title=title)]
        lowest = np.min([each.lowest for each in counted], axis=0)
        return cls(placed, tuple(each.number for each in counted), lowest, runner, stage, key)

    @property
    def count(self) -> int:
        """Number of points inside the region."""
        return sum(self.counts)

    def every(self, step: int) -> PickedPoints:
        """Return every `step`-th point inside the region, from the first one on."""
        return self.pick(np.arange(0, self.count, step))

    def pick(self, numbers: IntArray) -> PickedPoints:
        """Return the points with these numbers (M,), ascending, among those inside the region."""
        ends = list(itertools.accumulate(self.counts, initial=0))
        cuts = np.searchsorted(numbers, ends)
        tasks = []
        for part, first, low, high in zip(self.placed.parts, ends[:-1], cuts[:-1], cuts[1:], strict=True):
            if low < high:
                tasks.append(_task(part, numbers[low:high] - first))
        stage, key = f"{self.stage}-{fingerprint(numbers)[:12]}", self.key
        results = self.runner.run(stage, picked_points, tasks, key=key, title="picking points")
        parts = [picked for _, picked in results]
        has_classes = all(part.classes is not None for part in parts)
        return PickedPoints(
            np.concatenate([np.zeros((0, 3)), *(part.points for part in parts)]),
            np.concatenate([np.zeros(0, np.int64), *(part.rows for part in parts)]),
            np.concatenate([part.classes for part in parts]) if parts and has_classes else None,
        )


def even_points(picker: Picker) -> FloatArray:
    """Return every n-th point (M, 3) inside the region; all of at most 2 * `EVEN_POINTS` - 1."""
    return picker.every(max(1, picker.count // EVEN_POINTS)).points


class CountedPoints(NamedTuple):
    """Number of points, and their lowest coordinates (3,); infinite if there are none."""

    number: int
    lowest: FloatArray


def count_inside(placed: PlacedRuns) -> CountedPoints:
    """Count the points inside the region."""
    points = placed.load().points
    return CountedPoints(len(points), bounds(points)[0] if len(points) else np.full(3, np.inf))


def picked_points(placed: PlacedRuns, numbers: IntArray) -> PickedPoints:
    """Return the points with these numbers (M,) among those of a run inside the region."""
    return placed.load(numbers) if placed.region is None else placed.load().select(numbers)


def _task(part: PlacedRuns, *arguments: Any) -> Task:
    run = part.runs.runs[0]
    return Task(f"{run.number:06d}", (part, *arguments), run.count)
