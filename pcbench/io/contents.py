"""Contents of input files: their digests, and whether a file changed while it was read."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple, TypeVar

from pcbench.errors import InputError, PcbenchError
from pcbench.io.files import errors_named, input_files
from pcbench.io.formats import CLOUDS
from pcbench.io.gltf import external_files
from pcbench.io.paths import EPT, find_tiles, is_tiled
from pcbench.io.reading import cloud_file
from pcbench.regular_files import sha256_of
from pcbench.systems import cpu_count

T = TypeVar("T")

FILES_PREFIX = "files:"
"""Start of the digest of several files, which is not the SHA-256 of a file."""


def digest(path: Path) -> str:
    """Return the SHA-256 of a file in hexadecimal; for several files, that of their names and contents.

    Args:
        path: a file, a folder, a pattern, a `.vpc` index with its tiles, or the ept.json of Entwine Point Tiles.

    Raises:
        InputError: the path is a pipe or a device, or an index is damaged. The message starts with the path.
        OSError: a file is missing or cannot be read.
    """
    files = content_files(path)
    return _digest_file(path) if files == [path] else _combine({file: _digest_file(file) for file in files})


def content_files(path: Path) -> list[Path]:
    """Return all files that have the content of a path, as in `digest`; those that a glTF file refers to as well."""
    if path.name == EPT or (path / EPT).is_file():
        folder = path.parent if path.name == EPT else path
        return [file for file in folder.rglob("*") if file.is_file()]
    if path.is_dir():
        return [file for file in path.iterdir() if file.is_file()]
    if is_tiled(path):
        return input_files(path)
    return [path, *external_files(path)]


class FileState(NamedTuple):
    """A file, its SHA-256 in hexadecimal, and the size and times that it had before its bytes were read."""

    path: Path
    sha256: str
    status: tuple[int, int, int]

    @classmethod
    def of(cls, path: Path) -> FileState:
        """Read a file; raises the errors of `digest`, and a PcbenchError if the file changes meanwhile."""
        state = cls(path, status=_status(path), sha256=_digest_file(path))
        if _status(path) != state.status:
            raise changed_error(path)
        return state

    def check(self) -> None:
        """Check that the file still has this content; it is read again only if its size or its times differ.

        Raises:
            PcbenchError: it has not.
        """
        if _status(self.path) != self.status and _digest_file(self.path) != self.sha256:
            raise changed_error(self.path)


def cloud_files(path: Path) -> list[Path]:
    """Return all files that have the content of a cloud: of a folder, those with clouds; of an index, also its own.

    Raises:
        InputError: the index is damaged, or there are no such files. The message starts with the path.
    """
    path = cloud_file(path)
    if not is_tiled(path):
        return content_files(path)
    with errors_named(path):
        tiles = find_tiles(path, CLOUDS).paths
    return [*([path] if path.is_file() else []), *tiles]


def cloud_contents(paths: Iterable[Path]) -> dict[Path, FileState]:
    """Return the state of each existing file of clouds; all bytes are read, by several threads."""
    files = {file for path in paths for file in cloud_files(path) if file.is_file()}
    with ThreadPoolExecutor(cpu_count()) as pool:
        return {state.path: state for state in pool.map(FileState.of, sorted(files))}


def cloud_digest(path: Path, contents: Mapping[Path, FileState]) -> str:
    """Return the SHA-256 of a cloud's file; of several files that of names and contents, after `FILES_PREFIX`."""
    files = {file: contents[file].sha256 for file in cloud_files(path) if file in contents}
    if not is_tiled(path) and len(files) == 1:
        return next(iter(files.values()))
    return FILES_PREFIX + _combine(files)


def read_with_digest(path: Path, read: Callable[[], T]) -> tuple[T, str]:
    """Read a cloud or mesh, and return it with its digest, as of `cloud_digest`.

    Args:
        path: path of the cloud or mesh.
        read: reads it.

    Raises:
        PcbenchError: a file changed meanwhile.
    """
    before = {file: _status(file) for file in cloud_files(path) if file.is_file()}
    value, contents = read(), cloud_contents([path])
    for file in before | contents:
        if file not in before or file not in contents or contents[file].status != before[file]:
            raise changed_error(file)
    return value, cloud_digest(path, contents)


def changed_error(path: Path) -> PcbenchError:
    """Return the error that a file changed while it was read."""
    return PcbenchError(f"{path}: the file changed while it was read: run the same command again when it is complete")


def _combine(digests: Mapping[Path, str]) -> str:
    """Return the SHA-256 of the names and contents of files, sorted by path."""
    combined = hashlib.sha256()
    for path in sorted(digests):
        combined.update(path.name.encode(errors="surrogateescape") + b"\0" + bytes.fromhex(digests[path]))
    return combined.hexdigest()


def _status(path: Path) -> tuple[int, int, int]:
    """Return size and times of a file; the time of its last change of status cannot be set back."""
    status = path.stat()
    return status.st_size, status.st_mtime_ns, status.st_ctime_ns


def _digest_file(path: Path) -> str:
    try:
        return sha256_of(path)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
