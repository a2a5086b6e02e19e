"""Samples of two clouds on disk for what no tile can do alone: registration, sampling floors, test for deformation.

Small clouds are their own sample. Of larger ones, all points in evenly spread windows are used: point spacing, normals
and noise are then those of the complete clouds, which thinned clouds would not have. Windows are ranges of a Morton
curve with about equal numbers of points, of which every n-th is used. This is a systematic sample of clusters; it is
stratified in space.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.transform import Similarity
from pcbench.measure.tiled.lattice import CODE_BITS, Codes, Lattice
from pcbench.measure.tiled.runs import CloudRuns, StoredPoints, leaf_ranges
from pcbench.measure.tiled.stored import StoredCloud
from pcbench.tasks import Task, TaskRunner

MAX_SAMPLE = 400_000
"""Largest number of points of a sample; clouds that all have fewer are used as they are."""
_WINDOW_POINTS = 4_000  # 20 m wide for a scan with 10 points per square metre
_MARGIN = 0.1  # share of a window's side, at its border, without candidate points: their counterparts may lie outside


@dataclass(frozen=True, eq=False)
class Windows:
    """Boxes in the reference's coordinates, evenly spread over its points.

    Attributes:
        lattice: the lattice of the boxes.
        ranges: (W, 2) half-open ranges of its Morton curve, ascending; each is a box.
    """

    lattice: Lattice
    ranges: Codes

    @classmethod
    def of(cls, cloud: StoredCloud, preferred: FloatArray) -> Windows:
        """Return windows with about `MAX_SAMPLE` points of the reference.

        Args:
            cloud: the reference.
            preferred: (M, 3) even sample of the points of interest, in whose places half of the windows lie.
        """
        leaves = np.array(leaf_ranges(cloud.runs, _WINDOW_POINTS), np.uint64)
        wanted = max(1, MAX_SAMPLE // 2 // _WINDOW_POINTS)
        lattice = cloud.runs.lattice
        of_interest = np.unique(_range_of(lattice.codes(preferred), leaves))
        chosen = [np.arange(len(leaves)), of_interest[of_interest >= 0]]
        rows = np.unique(np.concatenate([_every(which, wanted) for which in chosen]))
        return cls(lattice, leaves[rows])

    def inner_boxes(self) -> tuple[FloatArray, FloatArray]:
        """Return the corners (W, 3) of the windows without their margins."""
        corners = [self.lattice.box((int(low), int(high))) for low, high in self.ranges]
        low, high = (np.array(side) for side in zip(*corners, strict=True))
        return low + _MARGIN * (high - low), high - _MARGIN * (high - low)


def _every(values: IntArray, count: int) -> IntArray:
    step = max(1, -(-len(values) // count))
    return values[step // 2 :: step] if len(values) > step // 2 else values[:1]


def _range_of(codes: Codes, ranges: Codes) -> IntArray:
    """Return the row of the range that contains each code (N,), or -1."""
    at = np.searchsorted(ranges[:, 0], codes, side="right") - 1
    return np.where((at >= 0) & (codes < ranges[at, 1]), at, -1)


def complete_cloud(cloud: StoredCloud) -> Cloud:
    """Return all points of a small cloud."""
    return _as_cloud(cloud, [cloud.runs.read([(0, 1 << CODE_BITS)])])


def reference_in_windows(cloud: StoredCloud, windows: Windows) -> Cloud:
    """Return the points of the reference in windows."""
    return _as_cloud(cloud, [cloud.runs.read([(int(low), int(high)) for low, high in windows.ranges])])


def candidate_in_windows(
    cloud: StoredCloud, windows: Windows, pose: Similarity, runner: TaskRunner, stage: str, key: str
) -> Cloud:
    """Return the points of a candidate inside windows, in its own coordinates.

    Args:
        cloud: the candidate.
        windows: windows in the reference's coordinates.
        pose: motion to these coordinates.
        runner: runs one task for each run of the cloud.
        stage: name of the stage.
        key: key of the results.
    """
    tasks = [
        Task(f"{run.number:06d}", (CloudRuns(cloud.runs.folder, cloud.runs.lattice, (run,)), windows, pose), run.count)
        for run in cloud.runs.runs
    ]
    results = runner.run(stage, points_in_windows, tasks, key=key, title="sampling the candidate")
    found = [stored for _, stored in results if len(stored.points)]
    return _as_cloud(cloud, found)


def points_in_windows(runs: CloudRuns, windows: Windows, pose: Similarity) -> StoredPoints:
    """Return the points of runs inside windows, without margins, in the order of their rows."""
    stored = runs.read([(0, 1 << CODE_BITS)])
    moved = pose.apply(stored.points)
    window = _range_of(windows.lattice.codes(moved), windows.ranges)
    low, high = windows.inner_boxes()
    inside = np.flatnonzero((window >= 0) & ((moved >= low[window]) & (moved <= high[window])).all(axis=1))
    normals, classes = stored.normals, stored.classes
    return StoredPoints(
        stored.points[inside],
        stored.rows[inside],
        None if normals is None else normals[inside],
        None if classes is None else classes[inside],
    )


def _as_cloud(cloud: StoredCloud, parts: Sequence[StoredPoints]) -> Cloud:
    """Return the stored points of parts, which are in order, as a cloud; at most twice `MAX_SAMPLE`, evenly thinned."""
    total = sum(len(part.points) for part in parts)
    step = max(1, -(-total // (2 * MAX_SAMPLE)))

    def column(name: str) -> Any:
        columns = [getattr(part, name) for part in parts]
        return None if not columns or any(c is None for c in columns) else np.concatenate(columns)[::step]

    points, classes = column("points"), column("classes")
    return Cloud(
        np.zeros((0, 3)) if points is None else points,
        normals=column("normals"),
        attributes={} if classes is None else {"classification": classes},
        crs=cloud.source.crs,
        unit=cloud.source.unit,
    )
