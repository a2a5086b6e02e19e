"""Describe a cloud on disk from the headers of its files."""

from __future__ import annotations

import os
from collections.abc import Collection
from dataclasses import replace
from pathlib import Path

import numpy as np

from pcbench.errors import InputError
from pcbench.geometry.arrays import bounds
from pcbench.geometry.crs import degrees_hint
from pcbench.io.files import as_path, check_readable, errors_named
from pcbench.io.formats import CLOUDS
from pcbench.io.las_records import LasFilters, parse_filters
from pcbench.io.paths import EPT, TileFiles, find_tiles, is_tiled
from pcbench.io.pieces.formats import PieceFormat, piece_format
from pcbench.io.pieces.types import CloudFile, CloudOnDisk, DamagedFile, Piece
from pcbench.io.reading import cloud_file, filtered_format, stated_unit
from pcbench.io.tiles import StatedCrs, common_crs, normals_warning

PIECE_POINTS = 1_000_000


def is_in_pieces(path: str | os.PathLike[str]) -> bool:
    """Return whether a path names several files: a folder of tiles, a pattern, a `.vpc` index, or an EPT folder."""
    file = cloud_file(Path(path))
    return is_tiled(file) or file.name == EPT


def open_cloud(
    path: str | os.PathLike[str],
    *,
    classes: Collection[int] | None = None,
    returns: str | Collection[int] | None = None,
    piece_points: int = PIECE_POINTS,
    skip_bad: bool = False,
) -> CloudOnDisk:
    """Describe a cloud on disk from the headers of its files; points are only read from formats without such a header.

    Args:
        path: a path that `pcbench.read_cloud` accepts.
        classes: class numbers to keep, as in `pcbench.read_cloud`.
        returns: returns to keep, as in `pcbench.read_cloud`.
        piece_points: largest number of points of a piece, if the format allows it: a LAZ chunk, an EPT node, an E57
            scan and a text file are never divided.
        skip_bad: whether damaged and missing files are left out and listed in `left_out`.

    Raises:
        InputError: a file is damaged or missing, or no file is left; files have different coordinate reference systems
            or units; or a filter is not available for a format. The message names the file.
        MissingExtra: an optional library is needed for a file.
    """
    if piece_points < 1:
        raise InputError(f"expected pieces of at least one point, got {piece_points}")
    named, lines = as_path(path), list[tuple[Path, str]]()
    path = cloud_file(named, lambda line: lines.append((named, line)))
    filters = parse_filters(classes, returns)
    with errors_named(path):
        if is_tiled(path):
            tiles = find_tiles(path, CLOUDS)
        else:
            check_readable(path)
            tiles = TileFiles((path,))
    lines += [(path, line) for line in tiles.warnings]

    def warn(line: str) -> None:
        lines.append((path, line))

    files: list[CloudFile] = []
    pieces: list[Piece] = []
    left_out: list[DamagedFile] = []
    for file in tiles.paths:
        with errors_named(file):
            filtered_format(file, filters != LasFilters())  # a wrong name or filter is not damage
        form, notes = piece_format(file), list[str]()
        try:
            with errors_named(file):
                check_readable(file)
                described, parts = form.describe(file, piece_points, notes.append)
        except InputError as error:
            if not skip_bad:
                raise
            left_out.append(DamagedFile(file, _stated_count(file, form), str(error).removeprefix(f"{file}: ")))
            continue
        unit = stated_unit(file, described.crs, described.unit, notes.append)
        lines += [(file, note) for note in notes]
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
