"""Pieces of LAS are ranges of points; pieces of LAZ and COPC are runs of chunks."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

from pcbench.io.files import Fields, Warn
from pcbench.io.las import filter_records, las_fields
from pcbench.io.las_checks import LasCounts, count_records, warn_of_rest
from pcbench.io.las_crs import read_crs
from pcbench.io.las_header import read_extras, read_header
from pcbench.io.las_records import (
    LasFilters,
    check_complete,
    has_normals,
    read_compressed_records,
    read_records,
)
from pcbench.io.laz import read_chunks
from pcbench.io.pieces.types import CloudFile, Part, as_corner

_COORDINATE_BYTES = 24  # in memory; the other values of a point take about as many bytes as in the file


def describe_las(path: Path, piece_points: int, warn: Warn) -> tuple[CloudFile, list[Part]]:
    """Describe a LAS, LAZ or COPC file.

    Raises:
        InputError: the header or the chunk table is damaged, or the file is truncated.
        MissingExtra: the file is compressed, and lazrs is not installed.
        OSError: the file cannot be read.
    """
    with path.open("rb") as file:
        header = read_header(file, warn, allow_empty=True)
        extras = read_extras(header, warn)
        crs, unit = read_crs(header.records, warn)
        if header.compressed:
            chunks = [chunk.points for chunk in read_chunks(file, header)] if header.count else []
            parts = [Part(sum(chunks[first:end]), (first, end)) for first, end in group(chunks, piece_points)]
        else:
            check_complete(header)
            warn_of_rest(header, warn)
            parts = split(header.count, piece_points)
    low, high = map(as_corner, header.bounds) if header.bounds is not None and header.count else (None, None)
    nbytes = header.count * (_COORDINATE_BYTES + header.record_bytes)
    return CloudFile(path, header.count, low, high, crs, unit, has_normals(extras), nbytes, header), parts


def read_las_piece(
    path: Path, address: tuple[int, ...], filters: LasFilters, warn: Warn
) -> tuple[Fields, LasCounts | None]:
    """Read the points of a piece that pass the filters; also return counts over all its points.

    Raises:
        InputError: the piece is damaged.
        MissingExtra: the file is compressed, and lazrs is not installed.
        OSError: the file cannot be read.
    """
    first, end = address
    with path.open("rb") as file:
        header = read_header(file, warn)
    extras = read_extras(header, warn)
    if header.compressed:
        records = read_compressed_records(path, header, extras, first, end)
    else:
        records = read_records(path, header, extras, first, end - first)
    counts = count_records(records, header)
    return las_fields(filter_records(records, header, filters, True), header, extras, warn), counts


def count_las(path: Path) -> int:
    """Return the number of points in the header; raises the same errors as `describe_las`."""
    with path.open("rb") as file:
        return read_header(file, lambda _: None, allow_empty=True).count


def split(count: int, piece_points: int) -> list[Part]:
    """Divide `count` points into ranges of at most `piece_points`; the address of each is its first point and end."""
    ends = ((first, min(first + piece_points, count)) for first in range(0, count, piece_points))
    return [Part(end - first, (first, end)) for first, end in ends]


def group(counts: Iterable[int], piece_points: int) -> Iterator[tuple[int, int]]:
    """Group consecutive chunks or nodes, and yield the index of the first one and the end of each group.

    Args:
        counts: number of points of each.
        piece_points: largest number of points of a group of more than one.
    """
    first, end, total = 0, 0, 0
    for end, count in enumerate(counts):
        if total and total + count > piece_points:
            yield first, end
            first, total = end, 0
        total += count
    if total:
        yield first, end + 1
