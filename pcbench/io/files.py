"""What all formats share: the fields a reader returns, checks before a file is opened, and writing all or nothing."""

from __future__ import annotations

import hashlib
import json
import os
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO, TypedDict, TypeVar

import numpy as np
from numpy.typing import NDArray

from pcbench.errors import InputError
from pcbench.geometry.arrays import freeze
from pcbench.geometry.cloud import Cloud
from pcbench.regular_files import open_regular, read_bytes, regular_status
from pcbench.scratch import scratch_file
from pcbench.systems import rename_open

Warn = Callable[[str], None]
T = TypeVar("T")

_MAX_JSON_BYTES = 1 << 30  # of results and cameras
_NAMING_A_FILE = ("matrix", "points", "polygon")  # kinds of settings that do


class Fields(TypedDict, total=False):
    """The fields of a `pcbench.Cloud` as a file gives them: points may still be NaN or Inf."""

    points: NDArray[Any]
    normals: NDArray[Any] | None
    colors: NDArray[np.uint8] | None
    attributes: Mapping[str, NDArray[Any]]
    crs: str | None
    unit: str | None


def read_json(path: Path) -> Any:
    """What a JSON file holds.

    Raises:
        InputError: it is no regular file, no JSON, or nested too deeply; the message does not name the path.
        OSError: it cannot be read.
    """
    try:
        return json.loads(read_bytes(path, _MAX_JSON_BYTES).decode("utf-8-sig"))
    except UnicodeDecodeError:
        raise InputError("expected JSON, got a binary file") from None
    except InputError:  # a ValueError too, but it says all already
        raise
    except RecursionError:
        raise InputError("expected JSON, got some that is nested too deeply to be read") from None
    except ValueError as error:
        raise InputError(f"expected JSON: {error}") from None


def json_object(path: Path) -> dict[str, Any]:
    """The object that a JSON file holds; empty where it holds something else, or cannot be read."""
    try:
        values = read_json(path)
    except (OSError, InputError):
        return {}
    return values if isinstance(values, dict) else {}


def read_named(path: Path, read: Callable[[Path, Warn], T], on_warning: Warn | None) -> T:
    """What a reader makes of a file; its errors and warnings start with the path.

    Args:
        path: an existing file.
        read: called with the path and a function that takes warnings, each a line without the path.
        on_warning: called with each warning; `warnings.warn` if None, which names the caller of the function that
            called this one.

    Raises:
        InputError: there is no such file, or the reader refuses it.
        MissingExtra: the reader needs a library that is not installed.
    """
    notes: list[str] = []
    try:
        check_readable(path)
        result = read(path, notes.append)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    except MemoryError as error:
        raise InputError(f"{path}: does not fit into memory") from error
    for note in notes:
        if on_warning is None:
            warnings.warn(f"{path}: {note}", stacklevel=3)
        else:
            on_warning(f"{path}: {note}")
    return result


def finite_cloud(fields: Fields, warn: Warn) -> Cloud:
    """The cloud of what a reader returned, without the points whose coordinates are NaN or Inf.

    Nobody but the reader holds the arrays: they are frozen, and the cloud keeps them without a copy.
    """
    arrays = [fields["points"], fields.get("normals"), fields.get("colors"), *fields.get("attributes", {}).values()]
    for array in arrays:
        if array is not None:
            freeze(array)
    count = len(fields["points"])
    cloud, dropped = Cloud.from_finite(**fields)
    if dropped:
        warn(f"dropped {dropped} of {count} points with NaN or Inf coordinates")
    return cloud


def as_path(given: object) -> Path:
    """A path as a `Path`.

    Raises:
        InputError: it is none.
    """
    if isinstance(given, str | os.PathLike):
        return Path(given)
    raise InputError(f"expected the path of a file, got {type(given).__name__}")


def check_readable(path: Path) -> None:
    """Refuse a file that cannot hold a cloud or a mesh, before its reader opens it.

    Raises:
        InputError: the path is missing, a folder, not a regular file, or empty.
        OSError: the path cannot be looked at.
    """
    try:
        status = regular_status(path)
    except FileNotFoundError:
        raise InputError("no such file: check the name and the folder") from None
    if not status.st_size:
        raise InputError("expected a point cloud, got an empty file (0 bytes)")


def read_rest(file: BinaryIO) -> NDArray[np.uint8]:
    """All bytes from the current position to the end, in one buffer that is as large as the file really is."""
    start = file.tell()
    rest = np.empty(file.seek(0, 2) - start, dtype=np.uint8)
    file.seek(start)
    got = file.readinto(rest.data)  # type: ignore[attr-defined]
    return rest[:got]


def digest(path: Path) -> str:
    """SHA-256 of a file in hexadecimal digits; of a folder, over the names and contents of the files in it.

    Raises:
        InputError: it is a pipe or a device; the message starts with the path.
        OSError: it is missing, or cannot be read.
    """
    if not path.is_dir():
        try:
            with open_regular(path) as file:
                return hashlib.file_digest(file, "sha256").hexdigest()
        except InputError as error:
            raise InputError(f"{path}: {error}") from error
    whole = hashlib.sha256()
    for inner in sorted(p for p in path.iterdir() if p.is_file()):
        whole.update(inner.name.encode() + b"\0" + bytes.fromhex(digest(inner)))
    return whole.hexdigest()


def named_file(setting: object) -> Path | None:
    """The file that a registration or a region was, or is to be, read from; None where there is none.

    Args:
        setting: `matrix:FILE`, `points:FILE` or `polygon:FILE`; or an object whose `text` is one of these.
    """
    text = getattr(setting, "text", setting)
    if not isinstance(text, str):
        return None
    kind, _, path = text.partition(":")
    return Path(path.strip()) if path and kind.strip().lower() in _NAMING_A_FILE else None


def check_output(path: Path, inputs: Sequence[Path], others: Sequence[Path] = ()) -> None:
    """Say before anything is computed that a result cannot be written there.

    Args:
        inputs: files, and folders of whose files none may be replaced.
        others: further results.

    Raises:
        InputError: the folder does not exist, or an input or another result would be replaced.
    """
    target = path.resolve()
    for given in inputs:
        if target == given.resolve() or (path.exists() and target.is_relative_to(given.resolve())):
            raise InputError(f"{path}: the result would replace an input: choose another name")
    if any(target == other.resolve() for other in others):
        raise InputError(f"{path}: two results would be written there: give each a name of its own")
    if (path.exists() and not path.is_file()) or not path.absolute().parent.is_dir():
        raise InputError(f"{path}: expected the name of a file in an existing folder")


@contextmanager
def atomic_write(path: Path) -> Iterator[BinaryIO]:
    """A binary file that takes the name `path` once it is complete; on any error `path` stays as it was.

    Raises:
        OSError: the folder or the disk does not take the file; the temporary file is removed.
    """
    target = path.resolve()  # through a symbolic link, as a plain open() would write
    if target.exists() and not target.is_file():
        raise OSError(f"cannot write to {path}: it is a folder or a device")
    with scratch_file(path) as (temporary, file):
        yield file
        rename_open(file, temporary, target)


def reading_seconds(path: Path) -> float:
    """Roughly what reading a file of points takes, for progress bars; 0 where there is none."""
    try:
        size = path.stat().st_size
    except OSError:
        return 0.0
    return 0.02 + size / (20e6 if path.suffix.lower() in (".laz", ".txt", ".xyz", ".csv", ".pts", ".asc") else 200e6)
