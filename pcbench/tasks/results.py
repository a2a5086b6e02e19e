"""Files with the results of tasks: written atomically by the worker, checked when they are used.

A file is the format's name, the SHA-256 of the key of its stage, the length of a JSON text, the text, the arrays to
which it refers, and the SHA-256 of all of this. The text has the result (`pcbench.tasks.codec`), and the names, sizes
and digests of the other files that the task has written. Such a file holds no code, even if it came from elsewhere.
"""

from __future__ import annotations

import hashlib
import json
import os
import struct
from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, BinaryIO, Generic, NamedTuple, TypeVar

from pcbench.errors import InputError
from pcbench.regular_files import open_regular
from pcbench.scratch import workspace_file
from pcbench.tasks.codec import Encoded, as_json, decode, encode, read_array, types_in, write_array
from pcbench.tasks.files import HashingFile, TaskFile

T = TypeVar("T")

SUFFIX = ".result"
_FORMAT = b"pcbench result 2"
_HEADER_BYTES = len(_FORMAT) + 32
_LENGTH = struct.Struct("<Q")
_BLOCK_BYTES = 1 << 20
_INVALID = (ValueError, TypeError, RecursionError)  # errors of content that pcbench has not written


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


class _Content(NamedTuple):
    """The JSON text of a file."""

    tree: Any  # of the result
    arrays: int  # number of arrays after the text
    files: list[tuple[str, int, str]]  # names relative to the file, sizes and digests of the task's other files


class StageResults(Generic[T]):
    """Results of a stage in the order of its tasks, loaded from disk one at a time.

    Args:
        tasks: the tasks that have results.
        files: file of the result of each task by name.
        key: key of the stage.
        kind: type of the results, as in annotations.
    """

    def __init__(self, tasks: Sequence[Task], files: Mapping[str, Path], key: str, kind: Any = None) -> None:
        self.tasks = tuple(tasks)
        self._files, self._key = {task.name: files[task.name] for task in tasks}, key
        self._types = types_in(kind)

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
        result: T = read_result(self._files[name], self._key, self._types)
        return result


def write_result(path: Path, key: str, result: object, files: Sequence[TaskFile] = ()) -> int:
    """Write a result atomically and return the size of the file in bytes.

    Args:
        path: the file.
        key: key of the stage.
        result: a value that `pcbench.tasks.codec.encode` accepts.
        files: other files that the task has written, which belong to the result.

    Raises:
        TypeError: the result has another type.
        OSError: the file cannot be written; the error names it.
    """
    tree, arrays = encode(result)
    content = as_json(_Content(tree, len(arrays), [(_relative(file.path, path), *file[1:]) for file in files]))
    with workspace_file(path) as file:
        hashed = HashingFile(file)
        hashed.write(_header(key) + _LENGTH.pack(len(content)) + content)
        for array in arrays:
            write_array(hashed, array)
        file.write(hashed.sha256.digest())
        return file.tell()


def is_intact(path: Path, key: str) -> bool:
    """Return whether a file is the undamaged result of a task of a stage with this key, and its other files are too."""
    try:
        with open_regular(path) as file:
            if not _is_intact(file, key):
                return False
            names = _read_content(file).files
        return all(TaskFile(path.parent / name, size, sha256).is_unchanged() for name, size, sha256 in names)
    except (OSError, *_INVALID):
        return False


def read_result(path: Path, key: str, types: Mapping[str, type]) -> Any:
    """Read a result after checking its file.

    Args:
        path: the file.
        key: key of the stage.
        types: types of its objects by name, see `pcbench.tasks.codec.types_in`.

    Raises:
        InputError: the file is missing or damaged. A damaged file is removed, so that its task runs again.
    """
    try:
        with open_regular(path) as file:
            if _is_intact(file, key):
                content = _read_content(file)
                return decode(Encoded(content.tree, [read_array(file) for _ in range(content.arrays)]), types)
    except FileNotFoundError:
        pass
    except _INVALID:  # its checksum is right, but pcbench has not written it
        path.unlink(missing_ok=True)
    raise InputError(f"{path}: the file was damaged or removed after it had been written: run the same command again")


@lru_cache(maxsize=2)
def read_shared(path: Path, key: str, kind: type[T]) -> T:
    """Read a value of a type that many tasks share; a worker reads it once, so it must not be changed.

    Arguments of tasks travel with each of them. Such a value is stored by `write_result` instead, and only its path and
    its key travel. The key must identify the value.

    Raises:
        InputError: see `read_result`.
    """
    value: T = read_result(path, key, types_in(kind))
    return value


def _header(key: str) -> bytes:
    return _FORMAT + hashlib.sha256(key.encode()).digest()


def _relative(path: Path, result: Path) -> str:
    """Return a path relative to the folder of a result, which stays valid if the workspace is moved."""
    return os.path.relpath(path, result.parent)


def _read_content(file: BinaryIO) -> _Content:
    """Read the JSON text of a file; the arrays follow.

    Raises:
        ValueError, TypeError, RecursionError: it is not such a text.
    """
    file.seek(_HEADER_BYTES)
    (length,) = _LENGTH.unpack(file.read(_LENGTH.size))
    if length > os.fstat(file.fileno()).st_size:
        raise ValueError(f"expected a text in the file, got one of {length} bytes")
    return _Content(*json.loads(file.read(length)))


def _is_intact(file: BinaryIO, key: str) -> bool:
    bytes_left = os.fstat(file.fileno()).st_size - 32
    header = file.read(_HEADER_BYTES)
    if bytes_left < _HEADER_BYTES or header != _header(key):
        return False
    sha256 = hashlib.sha256(header)
    bytes_left -= len(header)
    while bytes_left and (block := file.read(min(bytes_left, _BLOCK_BYTES))):
        sha256.update(block)
        bytes_left -= len(block)
    return bytes_left == 0 and file.read() == sha256.digest()
