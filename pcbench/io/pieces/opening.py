"""Describe a cloud on disk from the headers of its files."""

from __future__ import annotations

import os
from collections.abc import Collection

from pcbench.io.pieces.types import CloudOnDisk

PIECE_POINTS = 1_000_000


def is_in_pieces(path: str | os.PathLike[str]) -> bool:
    """Return whether a path names several files: a folder of tiles, a pattern, a `.vpc` index or an EPT folder."""
    raise NotImplementedError


def open_cloud(
    path: str | os.PathLike[str],
    *,
    classes: Collection[int] | None = None,
    returns: str | Collection[int] | None = None,
    piece_points: int = PIECE_POINTS,
    skip_bad: bool = False,
) -> CloudOnDisk:
    """Describe a cloud on disk from the headers of its files; no points are read.

    Args:
        path: a path that `pcbench.read_cloud` accepts.
        classes: class numbers to keep, as in `pcbench.read_cloud`.
        returns: returns to keep, as in `pcbench.read_cloud`.
        piece_points: largest number of points of a piece, if the format allows it: a LAZ chunk, an EPT node, an E57 scan
            and a text file are never divided.
        skip_bad: whether files with a damaged header are left out and listed in `left_out`.

    Raises:
        InputError: a file is damaged or missing, or no file is left; files have different coordinate reference systems
            or units; or a filter is not available for a format. The message starts with the path of the file.
        MissingExtra: an optional library is needed for a file.
    """
    raise NotImplementedError
