"""Files of check points: positions that were surveyed independently of a cloud, to test its accuracy.

Columns are found by their names, and the delimiter and the decimal point by the first lines, because every total
station and spreadsheet writes another file.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.errors import InputError, reason_of
from pcbench.geometry.arrays import FloatArray
from pcbench.io.text_layout import NUMBER, decode_table, is_units_row
from pcbench.regular_files import read_bytes

_NAMES = {  # of columns, in lower case, without unit
    "name": ("name", "id", "point", "pt", "point_id", "pointid", "nr", "no", "number", "station", "label", "punkt"),
    "x": ("x", "e", "easting", "east", "rechtswert", "ostwert", "point_x"),
    "y": ("y", "n", "northing", "north", "hochwert", "nordwert", "point_y"),
    "z": ("z", "h", "height", "elevation", "elev", "alt", "altitude", "höhe", "hoehe", "höjd", "hojd", "point_z"),
    "class": ("class", "land_cover", "landcover", "cover", "klasse"),
    "sigma": ("sigma",),
    "sigma_xy": ("sigma_xy",),
    "sigma_z": ("sigma_z",),
}
_COLUMNS = {alias: column for column, aliases in _NAMES.items() for alias in aliases}
_DEGREES = ("lon", "long", "longitude", "lat", "latitude")
_OPEN = ("nva", "non_vegetated", "open", "bare", "ground", "urban", "road", "pavement", "asphalt", "concrete", "gravel")
_VEGETATED = ("vva", "vegetated", "vegetation", "grass", "crops", "shrub", "brush", "weeds", "trees", "forest")
_IS_VEGETATED = {
    **dict.fromkeys((*_OPEN, "2", "6", "11"), False),  # ground, building and road surface in LAS
    **dict.fromkeys((*_VEGETATED, "3", "4", "5"), True),  # low, medium and high vegetation
}
_MAX_POINTS = 20_000  # each keeps 256 points of the cloud
_WITHOUT_HEADER = {3: ("x", "y", "z"), 4: ("name", "x", "y", "z")}
_COMMENTS = ("#", "//", "%")
_DECIMAL_COMMA = re.compile(r"[+-]?\d+,\d+")
_UNIT = re.compile(r"[\[(][^\[(]*[\])]$")  # of a column's name, as in "x [m]"
EXPECTED = "a header line that names the columns (name, x, y, z), or lines of `name x y z` or `x y z` without one"


@dataclass(frozen=True, eq=False)
class CheckPoints:
    """Check points as surveyed.

    Attributes:
        path: the file.
        names: their names, all different.
        points: (N, 3) x, y and z.
        vegetated: (N,) whether the ground has vegetation, so that the point tests vegetated vertical accuracy (VVA).
        sigma_xy: (N,) standard error of x and of y, in the unit of the coordinates; NaN if not stated.
        sigma_z: (N,) standard error of z; NaN if not stated.
        measured: (N, 3) position of the same target as measured in the cloud; NaN if not measured.
        notes: sentences on what was assumed.
    """

    path: Path
    names: tuple[str, ...]
    points: FloatArray
    vegetated: NDArray[np.bool_]
    sigma_xy: FloatArray
    sigma_z: FloatArray
    measured: FloatArray
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.names)


class _Line(NamedTuple):
    """A line with values: its number, and its cells."""

    number: int
    cells: list[str]


def read_check_points(path: str | Path) -> CheckPoints:
    """Read check points from a text file.

    Columns are found by name (name, x, y, z, or easting, northing, height; class; sigma, or sigma_xy and sigma_z;
    measured_x, measured_y, measured_z), in capitals or not, behind a comment sign or not. Without a header, lines are
    `name x y z` or `x y z`. The delimiter is a semicolon, a tab, a comma or blanks, and may also end each line. Commas
    are decimal points unless they delimit the columns. A row of units below the header is skipped.

    Args:
        path: the file, in an encoding of `decode_table`.

    Raises:
        InputError: the file has another form. The message starts with the path, and names the line and what to do.
    """
    path = Path(path)
    try:
        text = decode_table(read_bytes(path))
        if "\0" in text:
            raise InputError("expected a text file, got a binary file: export the points as CSV")
    except (InputError, OSError) as error:
        raise InputError(f"{path}: cannot read the check points: {reason_of(error)}") from error
    try:
        return _parse(path, text.splitlines())
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def _parse(path: Path, lines: Sequence[str]) -> CheckPoints:
    content = [(number, line.strip()) for number, line in enumerate(lines, 1) if line.strip()]
    delimiter = _delimiter([text for _, text in content if not text.startswith(_COMMENTS)])
    header = _header(content, delimiter)
    rows = [line for line in _rows(content, delimiter) if header is None or line.number > header.number]
    units = rows.pop(0) if header is not None and rows and is_units_row(rows[0].cells) else None
    if header is None and rows and all(not row.cells[-1] for row in rows):
        rows = [_Line(row.number, row.cells[:-1]) for row in rows]  # a delimiter ends each line
    if not rows:
        raise InputError(f"expected at least one check point, got none in {len(lines)} lines: expected {EXPECTED}")
    if len(rows) > _MAX_POINTS:
        raise InputError(
            f"expected at most {_MAX_POINTS:,} check points, got {len(rows):,}: a cloud is measured against another by"
            " pcbench compare"
        )
    notes: list[str] = []
    if header is not None:
        columns = _columns_of(header)
        if units is not None:
            _check_units(units, columns)
            notes.append(f"Line {units.number} of {path.name} was taken as the units of its columns.")
    else:
        columns = _columns_without_header(rows[0])
        notes.append(f"{path.name} has no header: its columns were taken as {', '.join(columns)}.")
    if _uses_decimal_commas(delimiter, (row.cells for row in rows)):
        notes.append(f"Commas in {path.name} were taken as decimal points.")
    return _points_of(path, rows, _Table(columns, decimal_comma=delimiter != ","), notes)


def _delimiter(lines: Sequence[str]) -> str | None:
    """Return the delimiter of the columns; None: blanks."""
    if not lines:
        return None
    sample = lines[: min(len(lines), 20)]
    for delimiter in (";", "\t"):
        if all(delimiter in line for line in sample):
            return delimiter
    decimal = [sum(_DECIMAL_COMMA.fullmatch(word) is not None for word in line.split()) for line in sample]
    return None if max(decimal) >= 3 or not all("," in line for line in sample) else ","


def has_decimal_commas(lines: Sequence[str]) -> bool:
    """Return whether commas are decimal points in lines of surveyed points, since something else delimits columns."""
    delimiter = _delimiter(lines)
    return _uses_decimal_commas(delimiter, (line.split(delimiter) for line in lines))


def _uses_decimal_commas(delimiter: str | None, rows: Iterable[Sequence[str]]) -> bool:
    return delimiter != "," and any(_DECIMAL_COMMA.fullmatch(cell.strip()) for row in rows for cell in row)


def _split(line: str, delimiter: str | None) -> list[str]:
    if delimiter is None:
        return [word.strip("\"'") for word in line.split()]
    try:
        (cells,) = csv.reader([line], delimiter=delimiter, skipinitialspace=True)
    except csv.Error as error:
        raise InputError(f"expected lines of columns, got {line[:60]!r} ({error}): export the points as CSV") from error
    return [cell.strip().strip("'") for cell in cells]


def _rows(content: Sequence[tuple[int, str]], delimiter: str | None) -> Iterator[_Line]:
    for number, text in content:
        if text.startswith(_COMMENTS):
            continue
        cells = _split(text, delimiter)
        if any(cells):
            yield _Line(number, cells)


def _header(content: Sequence[tuple[int, str]], delimiter: str | None) -> _Line | None:
    """Return the line that names the columns: the first one, or a comment before it."""
    for number, text in content:
        is_comment = text.startswith(_COMMENTS)
        line = text.lstrip("#/% \t") if is_comment else text
        for cells in (_split(line, delimiter), line.split()) if is_comment else (_split(line, delimiter),):
            named = {column for cell in cells if (column := _column(cell)) is not None}
            if {"x", "y", "z"} <= named:
                return _Line(number, list(cells))
        if is_comment:
            continue
        if any(_plain(cell) in _DEGREES for cell in cells):
            raise InputError(
                f"line {number}: expected coordinates in a unit of length, got {text[:60]!r}: project the check points"
                " to the coordinate system of the cloud"
            )
        if sum(NUMBER.fullmatch(cell.replace(",", ".")) is not None for cell in cells) >= 3:
            return None
        raise InputError(f"line {number}: expected {EXPECTED}, got {text[:60]!r}: name the columns")
    return None


def _plain(cell: str) -> str:
    """Return the name of a column in lower case, without its unit, with underscores for blanks."""
    return re.sub(r"[\s\-.]+", "_", _UNIT.sub("", cell.strip().lower()).strip())


def _column(cell: str) -> str | None:
    """Return the column that a name in a header stands for, if any."""
    plain = _plain(cell)
    bare = plain.removeprefix("measured_").removesuffix("_measured")
    column = _COLUMNS.get(bare)
    if bare == plain or column is None:
        return column
    return f"measured_{column}" if column in ("x", "y", "z") else None


def _columns_of(header: _Line) -> dict[str, int]:
    columns: dict[str, int] = {}
    for index, cell in enumerate(header.cells):
        if (column := _column(cell)) is None:
            continue
        if column in columns:
            first = header.cells[columns[column]]
            raise InputError(
                f"line {header.number}: expected one column for {column}, got {first!r} and {cell!r}: rename one"
            )
        columns[column] = index
    return columns


def _check_units(row: _Line, columns: dict[str, int]) -> None:
    """Raise InputError if x, y and z have different units."""
    cells = [row.cells[columns[axis]].strip("[]()") for axis in "xyz" if columns[axis] < len(row.cells)]
    if len(stated := {cell.lower() for cell in cells if cell}) > 1:
        raise InputError(
            f"line {row.number}: expected x, y and z in one unit, got {', '.join(sorted(stated))[:60]}: convert them to"
            " one unit"
        )


def _columns_without_header(row: _Line) -> dict[str, int]:
    names = _WITHOUT_HEADER.get(len(row.cells))
    if names is None:
        raise InputError(f"line {row.number}: expected {EXPECTED}, got {len(row.cells)} columns: add a header line")
    return {name: index for index, name in enumerate(names)}


class _Table(NamedTuple):
    """How cells are read: the index of each column, and whether commas are decimal points."""

    columns: dict[str, int]
    decimal_comma: bool

    def text(self, row: _Line, column: str) -> str:
        """Return the text of a cell; empty if there is none."""
        index = self.columns.get(column)
        return "" if index is None or index >= len(row.cells) else row.cells[index].strip()

    def number(self, row: _Line, column: str, *, required: bool = False) -> float:
        """Return the number in a cell; NaN if it is empty.

        Raises:
            InputError: it is no finite number, or is required and missing.
        """
        text = self.text(row, column)
        if not text and not required:
            return np.nan
        plain = text.replace(",", ".") if self.decimal_comma else text
        if NUMBER.fullmatch(plain) is None or not np.isfinite(value := float(plain)):
            got = repr(text) if text else "nothing"
            raise InputError(
                f"line {row.number}: expected {column} as a finite number, got {got}: correct or remove the line"
            )
        return value


def _points_of(path: Path, rows: Sequence[_Line], table: _Table, notes: list[str]) -> CheckPoints:
    names: dict[str, int] = {}
    points, measured, sigmas, vegetated, unclassed = [], [], [], [], 0
    for count, row in enumerate(rows, 1):
        name = table.text(row, "name") or str(count)
        if name in names:
            raise InputError(
                f"line {row.number}: the name {name!r} is also on line {names[name]}: give each check point its own"
                " name"
            )
        names[name] = row.number
        points.append([table.number(row, axis, required=True) for axis in "xyz"])
        measured.append([table.number(row, f"measured_{axis}") for axis in "xyz"])
        sigma = [table.number(row, column) for column in ("sigma", "sigma_xy", "sigma_z")]
        if any(value < 0 for value in sigma):
            raise InputError(
                f"line {row.number}: expected a standard error of at least 0, got {min(sigma)}: correct it"
            )
        sigmas.append([sigma[0] if np.isnan(value) else value for value in sigma[1:]])
        kind = table.text(row, "class")
        unclassed += not kind
        vegetated.append(_is_vegetated(kind, row.number))
    if "class" not in table.columns:
        notes.append("No column `class`: all check points count as non-vegetated.")
    elif unclassed:
        notes.append(f"{unclassed} of {len(rows)} check points have no class and count as non-vegetated.")
    positions = np.array(measured)
    if len(lacking := np.flatnonzero(np.isnan(positions[:, 0]) != np.isnan(positions[:, 1]))):
        raise InputError(
            f"line {rows[lacking[0]].number}: expected both measured_x and measured_y, got one: add the other"
        )
    xy, z = np.array(sigmas).T
    return CheckPoints(path, tuple(names), np.array(points), np.array(vegetated), xy, z, positions, tuple(notes))


def _is_vegetated(kind: str, number: int) -> bool:
    plain = _plain(kind)
    if plain and plain not in _IS_VEGETATED:
        raise InputError(
            f"line {number}: expected the class nva (such as open, urban, road) or vva (such as grass, shrub, forest),"
            f" got {kind!r}: correct it, or rename the column if it is no land cover"
        )
    return _IS_VEGETATED.get(plain, False)
