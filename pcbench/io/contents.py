"""Contents of input files: their digests, and whether a file changed while it was read."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

from pcbench.errors import InputError, PcbenchError
from pcbench.io.gltf import external_files
from pcbench.io.paths import EPT, input_files, is_tiled
from pcbench.regular_files import sha256_of
from pcbench.systems import cpu_count

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
    return _digest_file(path) if files == [path] else combined_digest({file: _digest_file(file) for file in files})


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


FileStatus = tuple[int, int, int]
"""Size and times of a file; the time of its last change of status cannot be set back."""


class FileState(NamedTuple):
    """A file, its SHA-256 in hexadecimal, and the size and times that it had before its bytes were read."""

    path: Path
    sha256: str
    status: FileStatus

    @classmethod
    def of(cls, path: Path) -> FileState:
        """Read a file; raises the errors of `digest`, and a PcbenchError if the file changes meanwhile."""
        state = cls(path, status=status_of(path), sha256=_digest_file(path))
        if status_of(path) != state.status:
            raise changed_error(path)
        return state

    def check(self) -> None:
        """Check that the file still has this content; it is read again only if its size or its times differ.

        Raises:
            PcbenchError: it has not.
        """
        if status_of(self.path) != self.status and _digest_file(self.path) != self.sha256:
            raise changed_error(self.path)


def file_states(files: Iterable[Path]) -> dict[Path, FileState]:
    """Return the state of each existing file; all bytes are read, by several threads."""
    with ThreadPoolExecutor(cpu_count()) as pool:
        return {state.path: state for state in pool.map(FileState.of, sorted({f for f in files if f.is_file()}))}


def changed_error(path: Path) -> PcbenchError:
    """Return the error that a file changed while it was read."""
    return PcbenchError(f"{path}: the file changed while it was read: run the same command again when it is complete")


def combined_digest(digests: Mapping[Path, str]) -> str:
    """Return the SHA-256 of the names and contents of files, sorted by path."""
    combined = hashlib.sha256()
    for path in sorted(digests):
        combined.update(path.name.encode(errors="surrogateescape") + b"\0" + bytes.fromhex(digests[path]))
    return combined.hexdigest()


def status_of(path: Path) -> FileStatus:
    """Return the size and times of a file."""
    status = path.stat()
    return status.st_size, status.st_mtime_ns, status.st_ctime_ns


def _digest_file(path: Path) -> str:
    try:
        return sha256_of(path)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
