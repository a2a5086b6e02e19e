"""Temporary files, atomic writing and output locks.

Each temporary file, temporary folder and lock file is locked by its owner (flock). The system releases a lock when its
process ends, even if it is killed. The next run can therefore distinguish files in use from leftovers, and removes the
leftovers. Of two runs with the same output, the second is refused.
"""

from __future__ import annotations

import errno
import hashlib
import os
import platform
import re
import secrets
import shutil
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from pcbench.errors import InputError
from pcbench.systems import NO_FOLLOW, NO_WAIT, close_and_remove, is_owned_by_user, lock, open_folder, rename_open

PARTIAL_SUFFIX = ".partial"
"""Suffix of the temporary files of `workspace_file`."""
_PREFIX = ".pcbench-"
_LOCK_SUFFIX = ".lock"
# Exactly the names that this module creates: a user's own .pcbench-notes is never touched.
_SCRATCH_NAME = re.compile(
    rf"{re.escape(_PREFIX)}([0-9a-f]{{16}}{re.escape(_LOCK_SUFFIX)}|[0-9a-f]{{8}}-[0-9a-f]{{16}}(\.tmp)?)"
)
_OWN_PREFIX = f"{_PREFIX}{hashlib.sha256(platform.node().encode()).hexdigest()[:8]}-"  # of this machine
# Leftovers of other machines on a shared disk, whose locks may be invisible here, are removed after this time.
_MAX_FOREIGN_AGE_S = 86_400.0
_MAX_LOCK_ATTEMPTS, _RETRY_INTERVAL_S = 5, 0.05
_NO_LOCK = -1
_DISK_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO)  # of writing to an open file; they name no file


class OutputInUse(InputError):
    """Another run writes the same output."""


@contextmanager
def lock_output(output: Path) -> Iterator[None]:
    """Lock an output for this run: a file or folder, which need not exist, in an existing folder.

    There is no lock if the folder cannot be written or its disk does not support locks.

    Raises:
        OutputInUse: another run has locked the output.
    """
    target = output.resolve()
    remove_leftovers(target.parent)
    path = target.with_name(f"{_PREFIX}{hashlib.sha256(os.fsencode(target.name)).hexdigest()[:16]}{_LOCK_SUFFIX}")
    descriptor = _try_lock_output(path)
    if descriptor is None:
        raise OutputInUse(f"{output}: another run is writing there: wait for it, or choose another name")
    try:
        yield
    finally:
        if descriptor != _NO_LOCK:
            close_and_remove(path, descriptor)


@contextmanager
def scratch_file(output: Path) -> Iterator[tuple[Path, BinaryIO]]:
    """Create a temporary file beside an output, open for writing; it is removed at the end unless it was renamed.

    Raises:
        OSError: it cannot be created or written; the error names the output.
    """
    folder = output.resolve().parent
    remove_leftovers(folder)
    path = folder / f"{_OWN_PREFIX}{secrets.token_hex(8)}.tmp"
    with attribute_errors_to(output, path):
        descriptor = _open_locked(path, os.O_RDWR | os.O_CREAT | os.O_EXCL)
        try:
            with os.fdopen(descriptor, "wb") as file:
                yield path, file
        finally:
            path.unlink(missing_ok=True)


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


@contextmanager
def workspace_file(path: Path) -> Iterator[BinaryIO]:
    """Open a temporary file that is renamed to `path` once complete, in a folder that only pcbench writes.

    Such a folder may have many files. So there is no lock and no search for leftovers, as in
    `atomic_write`: a killed process leaves a file with `PARTIAL_SUFFIX`. Two processes may write the
    same path at once, because a cluster repeats tasks of workers that it believes lost: the later one stays.

    Raises:
        OSError: the file cannot be written; the error names `path`.
    """
    partial = path.with_name(f".{path.name}-{secrets.token_hex(4)}{PARTIAL_SUFFIX}")
    try:
        with attribute_errors_to(path, partial), partial.open("xb") as file:
            yield file
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


@contextmanager
def scratch_folder(output: Path | None = None) -> Iterator[Path]:
    """Create a temporary folder; it is removed at the end unless it was renamed.

    Args:
        output: path to which the folder may be renamed; it is created beside it, or beside what it links to, which may
            be on another disk. None: a private folder in the system's temporary directory.

    Raises:
        OSError: it cannot be created or written; the error names the output.
    """
    parent = Path(tempfile.gettempdir()) if output is None else output.resolve().parent
    remove_leftovers(parent)
    path = parent / f"{_OWN_PREFIX}{secrets.token_hex(8)}"
    with attribute_errors_to(output or path, path):
        descriptor = _make_locked_folder(path, 0o700 if output is None else 0o777)
        try:
            yield path
        finally:
            shutil.rmtree(path, ignore_errors=True)
            if descriptor is not None:
                os.close(descriptor)


