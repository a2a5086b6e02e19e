"""Read and write text tables (.xyz, .txt, .csv, ...), one point per line; detect delimiter, header, columns."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pcbench.errors import InputError
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cloud import Cloud
from pcbench.io.ascii_grid import is_ascii_grid, parse_ascii_grid
from pcbench.io.files import MAX_PADDING, Fields, Warn, check_end
from pcbench.io.names import (
    COLORS,
    NORMALS,
    XYZ,
    Columns,
    left_out_warning,
    stored_attributes,
    take_fields,
    take_points,
    unnamed_columns,
)
from pcbench.io.text_layout import NUMBER, TableLayout, content, decode_table, excerpt, find_layout
from pcbench.scratch import atomic_write

_ROWS_PER_WRITE = 1 << 16
# Columns after x, y and z by the extension of the file and the number of columns: Leica's .pts, and Open3D's others.
_EXTENSION_NAMES = {
    (".pts", 4): ("intensity",),
    (".pts", 7): ("intensity", *COLORS),
    (".xyzi", 4): ("intensity",),
    (".xyzn", 6): NORMALS,
    (".xyzrgb", 6): COLORS,
}
_MAX_CLASS = 31  # of the first point formats of LAS; colours of a photograph are brighter
_MAX_ROTATION_ERROR = 1e-3  # relative, of matrices with few digits
_MIN_ID_ROWS = 3  # for a column that counts by one
_MIN_SORTED_ROWS = 100  # for other columns that may be numbers of points


def read_text(path: Path, warn: Warn) -> Fields:
    """Read the points of a text table, or of an ESRI ASCII grid.

    A header (which may be a comment) names the columns, with the names of `names.standard_names`, in any order and with
    units ("X [m]"). Without a header the first three columns are x y z, and three others are colours or normals if
    their values allow nothing else (`names.unnamed_columns`). A first column of four or more that counts up or down by
    one is an id, with a warning. The extensions .pts, .xyzi, .xyzn and .xyzrgb name the columns themselves
    (`_EXTENSION_NAMES`). Each of several blocks with a count is a scan. Other columns are attributes "column_4",
    "column_5" ... Empty lines, text after # or //, and lines after % or ; are skipped; `# crs TEXT` and `# unit TEXT`
    set the crs and unit. `decode_table` lists the encodings.

    Raises:
        InputError: a line is malformed or has another number of values than the first. The message gives its number.
        OSError: the file cannot be read.
    """
    stored = decode_table(path.read_bytes())
    text = stored.rstrip("\0\x1a")
    if "\0" in text:
        raise InputError("expected text, got NUL bytes (a binary file, or UTF-16 without a mark): save it as UTF-8")
    surplus = stored[len(text) :]
    check_end(surplus[:MAX_PADDING].encode(), len(surplus), 1, "the last line", warn)
    lines = text.splitlines()
    if is_ascii_grid(lines):
        return parse_ascii_grid(path, lines, warn).points(warn)
    layout = find_layout(lines)
    for line in layout.warnings:
        warn(line)
    table, scans = _read_blocks(lines, layout, warn)
    if layout.names is None and (matrix := _matrix_kind(table)):
        raise InputError(f"expected a point cloud, got {matrix}: name a cloud")
    names = _column_names(table, layout, path.suffix.lower(), warn)
    if layout.texts:
        warn(f"left out columns of text: {', '.join(repr(names[k][:40]) for k in sorted(layout.texts))}")
    columns: Columns = {
        name: column for k, (name, column) in enumerate(zip(names, table.T, strict=True)) if k not in layout.texts
    }
    points = take_points(columns)
    normals, colors, attributes = take_fields(columns, warn)
    attributes = {name: column.copy() for name, column in attributes.items()}
    if scans is not None:
        attributes.setdefault("scan", scans)
    return Fields(
        points=points, normals=normals, colors=colors, attributes=attributes, crs=layout.crs, unit=layout.unit
    )


# ---- columns without names ----------------------------------------------------------------------------------------


def _column_names(table: FloatArray, layout: TableLayout, extension: str, warn: Warn) -> list[str]:
    """Return the names of the columns: those of the header, or names by number of columns and values."""
    width = table.shape[1]
    if layout.names is not None and len(layout.names) == width:
        return layout.names
    if layout.names is not None:
        if not _counts(table[:, 0]):
            raise InputError(
                f"expected {width} column names, one per value, got {len(layout.names)}: correct the header"
            )
        warn("the first column has no name and counts the lines: it is read as an id")
        return ["id" if "id" not in layout.names else "column_1", *layout.names]
    if (extension, width) in _EXTENSION_NAMES:
        return [*XYZ, *_EXTENSION_NAMES[extension, width]]
    if width > 3 and _counts(table[:, 0]):
        first, last = table[[0, -1], 0]
        warn(
            f"the columns have no names; the first one counts from {first:g} to {last:g} and is read as an id, the next"
            " three as x, y and z: if it is x, name all columns in a first line, such as '# x y z a'"
        )
        return ["id", *_names_by_values(table[:, 1:], 2, warn)]
    if width > 3 and (reason := _doubt(table)):
        warn(
            f"the columns have no names; the first one {reason} and is read as x: if it is not x, name all columns in a"
            " first line, such as '# id x y z'"
        )
    return _names_by_values(table, 1, warn)


def _names_by_values(table: FloatArray, first: int, warn: Warn) -> list[str]:
    names = unnamed_columns(table, first)
    if names is None:
        end = first + table.shape[1]
        warn(
            f"columns {first + 3} to {end - 1} may be colours in two ways and are kept as attributes: name all columns"
            " in a first line, such as '# x y z intensity red green blue'"
        )
        return [*XYZ, *(f"column_{k}" for k in range(first + 3, end))]
    if COLORS[0] in names:
        start = names.index(COLORS[0])
        if (high := table[:, start : start + 3].max()) <= _MAX_CLASS:
            warn(
                f"columns {first + start} to {first + start + 2} have no names and are read as colours, of at most"
                f" {high:g}: if they are classes or returns, name all columns in a first line, such as '# x y z"
                " classification return_number number_of_returns'"
            )
    return names


def _counts(values: FloatArray) -> bool:
    """Return whether a column is whole numbers that count points: by one, or unique in a long table."""
    if len(values) < _MIN_ID_ROWS or not _are_whole(values):
        return False
    steps = np.diff(values)
    if abs(steps[0]) == 1 and (steps == steps[0]).all():
        return True
    if len(values) < _MIN_SORTED_ROWS:
        return False
    # Sorted numbers of a selection of points, or shuffled ones of all points.
    return bool((steps > 0).all() or (np.diff(np.sort(values)) == 1).all())


def _doubt(table: FloatArray) -> str | None:
    """Return why the first column may be no coordinate, or None."""
    if len(table) < _MIN_SORTED_ROWS:
        return None
    if _are_whole(table[:, 0]) and not any(_are_whole(column) for column in table[:, 1:4].T):
        return "has only whole numbers"
    if (np.diff(table[:, 0]) > 0).all():
        return "increases from line to line, as times do,"
    return None


def _are_whole(values: FloatArray) -> bool:
    return bool((values[:100] == np.floor(values[:100])).all() and (values == np.floor(values)).all())


def _matrix_kind(table: FloatArray) -> str | None:
    """Return what the values are if they are the matrix of a lens or of a transform, which no points look like."""
    if table.shape == (3, 3):
        is_camera = (table[[0, 1, 0, 1], [0, 1, 2, 2]] > 0).all() and table[0, 1] == table[1, 0] == 0
        return "a 3x3 camera matrix" if is_camera and table[2].tolist() == [0, 0, 1] else None
    if table.shape not in ((3, 4), (4, 4)) or (len(table) == 4 and table[3].tolist() != [0, 0, 0, 1]):
        return None
    product = table[:3, :3] @ table[:3, :3].T
    scale = product[0, 0]
    is_rotation = scale > 0 and np.abs(product - scale * np.eye(3)).max() < _MAX_ROTATION_ERROR * scale
    return f"a {len(table)}x4 matrix of a transform (--register matrix:FILE)" if is_rotation else None


# ---- numbers ------------------------------------------------------------------------------------------------------


def _read_blocks(lines: list[str], layout: TableLayout, warn: Warn) -> tuple[FloatArray, NDArray[np.int32] | None]:
    """Return all numbers (N, columns), and the block of each row if the file has several that start with a count."""
    if layout.points is None:
        return _table(lines, layout.first, len(lines), layout, warn), None
    counts, starts = [layout.points], [layout.first]
    for index in range(layout.first, len(lines)):
        if (line := lines[index].strip()).isdigit() and len(line) < 19:
            counts.append(int(line))
            starts.append(index + 1)
    ends = [*(start - 1 for start in starts[1:]), len(lines)]
    tables = []
    for count, start, end in zip(counts, starts, ends, strict=True):
        table = _table(lines, start, end, layout, warn)
        if abs(count - len(table)) > 1:
            raise InputError(
                f"truncated: got {len(table)} of {count} points: copy or export the file again"
                if count > len(table)
                else f"line {start}: expected {count} points as stated here, got {len(table)}: export it again"
            )
        if count != len(table):
            warn(f"line {start} states {count} points, {len(table)} follow: read {len(table)}")
        tables.append(table)
    if len(tables) == 1:
        return tables[0], None
    scans = np.repeat(np.arange(len(tables), dtype=np.int32), [len(table) for table in tables])
    return np.concatenate(tables), scans


def _table(lines: list[str], start: int, end: int, layout: TableLayout, warn: Warn) -> FloatArray:
    """Parse the numbers of some lines, (N, columns)."""
    body = lines[start:end]
    first = next((line for line in body if content(line)), None)
    if first is None:
        return np.empty((0, layout.width))
    try:
        if layout.texts:
            raise ValueError
        if layout.plain(first) != first.strip():
            body = [layout.plain(line) for line in body]
        table = np.loadtxt(body, dtype=np.float64, comments=None, delimiter=layout.delimiter, ndmin=2)
        if table.shape[1] == layout.width:
            return table
    except ValueError:
        pass  # comments between points, empty values or a damaged line: parse line by line
    rows, empty = [], 0
    for number, line in enumerate(lines[start:end], start + 1):
        if not content(line):
            continue
        words = layout.words(line)
        gaps = [k for k, word in enumerate(words) if not word and not _is_coordinate(k, layout)]
        for k in gaps:
            words[k] = "nan"
        if not all(NUMBER.fullmatch(word) for word in words):
            raise InputError(f"line {number}: expected numbers, got {excerpt(content(line))}: correct the line")
        if len(words) != layout.width:
            raise InputError(
                f"line {number}: expected {layout.width} values as line {layout.first + 1}, got {len(words)}:"
                " correct it"
            )
        rows.append([float(word) for word in words])
        empty += len(gaps)
    if empty:
        warn(f"read {empty} empty value{'s' * (empty > 1)} of attributes as NaN")
    return np.array(rows, dtype=np.float64)


def _is_coordinate(column: int, layout: TableLayout) -> bool:
    names = layout.names
    return column < 4 if names is None or len(names) != layout.width else names[column] in XYZ


# ---- writer -------------------------------------------------------------------------------------------------------


def write_text(path: Path, cloud: Cloud, warn: Warn) -> None:
    """Write x y z, red green blue, nx ny nz and the attributes; each number is exact.

    .csv files have commas and a header, but no crs and unit. .xyz, .txt and .asc files have spaces, the crs and unit as
    comments, and a header (also a comment) only if there are more columns than x y z.

    Raises:
        InputError: an attribute does not consist of numbers.
        OSError: the file cannot be written; an existing file is then unchanged.
    """
    is_csv = path.suffix.lower() == ".csv"
    columns: Columns = dict(zip(XYZ, cloud.points.T, strict=True))
    if cloud.colors is not None:
        columns |= dict(zip(COLORS, cloud.colors.T, strict=True))
    if cloud.normals is not None:
        columns |= dict(zip(NORMALS, cloud.normals.T, strict=True))
    attributes = stored_attributes(
        cloud.attributes, "text", warn, reserved=set(columns), forbidden=r"^[=+@-]|[^\w!-~]|[,;#\"'%]|//"
    )
    for name, values in attributes.items():
        columns[name] = values.astype(np.uint8) if values.dtype.kind == "b" else values
    if is_csv and (line := left_out_warning(".csv", {"the crs": cloud.crs, "the unit": cloud.unit})):
        warn(line)
    head = [",".join(columns)] if is_csv else []
    if not is_csv:
        head += [
            f"# {tag} {' '.join(text.split())}" for tag, text in (("crs", cloud.crs), ("unit", cloud.unit)) if text
        ]
        head += [f"# {' '.join(columns)}"] if len(columns) > 3 else []
    line = (",".join if is_csv else " ".join)(["%r"] * len(columns)) + "\n"
    with atomic_write(path) as file:
        file.writelines(f"{text}\n".encode() for text in head)
        for start in range(0, len(cloud), _ROWS_PER_WRITE):
            pieces = [column[start : start + _ROWS_PER_WRITE].tolist() for column in columns.values()]
            file.write("".join([line % row for row in zip(*pieces, strict=True)]).encode())
