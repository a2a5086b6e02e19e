"""Clouds larger than memory: describe a cloud on disk from the headers of its files, and read it piece by piece.

    cloud = open_cloud("tiles/")
    for piece in cloud.pieces:
        points = read_piece(cloud, piece).points

The points of all pieces, in order, are those of `pcbench.read_cloud("tiles/")`, bit by bit.
"""

from pcbench.io.pieces.opening import is_in_pieces, open_cloud
from pcbench.io.pieces.reading import read_piece, reading_warnings
from pcbench.io.pieces.types import CloudFile, CloudOnDisk, DamagedFile, Piece, PieceNotes, PiecePoints

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
