"""Read the pieces of a cloud on disk."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from pcbench.errors import InputError
from pcbench.geometry.arrays import MAX_COORDINATE
from pcbench.io.files import dropped_warning, errors_named
from pcbench.io.formats import format_of
from pcbench.io.las_checks import LasCounts
from pcbench.io.las_records import LasFilters
from pcbench.io.merging import merge_warnings
from pcbench.io.nodata import CoordinateCounts, Nodata, nodata_warning
from pcbench.io.pieces.formats import piece_format
from pcbench.io.pieces.types import CloudOnDisk, Piece, PieceNotes, PiecePoints


def read_piece(cloud: CloudOnDisk, piece: Piece) -> PiecePoints:
    """Read the points of one piece that pass the filters of the cloud and are finite; there may be none.

    Args:
        cloud: the cloud of the piece; `CloudOnDisk.without_pieces` is enough.
        piece: the piece.

    Raises:
        InputError: the piece is damaged. The message starts with the path of the file and names the piece.
        MissingExtra: an optional library is needed for the file.
    """
    lines: list[str] = []
    filters = LasFilters(cloud.classes, cloud.returns)
    with errors_named(f"{piece.file}: {piece.label}" if piece.label else piece.file):
        fields, counts = piece_format(piece.file).read(piece.file, piece.address, filters, lines.append)
        points = np.ascontiguousarray(fields["points"], dtype=np.float64)
        normals = fields.get("normals") if cloud.has_normals else None
        attributes = fields.get("attributes", {}) if format_of(piece.file).filtered else {}
        classification = attributes.get("classification")
        if cloud.has_normals and normals is None:
            if len(points):
                raise InputError("expected points with normals, got points without: the file has changed")
            normals = np.empty((0, 3))
        total = len(points)
        finite = np.isfinite(points).all(axis=1)
        if not finite.all():
            points = points[finite]
            normals = None if normals is None else normals[finite]
            classification = None if classification is None else classification[finite]
        if (largest := np.abs(points).max(initial=0.0)) > MAX_COORDINATE:
            raise InputError(f"expected coordinates up to {MAX_COORDINATE:g}, got {largest:g}; larger squares overflow")
    notes = PieceNotes(len(points), total - len(points), CoordinateCounts.of(points), counts, tuple(lines))
    return PiecePoints(
        points,
        None if normals is None else np.ascontiguousarray(normals, dtype=np.float64),
        None if classification is None else classification.astype(np.uint8),
        notes,
    )


def reading_warnings(cloud: CloudOnDisk, notes: Iterable[tuple[Piece, PieceNotes]]) -> tuple[str, ...]:
    """Return what was noticed while reading pieces, in the lines of `pcbench.read_cloud`, without `cloud.warnings`.

    Args:
        cloud: the cloud with its files.
        notes: pieces that were read, each with its notes, in any order. Checks of a whole file are made if all its
            pieces are there.
    """
    ordered = sorted(notes, key=lambda pair: pair[0].number)
    lines = [(piece.file, line) for piece, note in ordered for line in note.lines]
    counts: dict[Path, LasCounts] = {}
    for piece, note in ordered:
        if note.las is not None:
            counts[piece.file] = counts[piece.file].merge(note.las) if piece.file in counts else note.las
    headers = {file.path: file.las_header for file in cloud.files}
    for path, merged in counts.items():
        lines += [(path, line) for line in merged.warnings(headers[path])]
    finite, dropped = sum(note.finite for _, note in ordered), sum(note.dropped for _, note in ordered)
    if dropped:
        lines.append((cloud.path, dropped_warning(dropped, finite + dropped)))
    if line := nodata_warning(Nodata.of(CoordinateCounts.merge(note.coordinates for _, note in ordered))):
        lines.append((cloud.path, line))
    from_headers = set(cloud.file_warnings)
    return tuple(merge_warnings(pair for pair in lines if pair not in from_headers))
