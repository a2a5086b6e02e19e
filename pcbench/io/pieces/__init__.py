"""Clouds larger than memory: describe a cloud on disk from the headers of its files, and read it piece by piece.

    cloud = open_cloud("tiles/")
    for piece in cloud.pieces:
        points = read_piece(cloud, piece).points

The points of all pieces, in order, are those of `pcbench.read_cloud("tiles/")`, bit by bit.
"""

import os
from collections.abc import Collection

from pcbench.io.las_records import parse_filters
from pcbench.io.pieces.opening import PIECE_POINTS
from pcbench.io.pieces.reading import read_piece, reading_warnings
from pcbench.io.pieces.types import CloudFile, CloudOnDisk, DamagedFile, Piece, PieceNotes, PiecePoints

__all__ = [
    "CloudFile",
    "CloudOnDisk",
    "DamagedFile",
    "Piece",
    "PieceNotes",
    "PiecePoints",
    "open_cloud",
    "read_piece",
    "reading_warnings",
]


def open_cloud(
    path: str | os.PathLike[str],
    *,
    classes: Collection[int] | None = None,
    returns: str | Collection[int] | None = None,
    piece_points: int = PIECE_POINTS,
    skip_bad: bool = False,
) -> CloudOnDisk:
    """Describe a cloud on disk from the headers of its files, as `pcbench.io.source.Source.pieces`.

    Args:
        path: a path that `pcbench.read_cloud` accepts.
        classes: class numbers to keep, as in `pcbench.read_cloud`.
        returns: returns to keep, as in `pcbench.read_cloud`.
        piece_points: largest number of points of a piece, as far as the format allows.
        skip_bad: whether damaged and missing files are left out and listed in `left_out`.

    Raises:
        InputError, MissingExtra: see `Source.open` and `Source.pieces`.
    """
    from pcbench.io.source import Source  # it uses this package

    return Source.open(path, parse_filters(classes, returns)).pieces(piece_points, skip_bad=skip_bad)