def make_parents(folder: Path) -> list[Path]:
    """Create a folder and its parents, and return the created ones, outermost first."""
    missing = [path for path in (folder, *folder.parents) if not path.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    return missing[::-1]


def remove_empty(folders: Sequence[Path]) -> None:
    """Remove those folders of `make_parents` that are empty."""
    for folder in reversed(folders):
        if folder.is_dir() and not any(folder.iterdir()):
            folder.rmdir()


def remove_leftovers(folder: Path) -> None:
    """Remove the leftovers of killed runs from a folder. Those that cannot be removed stay."""
    with suppress(OSError), os.scandir(folder) as entries:
        for path in [Path(entry.path) for entry in entries if _SCRATCH_NAME.fullmatch(entry.name)]:
            with suppress(OSError):
                _remove_leftover(path)


@contextmanager
def attribute_errors_to(output: Path, scratch: Path) -> Iterator[None]:
    """Replace the temporary file in errors, such as that of a full disk, by the output that the user chose."""
    try:
        yield
    except OSError as error:
        named = output
        if error.filename is not None:
            file = Path(os.fsdecode(error.filename))
            if not file.is_relative_to(scratch):
                raise
            named = output / file.relative_to(scratch)
        elif error.errno is None and "requested and" in str(error):  # numpy wrote only a part of an array
            raise OSError(errno.ENOSPC, f"only a part could be written ({error})", str(output)) from error
        elif error.errno not in _DISK_ERRORS:
            raise
        raise OSError(error.errno, error.strerror, str(named)) from error


def _try_lock_output(path: Path) -> int | None:
    """Return the descriptor of the locked file; `_NO_LOCK` if locks fail, None if another process has the lock."""
    for _ in range(_MAX_LOCK_ATTEMPTS):
        try:
            descriptor = os.open(path, os.O_RDONLY | os.O_CREAT | NO_FOLLOW, 0o666)
        except OSError:
            return _NO_LOCK
        try:
            lock(descriptor, wait=False)
            if _is_still_at(path, descriptor):
                return descriptor
        except BlockingIOError:  # another run's `remove_leftovers` may hold it for a moment
            time.sleep(_RETRY_INTERVAL_S)
        except OSError:
            os.close(descriptor)
            return _NO_LOCK
        os.close(descriptor)
    return None


def _open_locked(path: Path, flags: int) -> int:
    """Create a file, locked if the disk supports locks, and return its descriptor."""
    while True:
        descriptor = os.open(path, flags, 0o666)
        if _lock_new(path, descriptor):
            return descriptor


def _make_locked_folder(path: Path, mode: int) -> int | None:
    """Create a folder, locked if the disk supports locks; return its descriptor, None if folders cannot be opened."""
    while True:
        path.mkdir(mode)
        try:
            descriptor = open_folder(path)
        except FileNotFoundError:  # another run's `remove_leftovers` removed it before it was opened
            continue
        if descriptor is None or _lock_new(path, descriptor):
            return descriptor


def _lock_new(path: Path, descriptor: int) -> bool:
    """Lock a new file or folder if the disk supports locks; close it and return False if it has been removed."""
    with suppress(OSError):
        lock(descriptor, wait=True)
    if _is_still_at(path, descriptor):
        return True
    os.close(descriptor)
    return False


def _is_still_at(path: Path, descriptor: int) -> bool:
    try:
        return os.path.samestat(path.lstat(), os.fstat(descriptor))
    except FileNotFoundError:
        return False


def _remove_leftover(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY | NO_FOLLOW | NO_WAIT)
    try:
        lock(descriptor, wait=False)  # raises if a running process has locked it
        status = os.fstat(descriptor)
        if not is_owned_by_user(status):
            return
        own = path.name.startswith(_OWN_PREFIX) or path.name.endswith(_LOCK_SUFFIX)
        if not own and time.time() - status.st_mtime < _MAX_FOREIGN_AGE_S:
            return
        if _is_still_at(path, descriptor):
            if path.is_dir():
                shutil.rmtree(path, ignore_errors=True)
            else:
                path.unlink()
    finally:
        os.close(descriptor)
