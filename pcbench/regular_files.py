"""Open files that a user names: regular files only, and text and JSON files of limited size.

Opening a named pipe blocks until it has a writer, and a device such as /dev/zero never ends. Both are refused.
"""

from __future__ import annotations

import codecs
import hashlib
import json
import os
import stat
from io import BufferedReader
from pathlib import Path
from typing import Any, Literal

from pcbench.errors import InputError

_MAX_JSON_BYTES = 1 << 30  # for results and cameras
MAX_TEXT_BYTES = 64 << 20  # about a million lines of matrices, point pairs, positions or settings

# Opening a pipe with O_NONBLOCK returns at once. Windows has neither the flag nor named pipes in folders.
_NO_WAIT = getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_NOCTTY", 0) | getattr(os, "O_BINARY", 0)


def open_regular(path: str | os.PathLike[str]) -> BufferedReader:
    """Open a regular file for reading bytes; symbolic links are followed.

    Raises:
        InputError: it is a folder, a pipe, a socket or a device; the message does not contain the path.
        OSError: it is missing or cannot be opened.
    """
    regular_status(path)
    descriptor = os.open(path, os.O_RDONLY | _NO_WAIT)
    try:
        _check_mode(os.fstat(descriptor).st_mode)  # the file may have been replaced since the first check
        return os.fdopen(descriptor, "rb")
    except BaseException:
        os.close(descriptor)
        raise


def read_bytes(path: str | os.PathLike[str], max_bytes: int = MAX_TEXT_BYTES) -> bytes:
    """Read a small regular file.

    Raises:
        InputError: as `open_regular`, or the file is larger than `max_bytes`; the message does not contain the path.
        OSError: it cannot be read.
    """
    with open_regular(path) as file:
        if (size := os.fstat(file.fileno()).st_size) > max_bytes:
            raise InputError(f"expected a file of at most {max_bytes >> 20} MiB, got {size / 2**20:,.0f} MiB")
        return file.read()


def encoding_of(data: bytes) -> Literal["utf-16", "utf-8-sig"]:
    """Return the encoding of a text by its byte order mark: UTF-16, as PowerShell writes it, or else UTF-8."""
    return "utf-16" if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)) else "utf-8-sig"


def decode_text(data: bytes) -> str:
    """Return text in UTF-8, with or without a byte order mark, or in UTF-16 with one.

    Raises:
        UnicodeDecodeError: the text is in another encoding.
    """
    return data.decode(encoding_of(data))


def read_text(path: str | os.PathLike[str], max_bytes: int = MAX_TEXT_BYTES) -> str:
    """Read a small regular text file in an encoding of `decode_text`.

    Raises:
        InputError: as `read_bytes`, or the file is not such text; the message does not contain the path.
        OSError: it cannot be read.
    """
    try:
        return decode_text(read_bytes(path, max_bytes))
    except UnicodeDecodeError:
        raise InputError("expected a UTF-8 text file: save it as UTF-8") from None


def read_json(path: Path) -> Any:
    """Parse a JSON file.

    Raises:
        InputError: the file is not a regular file, not JSON, or nested too deeply. The message does not name the path.
        OSError: the file cannot be read.
    """
    try:
        return json.loads(decode_text(read_bytes(path, _MAX_JSON_BYTES)))
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


def regular_status(path: str | os.PathLike[str]) -> os.stat_result:
    """Return the status of a regular file; symbolic links are followed.

    Raises:
        InputError: as `open_regular`.
        OSError: it is missing or not accessible.
    """
    try:
        status = Path(path).stat()
    except ValueError:
        raise InputError("expected a file name, got one with a NUL character") from None
    _check_mode(status.st_mode)
    return status


def sha256_of(path: Path) -> str:
    """Return the SHA-256 of a regular file in hexadecimal.

    Raises:
        InputError, OSError: as `open_regular`.
    """
    with open_regular(path) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def is_regular_file(path: str | os.PathLike[str]) -> bool:
    """Return whether a regular file of this name exists; False for text that cannot be a file name."""
    try:
        regular_status(path)
    except (InputError, OSError):
        return False
    return True


def has_entry(path: Path) -> bool:
    """Return whether a path exists and is not a folder.

    Unlike `Path.is_file` this includes pipes, devices and broken links, so that callers refuse them instead of ignoring
    them.
    """
    return os.path.lexists(path) and not path.is_dir()


def _check_mode(mode: int) -> None:
    if stat.S_ISDIR(mode):
        raise InputError("expected a file, got a folder: name the file inside it")
    if not stat.S_ISREG(mode):
        raise InputError("expected a regular file, got a pipe or a device: save the data to a file first")
