"""How the pieces of each format are found and read."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from pcbench.io.files import Fields, Warn
from pcbench.io.las_checks import LasCounts
from pcbench.io.las_records import LasFilters
from pcbench.io.paths import EPT
from pcbench.io.pieces import las_pieces, other_pieces
from pcbench.io.pieces.types import CloudFile, Part


class PieceFormat(NamedTuple):
    """Functions that raise InputError with messages that do not name the path.

    Attributes:
        describe: (path, largest number of points of a part, warn) to the file and its parts, from headers; also
            `header`, as the reader of the format.
        read: (path, address of a part, filters, warn) to the points that pass the filters, and counts if it is LAS.
        stated_count: path to the number of points that the header states, without other checks; None if it states none.
    """

    describe: Callable[..., tuple[CloudFile, list[Part]]]
    read: Callable[[Path, tuple[int, ...], LasFilters, Warn], tuple[Fields, LasCounts | None]]
    stated_count: Callable[[Path], int | None] = lambda path: None


_LAS = PieceFormat(las_pieces.describe_las, las_pieces.read_las_piece, las_pieces.count_las)
_WHOLE = PieceFormat(other_pieces.describe_whole, other_pieces.read_whole)
_FORMATS = {
    ".las": _LAS,
    ".laz": _LAS,
    ".ply": PieceFormat(other_pieces.describe_ply, other_pieces.read_ply_piece, other_pieces.count_ply),
    ".e57": PieceFormat(other_pieces.describe_e57, other_pieces.read_e57_piece),
    EPT: PieceFormat(other_pieces.describe_ept, other_pieces.read_ept_piece, other_pieces.count_ept),
}


def piece_format(path: Path) -> PieceFormat:
    """Return the format of a file by its name; files of most formats are one piece."""
    return _FORMATS.get(path.name) or _FORMATS.get(path.suffix.lower()) or _WHOLE
