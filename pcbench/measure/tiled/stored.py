"""A cloud on disk, read once and stored as runs along a Morton curve."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property, reduce
from pathlib import Path

import numpy as np

from pcbench.errors import InputError, PcbenchError
from pcbench.geometry.arrays import FloatArray, bounds
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.quantisation import Quantisation
from pcbench.geometry.transform import Similarity
from pcbench.io.contents import FileState
from pcbench.io.las_records import LasFilters
from pcbench.io.pieces import CloudOnDisk, Piece, read_piece, reading_warnings
from pcbench.measure.results import LeftOut
from pcbench.measure.tiled.even import EVEN_POINTS, Picker, PlacedRuns, even_points
from pcbench.measure.tiled.lattice import Lattice
from pcbench.measure.tiled.runs import CloudRuns, store_piece
from pcbench.tasks import Task, TaskRunner

_PROBED_PIECES = 3  # pieces that are read to find out where a cloud lies, if its header does not say so


@dataclass(frozen=True, eq=False)
class StoredCloud:
    """A cloud as sorted runs.

    Attributes:
        source: the cloud as its headers describe it.
        runs: its points.
        low, high: (3,) corners of its box.
        even: (M, 3) every n-th point, in the order of the cloud.
        left_out: damaged files and pieces that were left out.
        warnings: warnings of the reader.
    """

    source: CloudOnDisk
    runs: CloudRuns
    low: FloatArray
    high: FloatArray
    even: FloatArray
    left_out: tuple[LeftOut, ...]
    warnings: tuple[str, ...]

    @property
    def count(self) -> int:
        """Number of points."""
        return self.runs.count

    @cached_property
    def quantisation(self) -> Quantisation:
        """Lattice on which the coordinates lie because files rounded them."""
        return Quantisation.of(self.even, self.count)

    @property
    def thinned(self) -> Cloud:
        """The evenly thinned cloud."""
        return Cloud(self.even, crs=self.source.crs, unit=self.source.unit)


def rough_boxes(
    clouds: Mapping[str, CloudOnDisk], runner: TaskRunner, key: str
) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Return the corners (3,) of the box of each cloud by name, from its headers or from some of its pieces."""
    corners = {}
    for name, cloud in clouds.items():
        if all(file.low is not None and file.high is not None for file in cloud.files):
            boxes = [(np.array(file.low), np.array(file.high)) for file in cloud.files if file.count]
        else:
            step = -(-len(cloud.pieces) // _PROBED_PIECES)
            tasks = [Task(f"{piece.number:06d}", (cloud, piece), piece.count) for piece in cloud.pieces[::step]]
            skip = (lambda *_: None) if len(tasks) > 1 else None
            results = runner.run(f"{name}-extent", piece_bounds, tasks, key=key, title="finding the extent", skip=skip)
            boxes = [box for _, box in results if box is not None]
        if not boxes:
            raise _no_points_error(cloud)
        low = reduce(np.minimum, [low for low, _ in boxes])
        corners[name] = low, reduce(np.maximum, [high for _, high in boxes])
    return corners


def _no_points_error(cloud: CloudOnDisk) -> InputError:
    filters = str(LasFilters(cloud.classes, cloud.returns))
    wanted = f"points with {filters}" if filters else "a point cloud with at least one point"
    return InputError(f"{cloud.path}: expected {wanted}, got none")


def piece_bounds(cloud: CloudOnDisk, piece: Piece) -> tuple[FloatArray, FloatArray] | None:
    """Return the corners (3,) of the box of a piece; None if no point passes the filters."""
    points = read_piece(cloud, piece).points
    return bounds(points) if len(points) else None


def lattice_around(
    boxes: Mapping[str, tuple[FloatArray, FloatArray]], poses: Mapping[str, Similarity | None]
) -> Lattice:
    """Return a lattice around the boxes of all clouds by name, in the reference's coordinates."""
    corners = []
    for name, (low, high) in boxes.items():
        of_box = np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])
        pose = poses.get(name)
        corners.append(of_box if pose is None else pose.apply(of_box))
    every = np.concatenate(corners)
    return Lattice.around(every.min(axis=0), every.max(axis=0))


def store_cloud(
    name: str,
    cloud: CloudOnDisk,
    lattice: Lattice,
    folder: Path,
    runner: TaskRunner,
    key: str,
    contents: Mapping[Path, FileState],
    *,
    skip_bad: bool,
) -> StoredCloud:
    """Read all pieces of a cloud and store them as sorted runs.

    Args:
        name: name of the cloud's stage.
        cloud: the cloud.
        lattice: lattice of the Morton curve, with the pose of this cloud.
        folder: folder for the runs.
        runner: runs one task for each piece.
        key: key of the results.
        contents: state of each file of the cloud.
        skip_bad: whether damaged pieces are left out.

    Raises:
        InputError: a piece is damaged, or no point is left.
        PcbenchError: a file changed while it was read.
    """
    folder.mkdir(parents=True, exist_ok=True)
    step = max(1, cloud.count // EVEN_POINTS)
    files = {file.path: file for file in cloud.files}
    tasks, pieces, first_row = list[Task](), dict[str, Piece](), 0
    for piece in cloud.pieces:
        one_file = replace(cloud, files=(files[piece.file],), pieces=())  # arguments travel to the worker
        task = Task(
            f"{piece.number:06d}",
            (one_file, piece, contents[piece.file], first_row, step, lattice, folder),
            piece.count,
        )
        tasks.append(task)
        pieces[task.name] = piece
        first_row += piece.count
    left_out = [LeftOut(str(file.path), file.count, file.reason) for file in cloud.left_out]

    def leave_out(task: Task, error: PcbenchError) -> None:
        piece = pieces[task.name]
        reason = str(error).removeprefix(f"{piece.file}: ")
        left_out.append(LeftOut(str(piece.file), piece.count, reason))

    title, skip = f"reading {cloud.path}", leave_out if skip_bad else None
    results = runner.run(f"{name}-read", store_piece, tasks, key=key, title=title, skip=skip)
    summaries = [summary for _, summary in results]
    boxes = [(run.low, run.high) for run in summaries if run.low is not None and run.high is not None]
    if not boxes:
        raise _no_points_error(cloud)
    runs = CloudRuns.of(folder, lattice, summaries)
    even = np.concatenate([summary.even for summary in summaries])
    if step > 1 and runs.count != cloud.count:  # filters and points that are not finite shift the rows
        even = even_points(Picker.of(PlacedRuns(runs, np.zeros(3)), runner, name, key))
    notes = [(pieces[task.name], summary.notes) for task, summary in results]
    return StoredCloud(
        source=cloud,
        runs=runs,
        low=reduce(np.minimum, [low for low, _ in boxes]),
        high=reduce(np.maximum, [high for _, high in boxes]),
        even=even,
        left_out=tuple(sorted(left_out)),
        warnings=(*cloud.warnings, *reading_warnings(cloud, notes)),
    )
