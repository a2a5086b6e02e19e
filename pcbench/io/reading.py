"""Read the fields of a cloud from one file, or from all its tiles."""

from __future__ import annotations

from pathlib import Path

from pcbench.errors import InputError
from pcbench.geometry.crs import single_unit
from pcbench.io.color_depth import apply_depth
from pcbench.io.files import Fields, Look, Warn, check_readable, errors_named
from pcbench.io.formats import FILTERABLE_EXTENSIONS, CloudFormat, format_of
from pcbench.io.las_records import NO_FILTERS, LasFilters
from pcbench.io.merging import StatedCrs, common_crs, concatenate, merge_warnings
from pcbench.io.paths import TileFiles


def read_one(path: Path, filters: LasFilters, color_depth: int | None, warn: Warn, look: Look) -> Fields:
    """Read the fields of a cloud in one file.

    Args:
        path: the file.
        filters: classes and returns to keep.
        color_depth: significant bits of colours in LAS files and the like, 8 or 16; None: decided by their values.
        warn: callback for warnings, which start with the path.
        look: result of a look at the file.

    Raises:
        InputError: as `pcbench.read_cloud`. The message names the file.
        MissingExtra: an optional library is needed.
    """

    def warn_of_file(line: str) -> None:
        warn(f"{path}: {line}")

    with errors_named(path):
        fields = _read(path, filters, warn_of_file, allow_empty=False, look=look)
        apply_depth([(path, fields)], color_depth, warn_of_file)
    return fields


def read_tiles(path: Path, tiles: TileFiles, filters: LasFilters, color_depth: int | None, warn: Warn) -> Fields:
    """Read the fields of a cloud from its tiles, one after the other; the colour depth is decided for all of them.

    Args:
        path: path of the cloud.
        tiles: its files.
        filters: classes and returns to keep.
        color_depth: as in `read_one`.
        warn: callback for warnings, which start with the path of a file or of the cloud.

    Raises:
        InputError, MissingExtra: as `read_one`; or the files have different coordinate reference systems or units.
    """
    lines = [(path, line) for line in tiles.warnings]

    def warn_of_all(line: str) -> None:
        lines.append((path, line))

    parts = []
    for tile in tiles.paths:
        notes: list[str] = []
        with errors_named(tile):
            parts.append(_read(tile, filters, notes.append, allow_empty=True))
        lines += [(tile, note) for note in notes]
    stated = [StatedCrs(tile, part.get("crs"), part.get("unit")) for tile, part in zip(tiles.paths, parts, strict=True)]
    crs, unit = common_crs(stated, warn_of_all)
    with errors_named(path):
        apply_depth(list(zip(tiles.paths, parts, strict=True)), color_depth, warn_of_all)
    fields = concatenate(parts, warn_of_all)
    if not len(fields["points"]):
        wanted = "at least one point" if filters == NO_FILTERS else f"points with {filters}"
        raise InputError(f"{path}: expected {wanted}, got none in {len(parts)} files")
    fields["crs"], fields["unit"] = crs, unit
    for text in merge_warnings(lines):
        warn(text)
    return fields


def _read(path: Path, filters: LasFilters, warn: Warn, *, allow_empty: bool, look: Look | None = None) -> Fields:
    """Read a file whose format has the wanted filters; messages and warnings do not name the path."""
    check_readable(path)
    form = filtered_format(path, filters)
    options = {} if look is None else look.options
    if form.filtered:
        options = {**filters._asdict(), "allow_empty": allow_empty}
    fields = form.read(path, warn, **options)
    return fields | Fields(unit=stated_unit(path, fields.get("crs"), fields.get("unit"), warn))


def stated_unit(path: Path, crs: str | None, unit: str | None, warn: Warn) -> str | None:
    """Return the unit that a file states, or else that of its coordinate system.

    Args:
        path: the file.
        crs: coordinate system that it states.
        unit: unit that it states; the readers of LAS and EPT have already derived it.
        warn: called if the coordinate system has heights in another unit than x and y.
    """
    return single_unit(crs, warn) if unit is None and not format_of(path).filtered else unit


def filtered_format(path: Path, filters: LasFilters) -> CloudFormat:
    """Return the format of a file, which must have classes and returns if these are filtered.

    Raises:
        InputError: the extension is unknown, or the format cannot be filtered. The message does not name the path.
    """
    form = format_of(path)
    if filters != NO_FILTERS and not form.filtered:
        raise InputError(
            f"expected {', '.join(FILTERABLE_EXTENSIONS)} to filter by classes or returns, got another format"
        )
    return form
