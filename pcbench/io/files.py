"""Helpers of all formats: the fields that readers return, checks of paths, and atomic writing."""

from __future__ import annotations

import json
import os
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, TypedDict

import numpy as np
from numpy.typing import NDArray

from pcbench.errors import InputError, lacks_files, reason_of
from pcbench.geometry.arrays import freeze
from pcbench.geometry.cloud import Cloud, Storage
from pcbench.io.paths import find_tiles, is_pattern, is_tiled
from pcbench.regular_files import read_bytes, regular_status
from pcbench.scratch import scratch_file
from pcbench.systems import rename_open

Warn = Callable[[str], None]

_MAX_JSON_BYTES = 1 << 30  # for results and cameras
MAX_PADDING = 1 << 16
"""Largest number of bytes after the last record of a file that may be padding."""
_PADDING = b"\0 \t\r\n\x1a"


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
    """What a look at a file tells before it is read.

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


def read_json(path: Path) -> Any:
    """Parse a JSON file.

    Raises:
        InputError: the file is not a regular file, not JSON, or nested too deeply. The message does not name the path.
        OSError: the file cannot be read.
    """
    try:
        return json.loads(read_bytes(path, _MAX_JSON_BYTES).decode("utf-8-sig"))
    except UnicodeDecodeError:
        raise InputError("expected JSON, got a binary file: choose the .json file") from None
    except InputError:  # also a ValueError, but its message is complete
        raise
    except RecursionError:
        raise InputError("expected JSON, got JSON that is nested too deeply") from None
    except ValueError as error:
        raise InputError(f"expected JSON: {error}") from None


def read_json_object(path: Path) -> dict[str, Any]:
    """Parse a JSON file that contains an object; return {} if it contains something else or cannot be read."""
    try:
        values = read_json(path)
    except (OSError, InputError):
        return {}
    return values if isinstance(values, dict) else {}


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


def input_files(path: Path) -> list[Path]:
    """Return the files of a pattern or a `.vpc` index, including the index; a folder or file is returned itself.

    Raises:
        InputError: the index is damaged, or no file matches. The message starts with the path.
    """
    if path.is_dir() or not is_tiled(path):
        return [path]
    try:
        return [*([] if is_pattern(path) else [path]), *find_tiles(path, ()).paths]
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def check_output(path: Path, inputs: Sequence[Path], others: Sequence[Path] = ()) -> None:
    """Check before a computation that a result can be written to a path.

    Args:
        path: output file.
        inputs: input files, and folders in which no file may be replaced.
        others: other outputs, which must differ from this one.

    Raises:
        InputError: the folder does not exist, or an input or another result would be replaced.
    """
    target = path.resolve()
    for input_path in (file for named in inputs for file in input_files(named)):
        if target == input_path.resolve() or (path.exists() and target.is_relative_to(input_path.resolve())):
            raise InputError(f"{path}: the result would replace an input: choose another name")
    if any(target == other.resolve() for other in others):
        raise InputError(f"{path}: two results would be written to this file: give each its own name")
    if path.is_dir():
        raise InputError(f"{path}: expected a file name, got a folder: name a file inside it")
    if path.exists() and not path.is_file():
        raise InputError(f"{path}: expected a regular file, got a device or a pipe: choose another name")
    if not path.absolute().parent.is_dir():
        raise InputError(f"{path}: expected a file name in an existing folder: create the folder or choose another one")


@contextmanager
def atomic_write(path: Path) -> Iterator[BinaryIO]:
    """Open a temporary binary file that is renamed to `path` once complete. On any error `path` stays unchanged.

    Raises:
        OSError: the file cannot be written; the temporary file is removed.
    """
    target = path.resolve()  # follow a symbolic link, as open() does
    if target.exists() and not target.is_file():
        raise OSError(f"cannot write to {path}: it is a folder or a device")
    with scratch_file(path) as (temporary, file):
        yield file
        rename_open(file, temporary, target)


def estimate_reading_seconds(path: Path) -> float:
    """Estimate the seconds needed to read a file of points, for progress bars; 0 if the file does not exist."""
    try:
        size = path.stat().st_size
    except OSError:
        return 0.0
    return 0.02 + size / (20e6 if path.suffix.lower() in (".laz", ".txt", ".xyz", ".csv", ".pts", ".asc") else 200e6)
