"""Read the fields of a cloud from one file, or from all its tiles."""

from __future__ import annotations

from collections.abc import Collection
from functools import partial
from pathlib import Path
from typing import Any

from pcbench.errors import InputError
from pcbench.geometry.crs import single_unit
from pcbench.io.colmap import model_file
from pcbench.io.color_depth import apply_depth
from pcbench.io.files import Fields, Warn, errors_named, read_named
from pcbench.io.formats import CLOUDS, FILTERABLE_EXTENSIONS, CloudFormat, format_of
from pcbench.io.las_records import parse_filters
from pcbench.io.paths import EPT, find_tiles, is_tiled
from pcbench.io.tiles import StatedCrs, common_crs, concatenate, merge_warnings
from pcbench.regular_files import has_entry


def cloud_file(path: Path, warn: Warn | None = None) -> Path:
    """Return the points file of a COLMAP model or the ept.json in a folder; return any other path unchanged.

    Args:
        path: path of a cloud.
        warn: callback, called with one line, without the path, if the folder holds several models.
    """
    file = model_file(path, warn)
    return path / EPT if file == path and path.is_dir() and has_entry(path / EPT) else file


def read_fields(
    path: Path,
    warn: Warn,
    classes: Collection[int] | None = None,
    returns: str | Collection[int] | None = None,
    color_depth: int | None = None,
) -> Fields:
    """Read the fields of a cloud from a file, or one after the other from its tiles.

    Args:
        path: path of a cloud, see `cloud_file`.
        warn: callback for warnings, which start with the path of a file.
        classes: class numbers to keep.
        returns: returns to keep.
        color_depth: significant bits of colours in LAS files and the like, 8 or 16; None: decided for the whole cloud.

    Raises:
        InputError: as `pcbench.read_cloud`. The message names the file.
        MissingExtra: an optional library is needed.
    """
    filters: dict[str, Any] = {"classes": classes, "returns": returns} if (classes, returns) != (None, None) else {}

    def read_file(file: Path, warn: Warn) -> Fields:
        fields = filtered_format(file, bool(filters)).read(file, warn, **filters)
        return fields | Fields(unit=stated_unit(file, fields.get("crs"), fields.get("unit"), warn))

    def read_tile(file: Path, warn: Warn) -> Fields:
        form = filtered_format(file, bool(filters))
        fields = form.read(file, warn, **filters, allow_empty=True) if form.filtered else form.read(file, warn)
        return fields | Fields(unit=stated_unit(file, fields.get("crs"), fields.get("unit"), warn))

    if not is_tiled(path):
        fields = read_named(path, read_file, warn)
        with errors_named(path):
            apply_depth([(path, fields)], color_depth, lambda line: warn(f"{path}: {line}"))
        return fields
    with errors_named(path):
        tiles = find_tiles(path, CLOUDS)
    lines = [(path, line) for line in tiles.warnings]

    def warn_of_all(line: str) -> None:
        lines.append((path, line))

    parts = [read_named(tile, read_tile, partial(_keep, lines, tile)) for tile in tiles.paths]
    stated = [StatedCrs(tile, part.get("crs"), part.get("unit")) for tile, part in zip(tiles.paths, parts, strict=True)]
    crs, unit = common_crs(stated, warn_of_all)
    with errors_named(path):
        apply_depth(list(zip(tiles.paths, parts, strict=True)), color_depth, warn_of_all)
    fields = concatenate(parts, warn_of_all)
    if not len(fields["points"]):
        wanted = f"points with {parse_filters(classes, returns)}" if filters else "at least one point"
        raise InputError(f"{path}: expected {wanted}, got none in {len(parts)} files")
    fields["crs"], fields["unit"] = crs, unit
    for text in merge_warnings(lines):
        warn(text)
    return fields


def _keep(lines: list[tuple[Path, str]], path: Path, text: str) -> None:
    lines.append((path, text.removeprefix(f"{path}: ")))


def stated_unit(path: Path, crs: str | None, unit: str | None, warn: Warn) -> str | None:
    """Return the unit that a file states, or else that of its coordinate system.

    Args:
        path: the file.
        crs: coordinate system that it states.
        unit: unit that it states; the readers of LAS and EPT have already derived it.
        warn: called if the coordinate system has heights in another unit than x and y.
    """
    return single_unit(crs, warn) if unit is None and not format_of(path).filtered else unit


def filtered_format(path: Path, has_filters: bool) -> CloudFormat:
    """Return the format of a file, which must have classes and returns if these are filtered.

    Raises:
        InputError: the extension is unknown, or the format cannot be filtered. The message does not name the path.
    """
    form = format_of(path)
    if has_filters and not form.filtered:
        raise InputError(
            f"expected {', '.join(FILTERABLE_EXTENSIONS)} to filter by classes or returns, got another format"
        )
    return form


def has_filters(path: Path) -> bool:
    """Return whether all files of a cloud have classes and returns, by which they can be filtered."""
    path = cloud_file(path)
    try:
        files = find_tiles(path, CLOUDS).paths if is_tiled(path) else (path,)
    except (InputError, OSError):
        return False  # its reader reports the error
    return all(file.name in FILTERABLE_EXTENSIONS or file.suffix.lower() in FILTERABLE_EXTENSIONS for file in files)
