"""Read ESRI ASCII grids (.asc) of heights, as points or as a surface; see `height_grids`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pcbench.errors import InputError, reason_of
from pcbench.geometry.mesh import Mesh
from pcbench.io.files import Look, Warn
from pcbench.io.height_grids import ElevationGrid
from pcbench.io.las_crs import WKT, read_crs
from pcbench.io.nodata import is_stated_nodata
from pcbench.io.text_layout import decode_table
from pcbench.regular_files import is_regular_file, read_text

_REQUIRED = ("ncols", "nrows")
_NO_DATA_KEY = "nodata_value"
_KEYS = (*_REQUIRED, "xllcorner", "yllcorner", "xllcenter", "yllcenter", "cellsize", "dx", "dy", _NO_DATA_KEY)
_NO_DATA = -9999.0  # the default of the format
_LOOK_BYTES = 4096
_MAX_SYSTEM_BYTES = 1 << 20


def look_at_ascii_grid(path: Path) -> Look:
    """Look whether a file with the extension .asc is a grid, which is a surface, or a table of points.

    Raises:
        OSError: the file cannot be read.
    """
    with path.open("rb") as file:
        return Look(is_ascii_grid(_lines(file.read(_LOOK_BYTES))))


def read_ascii_grid_mesh(path: Path, warn: Warn) -> Mesh:
    """Read the surface of a grid.

    Raises:
        InputError: the file is no grid, or it is damaged.
        OSError: the file cannot be read.
    """
    lines = _lines(path.read_bytes())
    if not is_ascii_grid(lines):
        raise InputError("expected a mesh, got a table of points: it is a cloud")
    return parse_ascii_grid(path, lines, warn).mesh(warn)


def is_ascii_grid(lines: Sequence[str]) -> bool:
    """Return whether the lines of a text file are an ESRI ASCII grid."""
    first = next((line for line in lines if line.strip()), "")
    return first.split(maxsplit=1)[0].lower() in _REQUIRED if first else False


def parse_ascii_grid(path: Path, lines: Sequence[str], warn: Warn) -> ElevationGrid:
    """Return the grid in the lines of a file, in the coordinate system of a .prj file beside it if it states one.

    Cells have no data if they are NaN or, up to the digits of the text, the value that the header states.

    Args:
        path: the file.
        lines: the lines; commas in them are decimal points.
        warn: callback for warnings.

    Raises:
        InputError: the header is incomplete, or the number of values is not that of the cells.
    """
    if any("," in line for line in lines):
        warn("commas are read as decimal points")
        lines = [line.replace(",", ".") for line in lines]
    header: dict[str, float] = {}
    first = 0
    for first, line in enumerate(lines):
        words = line.split()
        if words and words[0].lower() not in _KEYS:
            break
        if words:
            header[words[0].lower()] = _number(words[1] if len(words) == 2 else "", words[0], first)
    columns, rows = (int(header.get(key, 0)) for key in _REQUIRED)
    if columns < 1 or rows < 1:
        raise InputError("expected an ESRI ASCII grid with ncols and nrows of at least 1: export it again")
    steps = [header.get(key, header.get("cellsize", 0)) for key in ("dx", "dy")]
    if not all(step > 0 for step in steps):
        raise InputError("expected an ESRI ASCII grid with a cellsize above 0: export it again")
    words = " ".join(lines[first:]).split()
    if len(words) != columns * rows:
        state = "truncated: " if len(words) < columns * rows else ""
        raise InputError(f"{state}got {len(words)} of {columns} x {rows} cells: copy or export the file again")
    try:
        z = np.array(words, dtype=np.float64)
    except ValueError as error:
        raise InputError(f"expected heights of cells as numbers: {str(error)[:80]}: export it again") from None
    x, y = (
        (header[f"{axis}llcenter"] if f"{axis}llcenter" in header else header.get(f"{axis}llcorner", 0) + step / 2)
        + step * np.arange(count, dtype=np.float64)
        for axis, step, count in zip("xy", steps, (columns, rows), strict=True)
    )
    z[is_stated_nodata(z, header.get(_NO_DATA_KEY, _NO_DATA))] = np.nan
    return ElevationGrid(x, y[::-1], z.reshape(rows, columns), *_read_system(path, warn))


def _read_system(path: Path, warn: Warn) -> tuple[str | None, str | None]:
    """Return the coordinate reference system in the .prj file beside a grid, and its unit; None if there is none."""
    beside = next((file for end in (".prj", ".PRJ") if is_regular_file(file := path.with_suffix(end))), None)
    if beside is None:
        return None, None
    try:
        text = read_text(beside, _MAX_SYSTEM_BYTES).strip()
    except (InputError, OSError) as error:
        warn(f"left out the coordinate reference system in {beside.name}: {reason_of(error)}")
        return None, None
    if not text.endswith("]"):
        warn(f"left out the coordinate reference system in {beside.name}, which is no WKT")
        return None, None
    return read_crs({WKT: text.encode()}, warn)


def _lines(data: bytes) -> list[str]:
    return decode_table(data).rstrip("\0\x1a").splitlines()


def _number(word: str, key: str, index: int) -> float:
    try:
        value = float(word)
    except ValueError:
        value = np.nan
    if not abs(value) < 1e18 and (key.lower() != _NO_DATA_KEY or not word):
        raise InputError(f"line {index + 1}: expected {key} and a number, got {word[:40]!r}: export the grid again")
    return value
