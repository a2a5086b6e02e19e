"""Files with the results of tasks: written atomically by the worker, checked when they are used.

A file is the format's name, the SHA-256 of the key of its stage, the pickled result, and the SHA-256 of all of this.
"""

from __future__ import annotations

import hashlib
import os
import pickle
from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, BinaryIO, Generic, NamedTuple, TypeVar

from pcbench.errors import InputError
from pcbench.scratch import workspace_file

T = TypeVar("T")

SUFFIX = ".result"
_FORMAT = b"pcbench result 1"
_HEADER_BYTES = len(_FORMAT) + 32
_BLOCK_BYTES = 1 << 20


class Task(NamedTuple):
    """A call that depends on no other task.

    Attributes:
        name: name in its stage, which is also the name of its result's file: letters, digits, hyphens and underscores.
        arguments: arguments of the function. They travel to the worker, so keep them small: paths rather than points.
        size: amount of work, in points, from which progress and the time left are estimated.
    """

    name: str
    arguments: tuple[Any, ...]
    size: float = 1.0


class StageResults(Generic[T]):
    """Results of a stage in the order of its tasks, loaded from disk one at a time.

    Args:
        tasks: the tasks that have results.
        files: file of the result of each task by name.
        key: key of the stage.
    """

    def __init__(self, tasks: Sequence[Task], files: Mapping[str, Path], key: str) -> None:
        self.tasks = tuple(tasks)
        self._files, self._key = {task.name: files[task.name] for task in tasks}, key

    def __len__(self) -> int:
        return len(self.tasks)

    def __iter__(self) -> Iterator[tuple[Task, T]]:
        for task in self.tasks:
            yield task, self.get(task.name)

    def get(self, name: str) -> T:
        """Load the result of the task with this name.

        Raises:
            KeyError: there is no such task, or it was skipped.
            InputError: the file was damaged or removed after it had been written.
        """
        result: T = read_result(self._files[name], self._key)
        return result


def write_result(path: Path, key: str, result: object) -> int:
    """Write a result atomically and return the size of the file in bytes.

    Raises:
        OSError: the file cannot be written; the error names it.
    """
    with workspace_file(path) as file:
        hashed = _HashingFile(file)
        hashed.write(_header(key))
        pickle.dump(result, hashed, protocol=pickle.HIGHEST_PROTOCOL)
        file.write(hashed.sha256.digest())
        return file.tell()


def is_intact(path: Path, key: str) -> bool:
    """Return whether a file is the complete and undamaged result of a task of a stage with this key."""
    try:
        with path.open("rb") as file:
            return _is_intact(file, key)
    except OSError:
        return False


def read_result(path: Path, key: str) -> Any:
    """Read a result after checking its file.

    Raises:
        InputError: the file is missing or damaged.
    """
    try:
        with path.open("rb") as file:
            if _is_intact(file, key):
                file.seek(_HEADER_BYTES)
                return pickle.load(file)
    except FileNotFoundError:
        pass
    raise InputError(f"{path}: the file was damaged or removed after it had been written: run the same command again")


@lru_cache(maxsize=2)
def read_shared(path: Path, key: str) -> Any:
    """Read a value that many tasks share; a worker reads it once, so it must not be changed.

    Arguments of tasks travel with each of them. Such a value is stored by `write_result` instead, and only its path and
    its key travel. The key must identify the value.

    Raises:
        InputError: see `read_result`.
    """
    return read_result(path, key)


class _HashingFile:
    """A file open for writing that computes the SHA-256 of what is written."""

    def __init__(self, file: BinaryIO) -> None:
        self._file, self.sha256 = file, hashlib.sha256()

    def write(self, data: bytes) -> int:
        self.sha256.update(data)
        return self._file.write(data)


def _header(key: str) -> bytes:
    return _FORMAT + hashlib.sha256(key.encode()).digest()


def _is_intact(file: BinaryIO, key: str) -> bool:
    left = os.fstat(file.fileno()).st_size - 32
    header = file.read(_HEADER_BYTES)
    if left < _HEADER_BYTES or header != _header(key):
        return False
    sha256 = hashlib.sha256(header)
    left -= len(header)
    while left and (block := file.read(min(left, _BLOCK_BYTES))):
        sha256.update(block)
        left -= len(block)
    return left == 0 and file.read() == sha256.digest()
