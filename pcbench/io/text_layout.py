"""Layout of a text table: delimiter, header, units, point count and notation of numbers, from its first lines."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterable, Sequence
from contextlib import suppress
from typing import NamedTuple

from pcbench.errors import InputError
from pcbench.io.names import XYZ, other_coordinates, repeated_name, standard_names
from pcbench.regular_files import decode_text, encoding_of

NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?|[+-]?(nan|inf|infinity)", re.IGNORECASE | re.ASCII)
_FORTRAN_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)[dD][+-]?\d+", re.ASCII)
_DECIMAL_COMMA = re.compile(r"[+-]?\d+,\d+([eEdD][+-]?\d+)?", re.ASCII)
_WITH_COMMAS = re.compile(r"[+-]?\d[\d.]*(,[\d.]+)+([eEdD][+-]?\d+)?", re.ASCII)
_THOUSANDS = re.compile(r"[+-]?\d{1,3}(,\d{3})+", re.ASCII)
_MISSING = ("na", "n/a", "null", "none", "-")  # words for an empty value, in lower case
_COMMENTS = ("#", "//")
_COMMENT_LINES = ("%", ";")  # only at the start of a line
_UNIT = re.compile(r"(.+?)[\[(]([^\[\]()\d][^\[\]()]*)[\])]")  # "X[m]"; the digits of "a[0]" are no unit
_UNIT_WORD = re.compile(
    r"[\[(]?(m|mm|cm|dm|km|ft|in|us-?ft|ftus|met(?:er|re)s?|f(?:ee|oo)t|inch(?:es)?|deg(?:rees?)?|°)[\])]?",
    re.IGNORECASE,
)
_GEOGRAPHIC = {"longitude": "x", "lon": "x", "long": "x", "latitude": "y", "lat": "y"}
_WGS84 = "EPSG:4326"


class TableLayout(NamedTuple):
    """Layout of a text table.

    Attributes:
        first: index of the first line of numbers.
        delimiter: delimiter of the numbers; None: spaces and tabs.
        width: number of values on a line.
        names: names of the columns, or None. One less than the values if the lines start with their number.
        points: number of points, if the file states it on a separate line.
        crs: coordinate reference system, if the file states it.
        unit: unit of the coordinates, if the file states it.
        decimal_comma: whether commas are decimal points.
        ends_with_delimiter: whether a delimiter follows the last value of a line.
        texts: indices of the columns of text, which a header names.
        warnings: lines on what is unusual.
    """

    first: int
    delimiter: str | None
    width: int
    names: list[str] | None
    points: int | None
    crs: str | None
    unit: str | None
    decimal_comma: bool
    ends_with_delimiter: bool
    texts: frozenset[int]
    warnings: tuple[str, ...]

    def words(self, line: str) -> list[str]:
        """Return the values of a line in Python's notation; those in columns of text are "nan", empty ones ""."""
        text = content(line) if self.texts else self.plain(line)
        words = cells(text, self.delimiter, self.width)
        words = ["nan" if k in self.texts else word for k, word in enumerate(words)]
        return ["" if is_missing(word) else self._notation(word) for word in words]

    def plain(self, line: str) -> str:
        """Return a line of numbers without comment, quotes and trailing delimiter, in Python's notation."""
        text = content(line).replace('"', "")
        if self.delimiter is not None and self.ends_with_delimiter:
            text = text.removesuffix(self.delimiter)
        return self._notation(text)

    def _notation(self, text: str) -> str:
        return (text.replace(",", ".") if self.decimal_comma else text).replace("D", "e").replace("d", "e")


class _TableHeader(NamedTuple):
    names: list[str]
    unit: str | None
    crs: str | None
    warnings: list[str]


def decode_table(data: bytes) -> str:
    """Return the text of a table, in UTF-8, in UTF-16 with a byte order mark, or in the Windows code page 1252."""
    try:
        return decode_text(data)
    except UnicodeDecodeError:  # a spreadsheet on Windows wrote it, or UTF-16 is cut off
        encoding = encoding_of(data)
        return data.decode(encoding if encoding == "utf-16" else "cp1252", errors="replace")


