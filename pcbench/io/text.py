"""Read and write text tables (.xyz, .txt, .asc, .csv, .pts), one point per line; detect delimiter, header, columns."""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.errors import InputError
from pcbench.geometry.cloud import Cloud
from pcbench.io.files import Fields, Warn, atomic_write

_XYZ = ("x", "y", "z")
_NORMALS = ("nx", "ny", "nz")
_COLORS = ("red", "green", "blue")
# Other names of these columns, as in CloudCompare, Agisoft and survey files; not case-sensitive.
_ALIASES = {
    **{"easting": "x", "northing": "y", "elevation": "z", "height": "z"},
    **{"normal_x": "nx", "normal_y": "ny", "normal_z": "nz", "normalx": "nx", "normaly": "ny", "normalz": "nz"},
    **{"r": "red", "g": "green", "b": "blue"},
}
_ALIASES |= {name: name for name in (*_XYZ, *_NORMALS, *_COLORS)}
_COMMENTS = ("#", "//")
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?|[+-]?(nan|inf|infinity)", re.IGNORECASE | re.ASCII)
_DECIMAL_COMMA = re.compile(r"[+-]?\d+,\d+([eE][+-]?\d+)?")
_MAX_NORMAL_LENGTH_ERROR = 0.02  # since normals are often written with two digits
_ROWS_PER_WRITE = 1 << 16

Columns = dict[str, NDArray[np.float64]]


class _Layout(NamedTuple):
    """Layout of a file, detected from its first lines."""

    first: int  # index of the first line of numbers
    delimiter: str | None  # None: spaces and tabs
    names: list[str] | None
    points: int | None  # point count, if the file states it on a separate line
    tags: dict[str, str]


def read_text(path: Path, warn: Warn) -> Fields:
    """Read the points of a text table.

    A header (which may be a comment) names the columns: x y z (or easting, northing, elevation), nx ny nz, and red
    green blue (or r g b) if they are integers from 0 to 255. Other columns are attributes. Without a header the first
    three columns are x y z. Of six columns, the last three are colours if they are integers from 0 to 255, or normals
    if they have unit length. In a .pts file, a fourth of four columns is intensity, and the last four of seven columns
    are intensity and colours. Other columns are attributes "column_4", "column_5" ... Empty lines and text after # or
    // are skipped; `# crs TEXT` and `# unit TEXT` set the crs and unit.

    Raises:
        InputError: a line is malformed or has another number of values than the first. The message gives its number.
        OSError: the file cannot be read.
    """
    data = path.read_bytes()
    if b"\0" in data:
        raise InputError("expected text, got NUL bytes (a binary file or UTF-16): save it as UTF-8")
    lines = data.decode("utf-8-sig", errors="replace").splitlines()
    layout = _layout(lines)
    table = _table(lines, layout)
    if layout.points is not None and layout.points != len(table):
        if layout.points > len(table):
            raise InputError(f"truncated: got {len(table)} of {layout.points} points: copy or export the file again")
        raise InputError(f"expected {layout.points} points as the first line states, got {len(table)}: export it again")
    names = layout.names or _default_names(table, is_pts=path.suffix.lower() == ".pts")
    columns = dict(zip(names, table.T, strict=True))
    points = _pop_columns(columns, _XYZ)
    normals = _pop_columns(columns, _NORMALS) if columns.keys() >= set(_NORMALS) else None
    colors = None
    if columns.keys() >= set(_COLORS) and _are_8_bit(np.stack([columns[name] for name in _COLORS])):
        colors = _pop_columns(columns, _COLORS).astype(np.uint8)
    return Fields(
        points=points,
        normals=normals,
        colors=colors,
        attributes={name: column.copy() for name, column in columns.items()},
        crs=layout.tags.get("crs"),
        unit=layout.tags.get("unit"),
    )


def _pop_columns(columns: Columns, names: tuple[str, str, str]) -> NDArray[np.float64]:
    return np.stack([columns.pop(name) for name in names], axis=1)


def _are_8_bit(values: NDArray[np.float64]) -> bool:
    return bool(((values >= 0) & (values <= 255) & (values == np.floor(values))).all())


def _default_names(table: NDArray[np.float64], is_pts: bool) -> list[str]:
    width = table.shape[1]
    last = table[:, -3:]
    if is_pts and width == 4:
        return [*_XYZ, "intensity"]
    if is_pts and width == 7 and _are_8_bit(last):
        return [*_XYZ, "intensity", *_COLORS]
    if width == 6 and _are_8_bit(last):
        return [*_XYZ, *_COLORS]
    if width == 6:
        with np.errstate(over="ignore", invalid="ignore"):
            unit = np.abs(np.linalg.norm(last, axis=1) - 1) < _MAX_NORMAL_LENGTH_ERROR
        if unit.all():
            return [*_XYZ, *_NORMALS]
    return [*_XYZ, *(f"column_{k}" for k in range(4, width + 1))]


# ---- layout -------------------------------------------------------------------------------------------------------


def _content(line: str) -> str:
    """Return the line without its comment."""
    for mark in _COMMENTS:
        line = line.partition(mark)[0]
    return line.strip()


