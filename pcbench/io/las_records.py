"""Point records of LAS: read them from LAS or LAZ, filter them, and convert them to coordinates and normals."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.errors import InputError
from pcbench.geometry.arrays import FloatArray
from pcbench.io import laz
from pcbench.io.las_header import POINT_FORMATS, ExtraDimension, LasHeader
from pcbench.io.names import COLORS, NORMALS, XYZ, standard_names

AXES = ("X", "Y", "Z")


def record_type(header: LasHeader, extras: list[ExtraDimension]) -> np.dtype[Any]:
    """Return the type of a point record. Extra dimensions are named by index, since their own names may be anything."""
    standard = np.dtype(POINT_FORMATS[header.point_format])
    fields = {name: (dtype, byte_offset) for name, (dtype, byte_offset, *_) in (standard.fields or {}).items()}
    byte_offset = standard.itemsize
    for index, extra in enumerate(extras):
        fields[f"extra {index}"] = (np.dtype((extra.dtype, (extra.size,))), byte_offset)
        byte_offset += extra.size * extra.dtype.itemsize
    return np.dtype(
        {
            "names": list(fields),
            "formats": [dtype for dtype, _ in fields.values()],
            "offsets": [offset for _, offset in fields.values()],
            "itemsize": header.record_bytes,
        }
    )


def check_complete(header: LasHeader) -> None:
    """Raise InputError if an uncompressed file is too short for its points."""
    complete = (header.end - header.start) // header.record_bytes
    if complete < header.count:
        raise InputError(f"truncated: got {complete} of {header.count} points: copy or export the file again")


def read_records(
    path: Path, header: LasHeader, extras: list[ExtraDimension], first: int = 0, count: int | None = None
) -> NDArray[Any]:
    """Read `count` uncompressed point records of a file from index `first`; by default all.

    Raises:
        InputError: the file is truncated.
    """
    check_complete(header)
    count = header.count if count is None else count
    return np.fromfile(path, record_type(header, extras), count, offset=header.start + first * header.record_bytes)


def read_compressed_records(
    path: Path, header: LasHeader, extras: list[ExtraDimension], first_chunk: int = 0, end_chunk: int | None = None
) -> NDArray[Any]:
    """Decompress the point records of some chunks of a file; by default all.

    Raises:
        InputError: the compressed data are damaged.
        MissingExtra: lazrs is not installed.
    """
    with path.open("rb") as file:
        chunks = laz.read_chunks(file, header) if header.count else []
    chosen = chunks[first_chunk:end_chunk]
    if not chosen:
        return np.empty(0, record_type(header, extras))
    run = laz.LazRun(path, header, first_chunk, first_chunk + len(chosen), sum(chunk.points for chunk in chosen))
    return laz.decompress([run]).view(record_type(header, extras))


def classes_of(records: NDArray[Any], header: LasHeader) -> NDArray[Any]:
    """Return the class of each point."""
    return records["classification"] if header.is_extended else records["class_flags"] & 31


def returns_of(records: NDArray[Any], header: LasHeader) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return the return number of each point and the number of returns of its pulse."""
    if header.is_extended:
        return records["returns"] & 15, records["returns"] >> 4
    return records["returns"] & 7, records["returns"] >> 3 & 7


def coordinates(records: NDArray[Any], header: LasHeader) -> FloatArray:
    """Return the coordinates (N, 3): stored integers times scale plus offset."""
    points = np.empty((len(records), 3))
    with np.errstate(over="ignore", invalid="ignore"):  # from damaged scales; such points are dropped later
        for column, axis, scale, offset in zip(points.T, AXES, header.scales, header.offsets, strict=True):
            np.multiply(records[axis], scale, out=column)
            column += offset
    return points


def extra_columns(records: NDArray[Any], extras: list[ExtraDimension]) -> Iterator[tuple[str, NDArray[Any]]]:
    """Return named columns (N,) of the extra dimensions: "name", or "name[0]", "name[1]" if it has several numbers."""
    with np.errstate(over="ignore", invalid="ignore"):
        for k, extra in enumerate(extras):
            yield from _columns(extra, records[f"extra {k}"])