def find_layout(lines: list[str]) -> TableLayout:
    """Detect the layout from the comments, header, units and count before the first line of numbers.

    Raises:
        InputError: there is no line of numbers, the lines before it are no header, or numbers have thousands
            separators. The message gives the line.
    """
    header: tuple[int, str] | None = None  # index and text
    comment: str | None = None  # a comment that reads like a header
    units: list[str] = []
    texts: frozenset[int] = frozenset()
    count: int | None = None
    tags: dict[str, str] = {}
    for index, line in enumerate(lines):
        text = line.strip()
        numbers = content(line)
        if not numbers:
            remark = text.lstrip("#/%; \t")
            tag, _, value = remark.partition(" ")
            if tag in ("crs", "unit"):
                tags.setdefault(tag, value.strip())
            elif _has_xyz(remark):
                comment = remark
            continue
        delimiter = find_delimiter(numbers)
        if delimiter is None and header is not None and _are_tabbed(header[1], numbers):
            delimiter = "\t"
        words = split(numbers, delimiter)
        is_value = [is_missing(word) or _is_number(word, delimiter) for word in words]
        if all(is_value) and any(_is_number(word, delimiter) for word in words):
            if len(words) == 1 and count is None and numbers.strip().isdigit() and len(numbers) < 19:
                count = int(numbers)
                continue
            if len(words) < 3:
                raise InputError(f"line {index + 1}: expected at least 3 columns, got {excerpt(text)}: export it again")
            break
        if header is not None and not units and is_units_row(words):
            units = words
            continue
        column_names = header[1] if header is not None else comment
        if column_names is not None and (texts := _text_columns(column_names, numbers, delimiter)):
            words = cells(numbers, delimiter, len(_words_of(column_names)))
            break
        is_header = _has_xyz(numbers) or not any(NUMBER.fullmatch(word) for word in words)
        if not is_header or header is not None or count is not None:
            remedy = ", or name the columns in a first line, such as 'name x y z'" if sum(is_value) >= 3 else ""
            raise InputError(f"line {index + 1}: expected numbers, got {excerpt(text)}: correct the line{remedy}")
        header = index, numbers
    else:
        raise InputError(f"expected lines of numbers, got none in {len(lines)} lines: export the file again")

    warnings: list[str] = []
    ends_with_delimiter = not texts and numbers.endswith(delimiter or "\n")
    named = _words_of(header[1] if header else comment or "")
    if ends_with_delimiter and len(named) == len(words) + 1:  # the last value is empty
        ends_with_delimiter = False
        words.append("")
    if header is not None:
        table_header: _TableHeader | None = _read_header(*header, len(words), units)
    else:
        table_header = _read_comment(comment, len(words), warnings)
    if ends_with_delimiter:
        warnings.append("left out the empty column after the delimiter at the end of each line")
    decimal_comma = delimiter != "," and _has_decimal_commas(lines[index:], delimiter)
    if decimal_comma:
        warnings.append("commas are read as decimal points")
    pairs = re.split(r",\s+", numbers)
    if delimiter == "," and len(pairs) >= 3 and all(map(_DECIMAL_COMMA.fullmatch, pairs)):
        raise InputError(
            f"line {index + 1}: expected decimal points, got commas in numbers and between them: {excerpt(text)}:"
            " export it with semicolons between the numbers"
        )
    if delimiter == "," and not texts and '"' in numbers and any(map(_has_quoted_comma, lines[index:])):
        raise InputError(f"line {index + 1}: expected numbers without commas, got {excerpt(text)}: remove the commas")
    return TableLayout(
        first=index,
        delimiter=delimiter,
        width=len(words),
        names=table_header and table_header.names,
        points=count,
        crs=tags.get("crs") or (table_header and table_header.crs),
        unit=tags.get("unit") or (table_header and table_header.unit),
        decimal_comma=decimal_comma,
        ends_with_delimiter=ends_with_delimiter,
        texts=texts,
        warnings=(*(table_header.warnings if table_header else ()), *warnings),
    )


def content(line: str) -> str:
    """Return a line without its comment; tabs at its end stay, since they may delimit an empty value."""
    for mark in _COMMENTS:
        line = line.partition(mark)[0]
    line = line.lstrip()
    return "" if line.startswith(_COMMENT_LINES) else line.rstrip(" \r\n\xa0")