def _layout(lines: list[str]) -> _Layout:
    """Detect the layout from the comments, header and count before the first line of numbers."""
    header: tuple[int, str] | None = None  # index and text
    comment_header: str | None = None  # a comment that reads like a header
    count: int | None = None
    tags: dict[str, str] = {}
    for index, line in enumerate(lines):
        text = line.strip()
        content = _content(text)
        if not content:
            comment = text.lstrip("#/ \t")
            tag, _, value = comment.partition(" ")
            if tag in ("crs", "unit"):
                tags.setdefault(tag, value.strip())
            elif _has_xyz(comment):
                comment_header = comment
            continue
        delimiter = _delimiter(content)
        words = _split(content, delimiter)
        if all(_NUMBER.fullmatch(word) for word in words):
            if len(words) == 1 and count is None and content.isdigit() and len(content) < 19:
                count = int(content)
                continue
            if len(words) < 3:
                raise InputError(
                    f"line {index + 1}: expected at least 3 columns, got {_excerpt(text)}: export it again"
                )
            if header is not None:
                names: list[str] | None = _header_names(*header, len(words))
            else:
                names = _comment_names(comment_header, len(words))
            return _Layout(index, delimiter, names, count, tags)
        if any(_DECIMAL_COMMA.fullmatch(word) for word in words):
            raise InputError(
                f"line {index + 1}: expected a decimal point, got a comma: {_excerpt(text)}: replace the commas"
            )
        is_header = _has_xyz(content) or not any(_NUMBER.fullmatch(word) for word in words)
        if not is_header or header is not None or count is not None:
            raise InputError(f"line {index + 1}: expected numbers, got {_excerpt(text)}: correct the line")
        header = index, content
    raise InputError(f"expected lines of numbers, got none in {len(lines)} lines: export the file again")


def _delimiter(text: str) -> str | None:
    if ";" in text:
        return ";"
    # "1,5 2,5 3,5" contains commas too, but spaces separate it.
    blanks = text.split()
    if "," in text and not (len(blanks) >= 3 and all(_DECIMAL_COMMA.fullmatch(word) for word in blanks)):
        return ","
    return "\t" if text.count("\t") >= 2 else None


def _split(text: str, delimiter: str | None) -> list[str]:
    return [word.strip() for word in text.split(delimiter)]


def _names(text: str) -> list[str]:
    """Return the standard column names of a header; unknown names are kept, missing ones numbered."""
    plain = [word.strip("\"' ") or f"column_{k}" for k, word in enumerate(_split(text, _delimiter(text)), 1)]
    return [_ALIASES.get(word.lower(), word) for word in plain]


def _has_xyz(text: str) -> bool:
    return set(_XYZ) <= set(_names(text))


def _header_names(index: int, text: str, width: int) -> list[str]:
    names = _names(text)
    if missing := [name for name in _XYZ if name not in names]:
        raise InputError(
            f"line {index + 1}: expected columns x, y, z; missing {', '.join(missing)} in {_excerpt(text)}"
        )
    if len(names) != width:
        raise InputError(
            f"line {index + 1}: expected {width} column names, one per value, got {len(names)}: correct the header"
        )
    if twice := next((name for name in names if names.count(name) > 1), None):
        raise InputError(
            f"line {index + 1}: expected unique column names, got {twice[:40]!r} twice: rename one of them"
        )
    return names


def _comment_names(comment_header: str | None, width: int) -> list[str] | None:
    """Return the column names in a comment, or None if it does not fit the columns (it was prose)."""
    names = _names(comment_header) if comment_header else []
    return names if len(names) == width == len(set(names)) else None


def _excerpt(text: str) -> str:
    return repr(text[:60]) + ("..." if len(text) > 60 else "")


# ---- numbers ------------------------------------------------------------------------------------------------------


def _table(lines: list[str], layout: _Layout) -> NDArray[np.float64]:
    """Parse all numbers, (N, columns)."""
    body = lines[layout.first :]
    width = len(_split(_content(body[0]), layout.delimiter))
    try:
        table = np.loadtxt(body, dtype=np.float64, comments=None, delimiter=layout.delimiter, ndmin=2)
        if table.shape[1] == width:
            return table
    except ValueError:
        pass  # comments between points or a damaged line: parse line by line
    rows = []
    for number, line in enumerate(body, layout.first + 1):
        if content := _content(line):
            words = _split(content, layout.delimiter)
            if not all(_NUMBER.fullmatch(word) for word in words):
                raise InputError(f"line {number}: expected numbers, got {_excerpt(content)}: correct the line")
            if len(words) != width:
                raise InputError(
                    f"line {number}: expected {width} values as line {layout.first + 1}, got {len(words)}: correct it"
                )
            rows.append([float(word) for word in words])
    return np.array(rows, dtype=np.float64)


# ---- writer -------------------------------------------------------------------------------------------------------


def write_text(path: Path, cloud: Cloud, warn: Warn) -> None:
    """Write x y z, red green blue, nx ny nz and the attributes; each number is exact.

    .csv files have commas and a header. .xyz, .txt and .asc files have spaces, the crs and unit as comments, and a
    header (also a comment) only if there are more columns than x y z.

    Raises:
        InputError: an attribute's name or type cannot be stored in a table.
        OSError: the file cannot be written; an existing file is then unchanged.
    """
    is_csv = path.suffix.lower() == ".csv"
    columns = dict(zip(_XYZ, cloud.points.T, strict=True))
    if cloud.colors is not None:
        columns |= dict(zip(_COLORS, cloud.colors.T, strict=True))
    if cloud.normals is not None:
        columns |= dict(zip(_NORMALS, cloud.normals.T, strict=True))
    used_names = set(columns)
    for name, values in cloud.attributes.items():
        known = _ALIASES.get(name.lower(), name)
        if known in used_names:
            raise InputError(f"{path}: attribute {name!r} would be read as {known}: rename it")
        if not name.isprintable() or len(name.split()) != 1 or re.search(r"[,;#\"']|//", name):
            raise InputError(f"{path}: expected attribute names without spaces and delimiters, got {name!r}: rename it")
        if values.dtype.kind not in "biuf":
            raise InputError(
                f"{path}: expected attribute {name!r} as numbers, got {values.dtype}: convert or remove it"
            )
        used_names.add(known)
        columns[name] = values.astype(np.uint8) if values.dtype.kind == "b" else values
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
