"""Samples of two clouds on disk for what no tile can do alone: registration, sampling floors, test for deformation.

Small clouds are their own sample. Of larger ones, all points in evenly spread windows are used: point spacing, normals
and noise are then those of the complete clouds, which thinned clouds would not have. Windows are ranges of a Morton
curve with about equal numbers of points, of which every n-th is used. This is a systematic sample of clusters; it is
stratified in space.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.regions import Mask, Region
from pcbench.geometry.transform import Similarity
from pcbench.measure.tiled.lattice import CODE_BITS, Codes, Lattice
from pcbench.measure.tiled.runs import CloudRuns, StoredPoints, leaf_ranges
from pcbench.measure.tiled.stored import StoredCloud
from pcbench.tasks import Task, TaskRunner

MAX_SAMPLE = 400_000
"""Largest number of points of a sample; clouds that all have fewer are used as they are."""
_WINDOW_POINTS = 2_000  # 14 m wide for a scan with 10 points per square metre
_CANDIDATE_POINTS = 100  # in a window; in smaller ones, the neighbours of many points lie outside
_MIN_WINDOWS = 16  # for which windows of a sparse candidate are not enlarged further
_MARGIN = 0.25  # share of a window's side, at its border, where no point is measured: its neighbours may lie outside


@dataclass(frozen=True, eq=False)
class Windows:
    """Boxes in the reference's coordinates, evenly spread over its points.

    Attributes:
        lattice: the lattice of the boxes.
        ranges: (W, 2) half-open ranges of its Morton curve, ascending; each is a box.
    """

    lattice: Lattice
    ranges: Codes

    @property
    def has_everything(self) -> bool:
        """Return whether a window contains all points: no neighbour lies outside."""
        return int(self.ranges[0, 1] - self.ranges[0, 0]) == 1 << CODE_BITS

    @classmethod
    def of(cls, cloud: StoredCloud, places: FloatArray, candidate_count: int) -> Windows:
        """Return windows with about `MAX_SAMPLE` points of the reference; one around all of a smaller reference.

        Args:
            cloud: the reference.
            places: (M, 3) points of interest. Half of the windows are spread over the reference, and half over those
                of the others that contain one of these.
            candidate_count: number of points of the candidate. If it is sparse, windows are fewer and larger.
        """
        if cloud.count <= MAX_SAMPLE:
            return cls(cloud.runs.lattice, np.array([[0, 1 << CODE_BITS]], np.uint64))
        enough = _CANDIDATE_POINTS * cloud.count // candidate_count
        points = max(_WINDOW_POINTS, min(enough, MAX_SAMPLE // _MIN_WINDOWS))
        leaves, lattice = leaf_ranges(cloud.runs, points), cloud.runs.lattice
        wanted = max(1, MAX_SAMPLE * len(leaves) // cloud.count // 2)
        of_interest = np.unique(_range_of(lattice.codes(places), leaves))
        everywhere = _evenly(len(leaves), wanted)
        others = np.setdiff1d(of_interest[of_interest >= 0], everywhere)
        rows = np.concatenate([everywhere, others[_evenly(len(others), wanted)]])
        return cls(lattice, leaves[np.sort(rows)])


@dataclass(frozen=True, eq=False)
class WindowRegion:
    """The inner parts of windows, where the neighbours of a point lie in the same window.

    Attributes:
        windows: the windows.
        region: another region, to which they are limited; None: they are not.
        origin: (3,) origin of the coordinates of points.
        text: text of the region in settings and errors.
    """

    windows: Windows
    region: Region | None
    origin: FloatArray
    text: str = "windows"

    def contains(self, points: FloatArray) -> Mask:
        """Return the mask (N,) of the points inside."""
        moved = points + self.origin
        if self.windows.has_everything:
            return np.ones(len(points), bool) if self.region is None else self.region.contains(moved)
        window = _range_of(self.windows.lattice.codes(moved), self.windows.ranges)
        corners = [self.windows.lattice.box((int(low), int(high))) for low, high in self.windows.ranges]
        low, high = (np.array(side) for side in zip(*corners, strict=True))
        margin = _MARGIN * (high - low)
        low, high = low + margin, high - margin
        inside: Mask = (window >= 0) & ((moved >= low[window]) & (moved <= high[window])).all(axis=1)
        return inside if self.region is None else inside & self.region.contains(moved)

    def shifted(self, origin: FloatArray) -> WindowRegion:
        """Return the region in coordinates minus `origin`."""
        return replace(self, origin=self.origin + origin)

    def describe(self) -> str:
        """Return a readable name."""
        return f"the inner parts of {len(self.windows.ranges)} windows"


def _evenly(count: int, most: int) -> IntArray:
    """Return `most` of the rows 0 to `count` - 1, or all of fewer, at even steps."""
    number = min(count, most)
    return ((np.arange(number) + 0.5) * count / number).astype(np.int64) if number else np.zeros(0, np.int64)


def _range_of(codes: Codes, ranges: Codes) -> IntArray:
    """Return the row of the range that contains each code (N,), or -1."""
    positions = np.searchsorted(ranges[:, 0], codes, side="right") - 1
    return np.where((positions >= 0) & (codes < ranges[positions, 1]), positions, -1)


def complete_cloud(cloud: StoredCloud) -> Cloud:
    """Return all points of a small cloud."""
    return _as_cloud(cloud, [cloud.runs.read([(0, 1 << CODE_BITS)])])


def reference_in_windows(cloud: StoredCloud, windows: Windows) -> Cloud:
    """Return the points of the reference in windows."""
    return _as_cloud(cloud, [cloud.runs.read([(int(low), int(high)) for low, high in windows.ranges])])


def thinning_step(cloud: StoredCloud, windows: Windows, pose: Similarity) -> int:
    """Return the step at which a candidate is thinned: if it is dense, windows have too many of its points."""
    share = np.mean(_range_of(windows.lattice.codes(pose.apply(cloud.even)), windows.ranges) >= 0)
    return max(1, math.ceil(share * cloud.count / (2 * MAX_SAMPLE)))


def candidate_in_windows(
    cloud: StoredCloud, windows: Windows, pose: Similarity, step: int, runner: TaskRunner, stage: str, key: str
) -> Cloud | None:
    """Return the points of a candidate inside windows, in its own coordinates; None if there are none.

    Args:
        cloud: the candidate.
        windows: windows in the reference's coordinates.
        pose: motion to these coordinates.
        step: only points whose rows are multiples of it are returned.
        runner: runs one task for each run of the cloud.
        stage: name of the stage.
        key: key of the results.
    """
    tasks = [
        Task(
            f"{run.number:06d}",
            (CloudRuns(cloud.runs.folder, cloud.runs.lattice, (run,)), windows, pose, step),
            run.count,
        )
        for run in cloud.runs.runs
    ]
    results = runner.run(stage, points_in_windows, tasks, key=key, title="sampling the candidate")
    parts = [stored for _, stored in results if len(stored.points)]
    return _as_cloud(cloud, parts) if parts else None


def points_in_windows(runs: CloudRuns, windows: Windows, pose: Similarity, step: int) -> StoredPoints:
    """Return the points of runs inside windows whose rows are multiples of a step, in the order of their rows."""
    stored = runs.read([(0, 1 << CODE_BITS)])
    is_inside = _range_of(windows.lattice.codes(pose.apply(stored.points)), windows.ranges) >= 0
    inside = np.flatnonzero(is_inside & (stored.rows % step == 0))
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
        points,
        normals=column("normals"),
        attributes={} if classes is None else {"classification": classes},
        crs=cloud.source.crs,
        unit=cloud.source.unit,
    )