def find_delimiter(text: str) -> str | None:
    """Return the delimiter of a line; None: spaces and tabs."""
    if ";" in text:
        return ";"
    # "1,5 2,5 3,5" contains commas too, but spaces separate it.
    blanks = text.split()
    if "," in text and not (len(blanks) >= 3 and all(_is_number(word, None) for word in blanks)):
        return ","
    # Tabs separate names with blanks, and empty values.
    tabs = text.split("\t")
    return "\t" if len(tabs) >= 3 and len(tabs) != len(blanks) and not all(map(NUMBER.fullmatch, blanks)) else None


def _are_tabbed(header: str, row: str) -> bool:
    """Return whether tabs divide a row, of which some values may be empty, as they divide the header."""
    return row.count("\t") == header.count("\t") >= 2


def split(text: str, delimiter: str | None) -> list[str]:
    """Return the words of a line; a trailing delimiter ends the last one."""
    text = text if delimiter is None else text.removesuffix(delimiter)
    return [word.strip().strip("\"'").strip() for word in text.split(delimiter)]


def cells(text: str, delimiter: str | None, width: int) -> list[str]:
    """Return the words of a line with texts, in which a delimiter within quotes is part of a word.

    An empty word after `width` others is left out: a delimiter ends the line.
    """
    words = text.split(delimiter)
    if delimiter is not None and '"' in text:
        with suppress(csv.Error):  # a word that is too long
            (words,) = csv.reader([text], delimiter=delimiter, skipinitialspace=True)
    words = [word.strip() for word in words]
    return words[:-1] if len(words) == width + 1 and not words[-1] else words


def is_missing(word: str) -> bool:
    """Return whether a word stands for an empty value."""
    return not word or word.lower() in _MISSING


def excerpt(text: str) -> str:
    """Return the start of a line, for an error message."""
    return repr(text[:60]) + ("..." if len(text) > 60 else "")


# ---- numbers ------------------------------------------------------------------------------------------------------


def _is_number(word: str, delimiter: str | None) -> bool:
    kinds = (NUMBER, _FORTRAN_NUMBER) if delimiter == "," else (NUMBER, _FORTRAN_NUMBER, _WITH_COMMAS)
    return any(kind.fullmatch(word) for kind in kinds)


def _has_quoted_comma(line: str) -> bool:
    return any("," in part for part in line.split('"')[1::2])


def _has_decimal_commas(lines: Iterable[str], delimiter: str | None) -> bool:
    """Return whether commas are decimal points.

    Raises:
        InputError: they separate thousands, or may do so.
    """
    words = [
        word
        for line in lines
        if "," in line
        for word in split(content(line), delimiter)
        if _WITH_COMMAS.fullmatch(word)
    ]
    if wrong := next((word for word in words if not _DECIMAL_COMMA.fullmatch(word)), None):
        raise InputError(f"expected numbers without thousands separators, got {wrong[:40]}: export it without them")
    if words and all(map(_THOUSANDS.fullmatch, words)):
        raise InputError(
            f"expected decimal points, got commas that may also separate thousands: {words[0][:40]}: export it without"
            " commas"
        )
    return bool(words)


# ---- header -------------------------------------------------------------------------------------------------------


def is_units_row(words: Sequence[str]) -> bool:
    """Return whether the words of a line below a header are the units of its columns, such as `m;m;m`."""
    unit_words = sum(_UNIT_WORD.fullmatch(word) is not None for word in words)
    return unit_words >= 3 and all(len(word) <= 20 and not NUMBER.fullmatch(word) for word in words)


def _words_of(header: str) -> list[str]:
    header = re.sub(r"(?<!\s)\s+(?=[\[(])", "", header)  # "X [m]" is one word
    return [word or f"column_{k}" for k, word in enumerate(split(header, find_delimiter(header)), 1)]


def _names(words: list[str]) -> tuple[list[str], list[str]]:
    """Return the standard names of a header and the unit in each; unknown names are kept."""
    parts = [match.groups() if (match := _UNIT.fullmatch(word)) else (word, "") for word in words]
    names, units = [name.strip() for name, _ in parts], [unit.strip() for _, unit in parts]
    names = words if len(set(names)) < len(set(words)) else names
    plain = [name.lower() for name in names]
    if not {"x", "y"} & set(plain) and sum(name in _GEOGRAPHIC for name in plain) == 2:
        names = [_GEOGRAPHIC.get(name.lower(), name) for name in names]
    return names, units


