"""Clouds larger than memory: describe a cloud on disk from the headers of its files, and read it piece by piece.

    cloud = Source.open("tiles/").pieces()
    for piece in cloud.pieces:
        points = read_piece(cloud, piece).points

The points of all pieces, in order, are those of `pcbench.read_cloud("tiles/")`, bit by bit.
"""

import os
from collections.abc import Collection

from pcbench.errors import InputError
from pcbench.io.las_records import parse_filters
from pcbench.io.pieces.opening import PIECE_POINTS
from pcbench.io.pieces.reading import read_piece, reading_warnings
from pcbench.io.pieces.types import CloudFile, CloudOnDisk, DamagedFile, Piece, PieceNotes, PiecePoints


def is_in_pieces(path: str | os.PathLike[str]) -> bool:
    """Return whether a path names several files."""
    from pcbench.io.source import Source

    try:
        return Source.open(path).is_in_pieces
    except InputError:
        return False


def open_cloud(
    path: str | os.PathLike[str],
    *,
    classes: Collection[int] | None = None,
    returns: str | Collection[int] | None = None,
    piece_points: int = PIECE_POINTS,
    skip_bad: bool = False,
) -> CloudOnDisk:
    """Return `Source.pieces` of a path."""
    from pcbench.io.source import Source

    return Source.open(path, parse_filters(classes, returns)).pieces(piece_points, skip_bad=skip_bad)


__all__ = [
    "CloudFile",
    "CloudOnDisk",
    "DamagedFile",
    "Piece",
    "PieceNotes",
    "PiecePoints",
    "is_in_pieces",
    "open_cloud",
    "read_piece",
    "reading_warnings",
]
