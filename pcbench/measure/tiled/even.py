"""Every n-th point of a cloud, or of its points inside a region, in the order of its rows, as in memory."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np

from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.regions import Region
from pcbench.measure.tiled.lattice import CODE_BITS
from pcbench.measure.tiled.runs import CloudRuns
from pcbench.tasks import Task, TaskRunner

EVEN_POINTS = 100_000
"""Points that an evenly thinned cloud has at least, as in `pcbench.geometry.voxels.robust_bounds`."""


def even_points(
    runs: CloudRuns, origin: FloatArray, region: Region | None, runner: TaskRunner, stage: str, key: str
) -> FloatArray:
    """Return every n-th point (M, 3) inside a region, minus an origin; all of at most 2 * `EVEN_POINTS` - 1.

    Args:
        runs: the cloud.
        origin: (3,) offset that is subtracted first.
        region: the region in these coordinates; None: everything.
        runner: runs two tasks for each run of the cloud.
        stage: name of the stage.
        key: key of the results.
    """
    parts = [replace(runs, runs=(run,)) for run in runs.runs]
    counts = [run.count for run in runs.runs]
    if region is not None:
        tasks = [Task(f"{part.runs[0].number:06d}", (part, origin, region), part.count) for part in parts]
        title = "counting points inside the region"
        counts = [found for _, found in runner.run(f"{stage}-count", count_inside, tasks, key=key, title=title)]
    step = max(1, sum(counts) // EVEN_POINTS)
    before = itertools.accumulate(counts, initial=0)
    tasks = [
        Task(f"{part.runs[0].number:06d}", (part, origin, region, first, step), part.count)
        for part, first in zip(parts, before, strict=False)
    ]
    found = runner.run(f"{stage}-even", every_nth_inside, tasks, key=key, title="thinning evenly")
    return np.concatenate([points for _, points in found])


def count_inside(runs: CloudRuns, origin: FloatArray, region: Region) -> int:
    """Return the number of points of runs inside a region."""
    return len(_points_inside(runs, origin, region))


def every_nth_inside(runs: CloudRuns, origin: FloatArray, region: Region | None, first: int, step: int) -> FloatArray:
    """Return the points inside a region whose numbers, counted from `first` by row, are multiples of a step."""
    return _points_inside(runs, origin, region)[-first % step :: step]


def _points_inside(runs: CloudRuns, origin: FloatArray, region: Region | None) -> FloatArray:
    points = runs.read([(0, 1 << CODE_BITS)]).points - origin
    return points if region is None else points[region.contains(points)]