def _without_unit(word: str) -> str:
    match = _UNIT.fullmatch(word)
    return word if match is None else match[1].strip()


def _has_xyz(text: str) -> bool:
    names = _names(_words_of(text))[0]
    return set(XYZ) <= set(standard_names(list(dict.fromkeys(names))))


def _text_columns(header: str, row: str, delimiter: str | None) -> frozenset[int]:
    """Return the indices of the words of a row that are text; none unless the header names x, y and z as numbers."""
    names = _names(_words_of(header))[0]
    words = cells(row, delimiter, len(names))
    if len(names) != len(words) or len(set(names)) < len(names):
        return frozenset()
    texts = {k for k, word in enumerate(words) if not is_missing(word) and not _is_number(word, delimiter)}
    standard = standard_names(names)
    return frozenset(texts) if not texts & {standard.index(axis) for axis in XYZ if axis in standard} else frozenset()


def _read_header(index: int, text: str, width: int, units_row: list[str]) -> _TableHeader:
    """Return the names of the columns, in which repeated names are numbered, and what they say of the coordinates.

    Raises:
        InputError: coordinates are missing or named twice, are in different units, or the number of names is wrong.
    """
    words = _words_of(text)
    names, units = _names(words)
    unique, seen = list(names), set[str]()
    for position, name in enumerate(names):
        if name in seen and name.lower() not in XYZ:
            unique[position] = f"{name}_{position + 1}"
        seen.add(name)
    if twice := repeated_name(unique):
        raise InputError(
            f"line {index + 1}: expected unique column names, got {twice[:40]!r} twice: rename one of them"
        )
    standard = standard_names(unique)
    if missing := [name for name in XYZ if name not in standard]:
        raise InputError(
            f"line {index + 1}: expected columns x, y, z; missing {', '.join(missing)} in {excerpt(text)}: name the"
            " columns in this line"
        )
    # `split` drops one empty unit at the end of the row, since a delimiter may end each line.
    if units_row and len(units_row) == len(names) - 1:
        units_row = [*units_row, ""]
    if len(names) not in (width, width - 1) or (units_row and len(units_row) != len(names)):
        raise InputError(
            f"line {index + 1}: expected {width} column names, one per value, got {len(names)}: correct the header"
        )
    warnings = []
    if repeated := len(set(unique) - set(names)):
        warnings.append(f"numbered {repeated} repeated column name{'s' * (repeated > 1)}")
    if others := other_coordinates(unique):
        chosen = [unique[standard.index(axis)] for axis in XYZ]
        warnings.append(
            f"the columns {', '.join(chosen)} are read as x, y and z, and {', '.join(others)} as attributes: rename"
            " them to exchange them"
        )
    stated = {(units_row or units)[standard.index(axis)].strip("[]()") for axis in XYZ}
    if is_geographic := any(
        _without_unit(word).lower() in _GEOGRAPHIC and standard[position] in XYZ for position, word in enumerate(words)
    ):
        warnings.append(f"longitude and latitude are read as x and y in degrees ({_WGS84})")
    elif len(stated) > 1 and "" not in stated:
        raise InputError(
            f"line {index + 1}: expected x, y and z in one unit, got {', '.join(sorted(stated))[:60]}: convert them to"
            " one unit"
        )
    unit = next(iter(stated)) if len(stated) == 1 and not is_geographic else ""
    return _TableHeader(standard, unit or None, _WGS84 if is_geographic else None, warnings)


def _read_comment(comment: str | None, width: int, warnings: list[str]) -> _TableHeader | None:
    """Return the header in a comment, or None if it does not fit the columns."""
    names = _words_of(comment) if comment else []
    try:
        if comment and len(names) == width:
            return _read_header(0, comment, width, [])
    except InputError:
        pass  # prose
    if names and [name.lower() for name in names[:3]] != list(XYZ):
        warnings.append(
            f"the comment {excerpt(comment or '')} names {len(names)} columns, but the lines have {width}: x, y and z"
            " are taken from the first three"
        )
    return None
