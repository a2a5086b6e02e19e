"""Read PTX files of terrestrial scanners (Leica and others): the grids of one or more scans, each with its pose.

A scan has two lines with its numbers of columns and rows, four with the position and axes of the scanner, four with the
matrix from scanner to world coordinates, which row vectors are multiplied by, and one line per direction: x, y, z,
intensity and, if it has colours, red, green and blue. Directions without a return are 0 0 0. Lengths are in metres.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pcbench.errors import InputError
from pcbench.geometry.arrays import FloatArray
from pcbench.io.columns import excerpt, parse_rows
from pcbench.io.files import Fields, Warn
from pcbench.io.names import COLORS, XYZ, Columns, take_fields, take_points

_HEADER_LINES = 10
_MATRIX_LINES = slice(6, 10)
_NAMES = {3: XYZ, 4: (*XYZ, "intensity"), 7: (*XYZ, "intensity", *COLORS)}  # by number of values on a line
_WIDTHS = {"intensity": 4, "colours": 7}  # of the narrowest lines with these values
_MAX_DIRECTIONS = 10**12  # more than any file has lines


class _Scan(NamedTuple):
    """Grid of a scan: the numbers of its columns and rows, its matrix (4, 4), and the index of its first line."""

    columns: int
    rows: int
    matrix: FloatArray
    first: int

    @property
    def directions(self) -> int:
        return self.columns * self.rows


def read_ptx(path: Path, warn: Warn) -> Fields:
    """Read all scans, transformed into world coordinates; the attribute `scan` is the index if there are several.

    Raises:
        InputError: a header is damaged, or there are fewer lines than it states. The message gives the line.
        OSError: the file cannot be read.
    """
    lines = path.read_bytes().rstrip(b"\0\x1a \t\r\n").splitlines()
    tables: list[FloatArray] = []
    indices: list[int] = []
    start = scans = directions = 0
    while start < len(lines):
        scan = _parse_header(lines, start)
        start = scan.first + scan.directions
        table = _table(lines[scan.first : start], scan)
        table = table[table[:, :3].any(axis=1)]
        with np.errstate(over="ignore", invalid="ignore"):  # points with huge numbers are dropped later
            table[:, :3] = table[:, :3] @ scan.matrix[:3, :3] + scan.matrix[3, :3]
        if len(table):
            tables.append(table)
            indices.append(scans)
        scans, directions = scans + 1, directions + scan.directions
        while start < len(lines) and not lines[start].strip():
            start += 1
    if not tables:
        raise InputError(
            f"expected at least one point, got none in {directions} directions of {scans} scans: export it again"
        )
    counts = [len(table) for table in tables]
    if missing := directions - sum(counts):
        warn(f"left out {missing} of {directions} directions without a return")
    width = min(table.shape[1] for table in tables)
    if poorer := sum(table.shape[1] == width for table in tables) % len(tables):
        lost = " and ".join(name for name in ("intensity", "colours") if _WIDTHS[name] > width)
        warn(f"left out {lost}, which {poorer} of {len(tables)} scans lack")
    columns: Columns = dict(zip(_NAMES[width], np.concatenate([t[:, :width] for t in tables]).T, strict=True))
    points = take_points(columns)
    _, colors, attributes = take_fields(columns, warn)
    attributes = {name: values.copy() for name, values in attributes.items()}
    if scans > 1:
        attributes["scan"] = np.repeat(np.array(indices, np.int32), counts)
    return Fields(points=points, colors=colors, attributes=attributes, unit="m")


def _parse_header(lines: Sequence[bytes], start: int) -> _Scan:
    if len(lines) < start + _HEADER_LINES:
        raise InputError(
            f"truncated: expected {_HEADER_LINES} header lines from line {start + 1}, got {len(lines) - start}: copy or"
            " export the file again"
        )
    counts = [line.strip() for line in lines[start : start + 2]]
    if not all(count.isdigit() and int(count[:13]) > 0 for count in counts):
        raise InputError(
            f"line {start + 1}: expected the numbers of columns and rows of a scan, each above 0 on its own line, got"
            f" {excerpt(counts[0])} and {excerpt(counts[1])}: export it again as PTX"
        )
    columns, rows = (int(count[:13]) for count in counts)
    first = start + _HEADER_LINES
    if columns * rows > min(len(lines) - first, _MAX_DIRECTIONS):
        raise InputError(
            f"truncated: got {len(lines) - first} of {columns} x {rows} lines of the scan from line {start + 1}: copy"
            " or export the file again"
        )
    matrix = parse_rows(lines[start : start + _HEADER_LINES][_MATRIX_LINES], 4, lambda k: f"line {start + 7 + k}")
    if not (np.isfinite(matrix).all() and np.array_equal(matrix[:, 3], [0, 0, 0, 1])):
        raise InputError(
            f"line {start + 7}: expected a matrix whose last column is 0 0 0 1, got {matrix[:, 3].tolist()}: export the"
            " file again"
        )
    return _Scan(columns, rows, matrix, first)


def _table(lines: Sequence[bytes], scan: _Scan) -> FloatArray:
    """Return the values of the directions of a scan (N, columns)."""
    width = len(lines[0].split())
    if width not in _NAMES:
        raise InputError(
            f"line {scan.first + 1}: expected x y z intensity, or also red green blue, got {excerpt(lines[0])}: export"
            " it again as PTX"
        )
    return parse_rows(lines, width, lambda k: f"line {scan.first + 1 + k}")
