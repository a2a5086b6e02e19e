"""Files that tasks write beside their results: their sizes and digests are kept with the result of the task."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

from pcbench.errors import InputError
from pcbench.regular_files import sha256_of
from pcbench.scratch import workspace_file


class TaskFile(NamedTuple):
    """A file that a task has written, its size in bytes and its SHA-256 in hexadecimal."""

    path: Path
    size: int
    sha256: str

    def is_unchanged(self) -> bool:
        """Return whether the file still has this content."""
        try:
            return self.path.stat().st_size == self.size and sha256_of(self.path) == self.sha256
        except (OSError, InputError):  # it is missing, or no regular file any more
            return False


_written: ContextVar[list[TaskFile] | None] = ContextVar("_written", default=None)


@contextmanager
def files_written() -> Iterator[list[TaskFile]]:
    """Yield the list to which `task_file` and `record_file` add the files that are written in this block."""
    files: list[TaskFile] = []
    token = _written.set(files)
    try:
        yield files
    finally:
        _written.reset(token)


@contextmanager
def task_file(path: Path) -> Iterator[HashingFile]:
    """Open a file that a task writes; a killed task leaves no partial file under this name.

    Raises:
        OSError: the file cannot be written; the error names it.
    """
    with workspace_file(path) as file:
        hashed = HashingFile(file)
        yield hashed
        size = file.tell()
    _record(TaskFile(path, size, hashed.sha256.hexdigest()))


def record_file(path: Path) -> None:
    """Record a file that a task wrote without `task_file`; it is read again for its digest.

    Raises:
        OSError: the file cannot be read.
    """
    _record(TaskFile(path, path.stat().st_size, sha256_of(path)))


class HashingFile:
    """A file open for writing that computes the SHA-256 of what is written."""

    def __init__(self, file: BinaryIO) -> None:
        self._file, self.sha256 = file, hashlib.sha256()

    def write(self, data: Any) -> int:
        """Write an object with a contiguous buffer."""
        self.sha256.update(data)
        return self._file.write(data)


def _record(file: TaskFile) -> None:
    files = _written.get()
    if files is not None:
        files.append(file)