def has_normals(extras: list[ExtraDimension]) -> bool:
    """Return whether the extra dimensions contain normals."""
    names = dict.fromkeys(extra.name for extra in extras if extra.size == 1)
    return set(NORMALS) <= set(standard_names(list(names), taken=(*XYZ, *COLORS)))


class LasFilters(NamedTuple):
    """Classes and returns of the points to keep; None keeps all."""

    classes: tuple[int, ...] | None = None
    returns: str | tuple[int, ...] | None = None

    def keep(
        self, classes: NDArray[Any], return_numbers: NDArray[Any], return_counts: NDArray[Any]
    ) -> NDArray[np.bool_]:
        """Return which points pass (N,), from the class, return number and number of returns of each."""
        keep = np.ones(len(classes), dtype=np.bool_)
        if self.classes is not None:
            keep &= np.isin(classes, self.classes)
        if self.returns == "first":
            keep &= return_numbers == 1
        elif self.returns == "last":
            keep &= return_numbers == return_counts
        elif self.returns is not None:
            keep &= np.isin(return_numbers, self.returns)
        return keep

    def __str__(self) -> str:
        named = [("classes", self.classes), ("returns", self.returns)]
        return " and ".join(f"{name} {_listed(value)}" for name, value in named if value is not None)


NO_FILTERS = LasFilters()


def parse_filters(classes: Collection[int] | None, returns: str | Collection[int] | None) -> LasFilters:
    """Check and convert the arguments of `read_cloud`.

    Raises:
        InputError: a class or a return is not a number from 0 to 255.
    """
    return LasFilters(
        None if classes is None else _parse_numbers("classes as", classes),
        returns if returns in (None, "first", "last") else _parse_numbers("returns as 'first', 'last' or", returns),
    )


def no_match_error(filters: LasFilters, classes: NDArray[Any], return_numbers: NDArray[Any]) -> InputError:
    """Return the error of a file in which no point passes the filters."""
    return InputError(
        f"expected points with {filters}, got none: the file has {_format_counts('class', classes)};"
        f" {_format_counts('return', return_numbers)}"
    )


def _listed(wanted: str | Collection[int]) -> str:
    """Return the wanted numbers as text, as on the command line."""
    if isinstance(wanted, str) or not isinstance(wanted, Collection):
        return repr(wanted)
    return ",".join(map(str, wanted)) or "none"


def _parse_numbers(what: str, wanted: str | Collection[int]) -> tuple[int, ...]:
    try:
        numbers = [int(number) for number in (wanted.split(",") if isinstance(wanted, str) else wanted)]
    except (TypeError, ValueError):
        numbers = []
    if not numbers or not all(0 <= number <= 255 for number in numbers):
        raise InputError(f"expected {what} numbers from 0 to 255, such as 2,6; got {_listed(wanted)[:40]}")
    return tuple(numbers)


def _format_counts(what: str, values: NDArray[Any]) -> str:
    counts = np.bincount(values)
    return ", ".join(f"{what} {value} ({counts[value]} points)" for value in np.flatnonzero(counts))


def _columns(extra: ExtraDimension, values: NDArray[Any]) -> list[tuple[str, NDArray[Any]]]:
    """Split the values (N, size) of an extra dimension into named columns."""
    columns = []
    for k in range(extra.size if extra.name else 0):
        raw = values[:, k]
        column = raw.astype(raw.dtype.newbyteorder("="))
        if (extra.scales[k], extra.offsets[k]) != (1.0, 0.0):
            column = column * extra.scales[k] + extra.offsets[k]
        if extra.no_data is not None:
            wide = {"f": "<f8", "i": "<i8", "u": "<u8"}[raw.dtype.kind]
            missing = raw == np.frombuffer(extra.no_data, dtype=wide)[k].astype(raw.dtype)
            if missing.any():
                column = np.where(missing, np.nan, column)
        columns.append((extra.name if extra.size == 1 else f"{extra.name}[{k}]", column))
    return columns
