"""Describe a cloud on disk from the headers of its files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from pcbench.errors import InputError
from pcbench.geometry.arrays import bounds
from pcbench.geometry.crs import degrees_hint
from pcbench.io.files import Look, check_readable, errors_named
from pcbench.io.las_records import LasFilters
from pcbench.io.merging import StatedCrs, common_crs, normals_warning
from pcbench.io.pieces.formats import PieceFormat, piece_format
from pcbench.io.pieces.types import CloudFile, CloudOnDisk, DamagedFile, Piece
from pcbench.io.reading import filtered_format, stated_unit

PIECE_POINTS = 1_000_000


def describe_pieces(
    path: Path,
    paths: Sequence[Path],
    filters: LasFilters,
    piece_points: int,
    *,
    skip_bad: bool,
    notes: Sequence[tuple[Path, str]],
    look: Look,
) -> CloudOnDisk:
    """Describe a cloud on disk from the headers of its files, as `Source.pieces`.

    Args:
        path: path of the cloud.
        paths: its files.
        filters: classes and returns to keep.
        piece_points: largest number of points of a piece.
        skip_bad: whether damaged and missing files are left out.
        notes: warnings about the choice of files, each with a path.
        look: result of a look at the file, if there is one.
    """
    if piece_points < 1:
        raise InputError(f"expected pieces of at least one point, got {piece_points}")
    lines = list(notes)

    def warn(line: str) -> None:
        lines.append((path, line))

    files: list[CloudFile] = []
    pieces: list[Piece] = []
    left_out: list[DamagedFile] = []
    for file in paths:
        with errors_named(file):
            filtered_format(file, filters)  # a wrong name or filter is not damage
        form, warnings = piece_format(file), list[str]()
        try:
            with errors_named(file):
                check_readable(file)
                described, parts = form.describe(file, piece_points, warnings.append, **look.options)
        except InputError as error:
            if not skip_bad:
                raise
            left_out.append(DamagedFile(file, _stated_count(file, form), str(error).removeprefix(f"{file}: ")))
            continue
        unit = stated_unit(file, described.crs, described.unit, warnings.append)
        lines += [(file, line) for line in warnings]
        files.append(replace(described, unit=unit))
        for k, part in enumerate(parts, 1):
            label = f"piece {k} of {len(parts)}" if len(parts) > 1 else ""
            pieces.append(Piece(file, len(pieces), part.points, part.address, label))
    if not files:
        raise InputError(f"{path}: expected at least one file that is not damaged, got none: {left_out[0].reason}")
    if not pieces:
        raise InputError(f"{path}: expected at least one point, got none in {len(files)} files: export them again")
    with_normals = sum(file.has_normals for file in files)
    if 0 < with_normals < len(files):
        warn(normals_warning(with_normals, len(files)))
    crs, unit = common_crs([StatedCrs(file.path, file.crs, file.unit) for file in files], warn)
    corners = [corner for file in files for corner in (file.low, file.high) if corner is not None]
    if crs is None and unit is None and corners and (line := degrees_hint(*bounds(np.array(corners)))):
        warn(line)
    return CloudOnDisk(
        path=path,
        files=tuple(files),
        pieces=tuple(pieces),
        classes=filters.classes,
        returns=filters.returns,
        crs=crs,
        unit=unit,
        has_normals=with_normals == len(files),
        left_out=tuple(left_out),
        file_warnings=tuple(lines),
    )


def _stated_count(path: Path, form: PieceFormat) -> int | None:
    """Return the number of points that the header of a damaged file states, or None if it is unreadable."""
    try:
        return form.stated_count(path)
    except (InputError, OSError):
        return None
