"""Open the files that a user names: regular files only, and texts of a bounded size.

Opening a named pipe waits for its writer, and a device such as /dev/zero never ends. Both are refused in one line.
"""

from __future__ import annotations

import os
import stat
from io import BufferedReader
from pathlib import Path

from pcbench.errors import InputError

MAX_TEXT_BYTES = 64 << 20  # of a matrix, pairs of points, positions, settings: a million lines

# Opening a pipe with this flag returns at once. Windows has neither the flag nor such files.
_NO_WAIT = getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_NOCTTY", 0) | getattr(os, "O_BINARY", 0)


def open_regular(path: str | os.PathLike[str]) -> BufferedReader:
    """A regular file, open for reading bytes; symbolic links are followed.

    Raises:
        InputError: it is a folder, a pipe, a socket or a device; the message does not name the path.
        OSError: it is missing, or cannot be opened.
    """
    regular_status(path)
    descriptor = os.open(path, os.O_RDONLY | _NO_WAIT)
    try:
        _check_mode(os.fstat(descriptor).st_mode)  # another file may have taken the name
        return os.fdopen(descriptor, "rb")
    except BaseException:
        os.close(descriptor)
        raise


def read_bytes(path: str | os.PathLike[str], max_bytes: int = MAX_TEXT_BYTES) -> bytes:
    """All bytes of a small regular file.

    Raises:
        InputError: as `open_regular`, or the file is larger than `max_bytes`; the message does not name the path.
        OSError: it cannot be read.
    """
    with open_regular(path) as file:
        if (size := os.fstat(file.fileno()).st_size) > max_bytes:
            raise InputError(f"expected a file of at most {max_bytes >> 20} MiB, got {size / 2**20:,.0f} MiB")
        return file.read()


def read_text(path: str | os.PathLike[str], max_bytes: int = MAX_TEXT_BYTES) -> str:
    """The text of a small regular file in UTF-8, with or without a byte order mark.

    Raises:
        InputError: as `read_bytes`, or the file is not UTF-8 text; the message does not name the path.
        OSError: it cannot be read.
    """
    try:
        return read_bytes(path, max_bytes).decode("utf-8-sig")
    except UnicodeDecodeError:
        raise InputError("not a text file") from None


def regular_status(path: str | os.PathLike[str]) -> os.stat_result:
    """The status of a regular file, which `path` may be a link to.

    Raises:
        InputError: as `open_regular`.
        OSError: it is missing, or cannot be looked at.
    """
    try:
        status = Path(path).stat()
    except ValueError:
        raise InputError("expected a file name, got one with a NUL character") from None
    _check_mode(status.st_mode)
    return status


def is_regular_file(path: str | os.PathLike[str]) -> bool:
    """Whether there is a regular file of this name. A text that cannot be the name of one is none."""
    try:
        regular_status(path)
    except (InputError, OSError):
        return False
    return True


def has_entry(path: Path) -> bool:
    """Whether a folder has an entry of this name that is no folder: a file, or what is refused in its place.

    Unlike `Path.is_file` it counts pipes, devices and links that lead nowhere, so that they are not passed over.
    """
    return os.path.lexists(path) and not path.is_dir()


def _check_mode(mode: int) -> None:
    if stat.S_ISDIR(mode):
        raise InputError("expected a file, got a folder: name the file inside it")
    if not stat.S_ISREG(mode):
        raise InputError("expected a regular file, got a pipe or a device: save the data to a file first")
