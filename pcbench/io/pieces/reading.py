"""Read the pieces of a cloud on disk."""

from __future__ import annotations

from collections.abc import Iterable

from pcbench.io.pieces.types import CloudOnDisk, Piece, PieceNotes, PiecePoints


def read_piece(cloud: CloudOnDisk, piece: Piece) -> PiecePoints:
    """Read the points of one piece that pass the filters of the cloud and are finite; there may be none.

    Raises:
        InputError: the piece is damaged. The message starts with the path of the file and names the piece.
        MissingExtra: an optional library is needed for the file.
    """
    raise NotImplementedError


def reading_warnings(cloud: CloudOnDisk, notes: Iterable[tuple[Piece, PieceNotes]]) -> tuple[str, ...]:
    """Return what was noticed while reading pieces: one line per file and kind, with counts over all its pieces.

    Args:
        cloud: the cloud.
        notes: pieces that were read, each with its notes, in any order. Checks of a whole file are made if all its
            pieces are there.
    """
    raise NotImplementedError
