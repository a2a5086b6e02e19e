"""Pieces of a cloud, sorted along a Morton curve and stored: any part of space is then a short range of each run."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray, IntArray, bounds
from pcbench.io.contents import FileState
from pcbench.io.pieces import CloudOnDisk, Piece, PieceNotes, read_piece
from pcbench.measure.tiled.columns import column_file, map_column, save_column
from pcbench.measure.tiled.lattice import CODE_BITS, Codes, Lattice

_INDEX_ENTRIES = 1_024  # of a run: fine enough to find windows of some thousand points
_TABLE_SHARE = 20  # a table sorts numbers faster than comparisons if at least one in this many occurs
_COLUMNS = ("points", "order", "normals", "classes")


@dataclass(frozen=True, eq=False)
class RunSummary:
    """Number of points of a run, where they lie, and an index of it.

    Attributes:
        number: number of the piece.
        count: number of its points, after filters.
        low, high: corners (3,) of its box; None if it is empty.
        codes: Morton code of every `stride`-th point.
        last_code: largest code.
        stride: interval between them.
        even: every n-th point (M, 3) of the cloud, see `store_piece`.
        notes: what was noticed while reading.
    """

    number: int
    count: int
    low: FloatArray | None
    high: FloatArray | None
    codes: Codes
    last_code: int
    stride: int
    even: FloatArray
    notes: PieceNotes


def store_piece(
    cloud: CloudOnDisk, piece: Piece, state: FileState, first_row: int, step: int, lattice: Lattice, folder: Path
) -> RunSummary:
    """Read a piece and store it as a run.

    Args:
        cloud: the cloud.
        piece: a piece of it.
        state: state of its file when the digest of the cloud was computed.
        first_row: row of its first point in the cloud, before filters.
        step: every point whose row is a multiple of it is returned too.
        lattice: lattice of the Morton curve.
        folder: folder for the files of the run, which exists.

    Raises:
        PcbenchError: the file has changed since.
    """
    try:
        read = read_piece(cloud, piece)
    finally:
        state.check()  # before damage is blamed on the file
    points, count = read.points, len(read.points)
    if not count:
        return RunSummary(piece.number, 0, None, None, np.zeros(0, np.uint64), 0, 1, points, read.notes)
    codes = lattice.codes(points)
    order = np.argsort(codes, kind="stable")
    columns: dict[str, NDArray[Any] | None] = {
        "points": points.take(order, axis=0),
        "order": order.astype(np.uint32),
        "normals": None if read.normals is None else read.normals.take(order, axis=0),
        "classes": None if read.classification is None else read.classification[order],
    }
    for name, values in columns.items():
        if values is not None:
            save_column(folder, piece.number, name, values)
    stride = max(1, count // _INDEX_ENTRIES)
    even = points[-first_row % step :: step]
    last_code = int(codes[order[-1]])
    return RunSummary(piece.number, count, *bounds(points), codes[order[::stride]], last_code, stride, even, read.notes)


@dataclass(frozen=True)
class StoredRun:
    """A stored run.

    Attributes:
        number: number of the piece.
        count: number of points.
        first_row: row of its first point in the cloud, after filters.
        codes: Morton code of every `stride`-th point.
        last_code: largest code.
        stride: interval between them.
    """

    number: int
    count: int
    first_row: int
    codes: Codes
    last_code: int
    stride: int

    def overlaps(self, code_range: tuple[int, int]) -> bool:
        """Return whether the run may have points in a half-open range of codes."""
        return int(self.codes[0]) < code_range[1] and code_range[0] <= self.last_code


class StoredPoints(NamedTuple):
    """Points of a cloud with their rows, in the order of the rows."""

    points: FloatArray  # (N, 3) as in the file
    rows: IntArray  # (N,)
    normals: FloatArray | None
    classes: NDArray[np.uint8] | None


@dataclass(frozen=True)
class CloudRuns:
    """A cloud as sorted runs in a folder."""

    folder: Path
    lattice: Lattice
    runs: tuple[StoredRun, ...]

    @classmethod
    def of(cls, folder: Path, lattice: Lattice, summaries: Sequence[RunSummary]) -> CloudRuns:
        """Return the runs of all pieces, in their order."""
        runs, first_row = [], 0
        for summary in summaries:
            if summary.count:
                runs.append(
                    StoredRun(
                        summary.number, summary.count, first_row, summary.codes, summary.last_code, summary.stride
                    )
                )
            first_row += summary.count
        return cls(folder, lattice, tuple(runs))

    @property
    def count(self) -> int:
        """Number of points."""
        return sum(run.count for run in self.runs)

    def overlapping(self, code_range: tuple[int, int]) -> CloudRuns:
        """Return the runs that may have points in a half-open range of codes."""
        first, last = self._code_ends
        numbers = np.flatnonzero((first < np.uint64(code_range[1])) & (last >= np.uint64(code_range[0])))
        return replace(self, runs=tuple(self.runs[number] for number in numbers))

    @cached_property
    def _code_ends(self) -> tuple[Codes, Codes]:
        """Smallest and largest code (R,) of each run."""
        first, last = ([run.codes[0] for run in self.runs], [run.last_code for run in self.runs])
        return np.array(first, np.uint64), np.array(last, np.uint64)

    def read(self, ranges: Sequence[tuple[int, int]]) -> StoredPoints:
        """Read the points whose codes lie in one of these half-open ranges, in the order of their rows."""
        parts: dict[str, list[NDArray[Any]]] = {name: [] for name in _COLUMNS}
        for run in self.runs:
            slices = list(self._slices(run, ranges))
            if not slices:
                continue
            places = np.concatenate(_read_slices(column_file(self.folder, run.number, "order"), slices))
            order = _ascending(places, run.count)
            parts["order"].append(places[order].astype(np.int64) + run.first_row)
            for name in ("points", "normals", "classes"):
                file = column_file(self.folder, run.number, name)
                if name == "points" or file.exists():
                    parts[name].append(np.concatenate(_read_slices(file, slices)).take(order, axis=0))
        if not parts["order"]:
            return StoredPoints(np.zeros((0, 3)), np.zeros(0, np.int64), None, None)

        def column(name: str) -> NDArray[Any] | None:
            # A column that only some files have is left out, as when clouds are read into memory.
            complete = len(parts[name]) == len(parts["order"])
            return np.concatenate(parts[name]) if complete else None

        points = column("points")
        assert points is not None
        return StoredPoints(points, np.concatenate(parts["order"]), column("normals"), column("classes"))

    def take(self, numbers: IntArray) -> StoredPoints:
        """Return the points with these numbers (M,) of a cloud of one run, which is their order in its piece."""
        (run,) = self.runs
        places = np.empty(run.count, np.uint32)
        places[map_column(column_file(self.folder, run.number, "order"))] = np.arange(run.count, dtype=np.uint32)
        places = places[numbers]

        def column(name: str) -> NDArray[Any] | None:
            file = column_file(self.folder, run.number, name)
            return map_column(file).take(places, axis=0) if file.exists() else None

        points = column("points")
        assert points is not None
        return StoredPoints(points, numbers + run.first_row, column("normals"), column("classes"))

    def _slices(self, run: StoredRun, ranges: Sequence[tuple[int, int]]) -> Iterator[tuple[int, int]]:
        overlapping = [each for each in ranges if run.overlaps(each)]
        if not overlapping:
            return
        points = map_column(column_file(self.folder, run.number, "points"))
        for ends in overlapping:
            start, stop = (self._position(run, points, code) for code in ends)
            if start < stop:
                yield start, stop

    def _position(self, run: StoredRun, points: FloatArray, code: int) -> int:
        """Return the number of points (N, 3) of a run with smaller codes."""
        if code >= 1 << CODE_BITS:
            return run.count
        position = int(np.searchsorted(run.codes, np.uint64(code)))
        if position == 0 or run.stride == 1:
            return position
        start = (position - 1) * run.stride
        codes = self.lattice.codes(points[start : position * run.stride])
        return start + int(np.searchsorted(codes, np.uint64(code)))


def _read_slices(file: Path, slices: Sequence[tuple[int, int]]) -> list[NDArray[Any]]:
    """Return parts of a stored column, which are read when they are used."""
    values = map_column(file)
    return [values[start:stop] for start, stop in slices]


def _ascending(numbers: NDArray[np.uint32], end: int) -> IntArray:
    """Return the order that sorts different numbers below `end`."""
    if len(numbers) < end // _TABLE_SHARE:
        return np.argsort(numbers)
    table = np.full(end, -1, np.int64)
    table[numbers] = np.arange(len(numbers))
    return table[table >= 0]


def leaf_ranges(runs: CloudRuns, most: int) -> Codes:
    """Return half-open ranges (L, 2) of the Morton curve with about at most `most` points each, in ascending order.

    The curve is halved until each part has few enough points, so that each is a box of the lattice; empty parts are
    left out. Points of equal codes stay together.
    """
    codes = np.concatenate([run.codes for run in runs.runs])
    weights = np.concatenate([np.full(len(run.codes), run.count / len(run.codes)) for run in runs.runs])
    order = np.argsort(codes, kind="stable")
    codes, total = codes[order], np.concatenate([[0.0], np.cumsum(weights[order])])
    ranges = list[Codes]()
    low = np.zeros(1, np.uint64)
    for bits in range(CODE_BITS, -1, -1):  # ranges of 2^bits codes
        high = low + np.uint64(1 << bits)
        first = np.searchsorted(codes, low)
        last = np.searchsorted(codes, high - np.uint64(1), side="right")
        is_split = (total[last] - total[first] > most) & (bits > 0)
        is_leaf = ~is_split & (last > first)
        ranges.append(np.column_stack([low, high])[is_leaf])
        low = (low[is_split, None] + np.array([0, (1 << bits) // 2], np.uint64)).ravel()
    every = np.concatenate(ranges)
    return every[np.argsort(every[:, 0])]


def tile_ranges(runs: CloudRuns, most: int) -> list[tuple[int, int]]:
    """Cut the complete Morton curve into half-open ranges of about at most `most` points each."""
    starts = leaf_ranges(runs, most)[:, 0].tolist()
    return list(zip([0, *starts[1:]], [*starts[1:], 1 << CODE_BITS], strict=True))
