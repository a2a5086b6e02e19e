"""A cloud on disk: its files as their headers describe them, and the pieces in which they are read.

All types are frozen and can be pickled, because worker processes read the pieces.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray
from pcbench.io.las_checks import LasCounts
from pcbench.io.las_header import LasHeader
from pcbench.io.merging import merge_warnings
from pcbench.io.nodata import CoordinateCounts

Corner = tuple[float, float, float]


def as_corner(values: Iterable[float]) -> Corner:
    """Return three coordinates as plain numbers."""
    x, y, z = map(float, values)
    return x, y, z


@dataclass(frozen=True)
class CloudFile:
    """One file of a cloud (or one EPT folder), as its header describes it.

    Attributes:
        path: the file; `ept.json` of an EPT folder.
        count: number of points before filters.
        low: minimum x, y, z that the header states, in the unit of the cloud, or None.
        high: maximum x, y, z that the header states, or None.
        crs: coordinate reference system, or None if the file states none.
        unit: unit of the coordinates, or None if the file states none.
        has_normals: whether its points have normals.
        nbytes_in_memory: estimated bytes of the `pcbench.Cloud` that `read_cloud` returns for it.
        las_header: header of LAS, LAZ or COPC, with which the points are compared; None for other formats.
        has_splats: whether its points are the means of Gaussian splats.
    """

    path: Path
    count: int
    low: Corner | None = None
    high: Corner | None = None
    crs: str | None = None
    unit: str | None = None
    has_normals: bool = False
    nbytes_in_memory: int = 0
    las_header: LasHeader | None = field(default=None, repr=False, compare=False)
    has_splats: bool = False


@dataclass(frozen=True)
class Piece:
    """Consecutive points of one file that are read at once.

    Attributes:
        file: path of the file, as in `CloudFile`.
        number: position of the piece in its cloud, from 0. The points of all pieces in this order are the cloud.
        count: number of points before filters.
        address: where the piece lies in its file; its meaning depends on the format.
        label: text for messages, such as "piece 2 of 9"; empty if it is the whole file.
    """

    file: Path
    number: int
    count: int
    address: tuple[int, ...] = ()
    label: str = ""


@dataclass(frozen=True)
class DamagedFile:
    """A file that was left out because it cannot be read, its number of points if its header states it, and why."""

    path: Path
    count: int | None
    reason: str


@dataclass(frozen=True)
class CloudOnDisk:
    """A cloud in one or many files, known from their headers.

    Attributes:
        path: the file, folder, pattern, `.vpc` or `ept.json` that the user named.
        files: its files, in the order of the points.
        pieces: all pieces, in the order of the points.
        classes: class numbers to keep, or None: all.
        returns: returns to keep: "first", "last" or return numbers; None: all.
        crs: coordinate reference system of all files that state one.
        unit: unit of all files that state one.
        has_normals: whether the points of all files have normals.
        left_out: damaged files that are not read.
        file_warnings: warnings from the headers, each with the path of its file or of the cloud.
    """

    path: Path
    files: tuple[CloudFile, ...]
    pieces: tuple[Piece, ...]
    classes: tuple[int, ...] | None = None
    returns: str | tuple[int, ...] | None = None
    crs: str | None = None
    unit: str | None = None
    has_normals: bool = False
    left_out: tuple[DamagedFile, ...] = ()
    file_warnings: tuple[tuple[Path, str], ...] = ()

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings from the headers as lines that start with a path; equal ones of several files are one line."""
        return tuple(merge_warnings(self.file_warnings))

    @property
    def count(self) -> int:
        """Number of points before filters."""
        return sum(file.count for file in self.files)

    @property
    def has_splats(self) -> bool:
        """Return whether points of a file are the means of Gaussian splats."""
        return any(file.has_splats for file in self.files)

    def without_pieces(self) -> CloudOnDisk:
        """Return a copy without files and pieces, to send to workers: `read_piece` does not need them."""
        return replace(self, files=(), pieces=(), file_warnings=())

    @property
    def nbytes_in_memory(self) -> int:
        """Estimated bytes of the `pcbench.Cloud` that `read_cloud` returns for this path."""
        return sum(file.nbytes_in_memory for file in self.files)


class Part(NamedTuple):
    """Part of one file that is read at once: its number of points before filters, and its address."""

    points: int
    address: tuple[int, ...]


class PieceNotes(NamedTuple):
    """Counts and warnings from reading one piece. `reading_warnings` turns those of all pieces into lines for the user.

    Attributes:
        finite: points that passed the filters and are finite.
        dropped: points that passed the filters and have NaN or Inf coordinates.
        coordinates: counts of the coordinates of the finite points, to find values that stand for missing data.
        las: counts over the LAS points of the piece before filters, or None for other formats.
        lines: other warnings, without the path.
    """

    finite: int = 0
    dropped: int = 0
    coordinates: CoordinateCounts = CoordinateCounts()
    las: LasCounts | None = None
    lines: tuple[str, ...] = ()


class PiecePoints(NamedTuple):
    """The points of a piece that pass the filters and are finite, in stored order; there may be none.

    Attributes:
        points: coordinates (N, 3).
        normals: normals (N, 3), or None unless all files of the cloud have them.
        classification: classes (N,), or None unless the file is LAS, LAZ, COPC or EPT.
        notes: what was noticed while reading.
    """

    points: FloatArray
    normals: FloatArray | None
    classification: NDArray[np.uint8] | None
    notes: PieceNotes
