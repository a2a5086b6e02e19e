"""Helpers of all readers: the fields that they return, their warnings and errors, and checks of files."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, TypedDict

import numpy as np
from numpy.typing import NDArray

from pcbench.errors import InputError, lacks_files, reason_of
from pcbench.geometry.arrays import freeze
from pcbench.geometry.cloud import Cloud, Storage
from pcbench.regular_files import regular_status

Warn = Callable[[str], None]

MAX_PADDING = 1 << 16
"""Largest number of bytes after the last record of a file that may be padding."""
_PADDING = b"\0 \t\r\n\x1a"
_LOOK_BYTES = 1 << 12


class Fields(TypedDict, total=False):
    """Fields of a `pcbench.Cloud` as read from a file; points may still be NaN or Inf.

    Colours of LAS are 16-bit until `pcbench.io.color_depth` has seen all files of the cloud. `brightest` is their
    largest value before filters.
    """

    points: NDArray[Any]
    normals: NDArray[Any] | None
    colors: NDArray[Any] | None
    attributes: Mapping[str, NDArray[Any]]
    crs: str | None
    unit: str | None
    stored: Storage | None
    brightest: int


class Look(NamedTuple):
    """Result of a look at a file, before it is read.

    Attributes:
        holds_mesh: whether it holds a mesh, and not only points.
        header: its header, if the readers of its format accept one, which they then do not read again.
    """

    holds_mesh: bool
    header: Any = None

    @property
    def options(self) -> dict[str, Any]:
        """Arguments for the readers of the format."""
        return {} if self.header is None else {"header": self.header}


def report_warnings(lines: Iterable[str], on_warning: Warn | None) -> None:
    """Give warnings to a callback, or else to `warnings.warn`, attributed to the caller of the calling function."""
    for line in lines:
        if on_warning is None:
            warnings.warn(line, stacklevel=3)
        else:
            on_warning(line)


@contextmanager
def errors_named(name: object) -> Iterator[None]:
    """Prefix the messages of errors that the block raises with the name of a file.

    Raises:
        InputError: the block raised InputError, OSError or MemoryError.
        OSError: too many files are open.
    """
    try:
        yield
    except InputError as error:
        raise InputError(f"{name}: {error}") from error
    except OSError as error:
        if lacks_files(error):  # the file is not damaged
            raise
        raise InputError(f"{name}: cannot be read: {reason_of(error)}") from error
    except MemoryError as error:
        raise InputError(f"{name}: does not fit into memory: crop or downsample the file") from error


def finite_cloud(fields: Fields, warn: Warn) -> Cloud:
    """Build a cloud from the fields of a reader, without points whose coordinates are NaN or Inf.

    Nothing else uses the arrays, so they are frozen and the cloud keeps them without a copy.
    """
    arrays = [fields["points"], fields.get("normals"), fields.get("colors"), *fields.get("attributes", {}).values()]
    for array in arrays:
        if array is not None:
            freeze(array)
    count = len(fields["points"])
    cloud, dropped = Cloud.from_finite(**fields)
    if dropped:
        warn(dropped_warning(dropped, count))
    return cloud


def dropped_warning(dropped: int, count: int) -> str:
    """Return the warning that points of a cloud were dropped because they are not finite."""
    return f"dropped {dropped} of {count} points with NaN or Inf coordinates"


def as_path(value: object) -> Path:
    """Convert an argument to a `Path`.

    Raises:
        InputError: the argument is not a path.
    """
    if isinstance(value, str | os.PathLike):
        return Path(value)
    raise InputError(f"expected the path of a file, got {type(value).__name__}")


def check_readable(path: Path) -> None:
    """Check that a file can contain a cloud or mesh, before its reader opens it.

    Raises:
        InputError: the path does not exist, is a folder or not a regular file, or the file is empty.
        OSError: the file status cannot be read.
    """
    try:
        status = regular_status(path)
    except FileNotFoundError:
        raise InputError("no such file: check the name and the folder") from None
    if not status.st_size:
        raise InputError("expected a point cloud or mesh, got an empty file (0 bytes): copy or export it again")


def read_rest(file: BinaryIO) -> NDArray[np.uint8]:
    """Read all bytes from the current position to the end of the file into one buffer of exactly that size."""
    start = file.tell()
    rest = np.empty(file.seek(0, 2) - start, dtype=np.uint8)
    file.seek(start)
    got = file.readinto(rest.data)  # type: ignore[attr-defined]
    return rest[:got]


def with_line_feeds(file: BinaryIO, most: int) -> BinaryIO:
    """Return a file at its start, or its first `most` bytes with line feeds for the carriage returns of old Macs.

    Only the first line is looked at. Positions in both are the same.
    """
    start = file.read(_LOOK_BYTES)
    file.seek(0)
    first = start.find(b"\r")
    if first < 0 or b"\n" in start[: first + 2]:
        return file
    return BytesIO(file.read(most).replace(b"\r", b"\n"))


def check_end(rest: bytes, size: int, record_bytes: int, last: str, warn: Warn) -> None:
    """Check what follows the last record of a file: line breaks, padding and less than a record, or more records.

    Padding (NUL bytes and spaces) and less than a record are left out with a warning, as other readers do in silence.

    Args:
        rest: the bytes after the last record, or at least the first `MAX_PADDING` of them.
        size: number of all bytes after the last record.
        record_bytes: size of the smallest record.
        last: what precedes them, such as "the last point".
        warn: callback for the warning.

    Raises:
        InputError: the bytes may be further records.
    """
    if size <= MAX_PADDING and not rest.strip():
        return
    if size >= record_bytes and (size > MAX_PADDING or rest.strip(_PADDING)):
        raise InputError(f"expected the end of the file after {last}, got {size} more bytes: export it again")
    warn(f"left out {size} byte{'s' * (size > 1)} after {last}")
