"""A cloud on disk: its files as their headers describe them, and the pieces in which it is read.

All types are frozen and can be pickled, because worker processes read the pieces.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray

Corner = tuple[float, float, float]


@dataclass(frozen=True)
class CloudFile:
    """One file of a cloud (or one EPT folder), as its header describes it.

    Attributes:
        path: the file; `ept.json` of an EPT folder.
        count: number of points before filters; for text files the number of lines, which is at least that.
        low: minimum x, y, z that the header states, in the unit of the cloud, or None.
        high: maximum x, y, z that the header states, or None.
        crs: coordinate reference system, or None if the file states none.
        unit: unit of the coordinates, or None if the file states none.
        has_normals: whether its points have normals.
        nbytes_in_memory: estimated bytes of the `pcbench.Cloud` that `read_cloud` returns for it.
    """

    path: Path
    count: int
    low: Corner | None = None
    high: Corner | None = None
    crs: str | None = None
    unit: str | None = None
    has_normals: bool = False
    nbytes_in_memory: int = 0


@dataclass(frozen=True)
class Piece:
    """Consecutive points of one file that are read at once.

    Attributes:
        file: path of the file, as in `CloudFile`.
        number: position of the piece in its cloud, from 0. The points of all pieces in this order are the cloud.
        count: number of points before filters; for text files the number of lines, which is at least that.
        address: where the piece lies in its file; its meaning depends on the format.
    """

    file: Path
    number: int
    count: int
    address: tuple[int, ...] = ()


class DamagedFile(NamedTuple):
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
        warnings: what a reader of the cloud should know, one line each; they start with a path.
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
    warnings: tuple[str, ...] = ()

    @property
    def count(self) -> int:
        """Number of points before filters; at least that many if there are text files, whose lines are counted."""
        return sum(file.count for file in self.files)

    @property
    def nbytes_in_memory(self) -> int:
        """Estimated bytes of the `pcbench.Cloud` that `read_cloud` returns for this path."""
        return sum(file.nbytes_in_memory for file in self.files)


class PieceNotes(NamedTuple):
    """Counts from reading one piece. `reading_warnings` turns those of all pieces into lines for the user.

    Attributes:
        dropped: points with NaN or Inf coordinates, after filters.
        at_origin: points that are exactly (0, 0, 0).
        withheld: LAS points that are marked as withheld, before filters; they are kept.
        wrong_returns: LAS points with a return number above the number of returns of their pulse.
        by_return: LAS points per return number 0 to 15, before filters; empty for other formats.
        outside: largest distance by which LAS points exceed the bounds of their header in x, y, z; empty otherwise.
        unverified: whether compressed points could not be verified.
        lines: other warnings, without the path.
    """

    dropped: int = 0
    at_origin: int = 0
    withheld: int = 0
    wrong_returns: int = 0
    by_return: tuple[int, ...] = ()
    outside: tuple[float, ...] = ()
    unverified: bool = False
    lines: tuple[str, ...] = ()


class PiecePoints(NamedTuple):
    """The points of a piece that pass the filters and are finite, in stored order; there may be none.

    Attributes:
        points: coordinates (N, 3).
        normals: normals (N, 3), or None unless all files of the cloud have them.
        classification: LAS classes (N,), or None for other formats.
        notes: what was noticed while reading.
    """

    points: FloatArray
    normals: FloatArray | None
    classification: NDArray[np.uint8] | None
    notes: PieceNotes
