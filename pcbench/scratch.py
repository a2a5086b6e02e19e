"""What a run has beside its results while it lives: temporary files and folders, and its claim to an output.

Each is locked by its owner (flock), and the system takes a lock back when its process ends, however it ends. So the
next run can tell what a killed one left from what a living one works on, and sweeps it; and of two runs with one output
the second is refused.
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
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from pcbench.errors import InputError
from pcbench.systems import NO_FOLLOW, NO_WAIT, close_and_remove, is_own, lock, open_folder

_PREFIX = ".pcbench-"
_LOCK = ".lock"  # how the names of claims end
# Names that are made here, and no other: what a user calls .pcbench-notes is the user's.
_NAMES = re.compile(rf"{re.escape(_PREFIX)}([0-9a-f]{{16}}{re.escape(_LOCK)}|[0-9a-f]{{8}}-[0-9a-f]{{16}}(\.tmp)?)")
_OURS = f"{_PREFIX}{hashlib.sha256(platform.node().encode()).hexdigest()[:8]}-"  # of this machine
# What another machine left on a shared disk, whose locks may not be seen here, is swept after this.
_MAX_FOREIGN_AGE_S = 86_400.0
_ATTEMPTS, _PAUSE_S = 5, 0.05  # to claim an output
_NO_LOCK = -1
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO)  # writing an open file fails by these, and names no file


@contextmanager
def claim(output: Path) -> Iterator[None]:
    """Keep an output to this run: a file or a folder, which need not exist, in an existing folder.

    Where the folder cannot be written or its disk knows no locks nothing is claimed.

    Raises:
        InputError: another run has it.
    """
    target = output.resolve()
    sweep(target.parent)
    path = target.with_name(f"{_PREFIX}{hashlib.sha256(os.fsencode(target.name)).hexdigest()[:16]}{_LOCK}")
    claimed = _claimed(path)
    if claimed is None:
        raise InputError(f"{output}: another run is writing there: wait for it, or choose another name")
    try:
        yield
    finally:
        if claimed != _NO_LOCK:
            close_and_remove(path, claimed)


@contextmanager
def scratch_file(output: Path) -> Iterator[tuple[Path, BinaryIO]]:
    """A new file beside an output, open for writing, that is gone afterwards, unless it was renamed to it.

    Raises:
        OSError: it cannot be made or written; the error names the output.
    """
    folder = output.resolve().parent
    sweep(folder)
    path = folder / f"{_OURS}{secrets.token_hex(8)}.tmp"
    with naming(output, path):
        descriptor = _open_locked(path, os.O_RDWR | os.O_CREAT | os.O_EXCL)
        try:
            with os.fdopen(descriptor, "wb") as file:
                yield path, file
        finally:
            path.unlink(missing_ok=True)


@contextmanager
def scratch_folder(output: Path | None = None) -> Iterator[Path]:
    """A new folder that is gone afterwards, unless it was renamed.

    Args:
        output: what it may be renamed to; it is made beside. None: a private one where the system has its temporary
            files.

    Raises:
        OSError: it cannot be made or written; the error names the output.
    """
    parent = Path(tempfile.gettempdir()) if output is None else output.absolute().parent
    sweep(parent)
    path = parent / f"{_OURS}{secrets.token_hex(8)}"
    with naming(output or path, path):
        descriptor = _make_locked_folder(path, 0o700 if output is None else 0o777)
        try:
            yield path
        finally:
            shutil.rmtree(path, ignore_errors=True)
            if descriptor is not None:
                os.close(descriptor)


def sweep(folder: Path) -> None:
    """Remove what runs left in a folder that have not lived to remove it. What cannot be removed stays."""
    with suppress(OSError), os.scandir(folder) as entries:
        for path in [Path(entry.path) for entry in entries if _NAMES.fullmatch(entry.name)]:
            with suppress(OSError):
                _sweep(path)


@contextmanager
def naming(output: Path, scratch: Path) -> Iterator[None]:
    """A full disk and the like are said of the output that the user named, not of the scratch it is written to."""
    try:
        yield
    except OSError as error:
        named = output
        if error.filename is not None:
            file = Path(os.fsdecode(error.filename))
            if not file.is_relative_to(scratch):
                raise
            named = output / file.relative_to(scratch)
        elif error.errno is None and "requested and" in str(error):  # numpy's, of a file that it could not fill
            raise OSError(errno.ENOSPC, f"only a part could be written ({error})", str(output)) from error
        elif error.errno not in _FULL:
            raise
        raise OSError(error.errno, error.strerror, str(named)) from error


def _claimed(path: Path) -> int | None:
    """A descriptor of a claim's file with its lock, `_NO_LOCK` where there can be none, None where another has it."""
    for _ in range(_ATTEMPTS):
        try:
            descriptor = os.open(path, os.O_RDONLY | os.O_CREAT | NO_FOLLOW, 0o666)
        except OSError:
            return _NO_LOCK
        try:
            lock(descriptor, wait=False)
            if _is_at(path, descriptor):
                return descriptor
        except BlockingIOError:  # perhaps a sweep that is through with it in a moment
            time.sleep(_PAUSE_S)
        except OSError:
            os.close(descriptor)
            return _NO_LOCK
        os.close(descriptor)
    return None


def _open_locked(path: Path, flags: int) -> int:
    """Descriptor of a new file, locked where the disk knows locks."""
    while True:
        descriptor = os.open(path, flags, 0o666)
        if _locked_at(path, descriptor):
            return descriptor


def _make_locked_folder(path: Path, mode: int) -> int | None:
    """Descriptor of a new folder, locked where the disk knows locks; None where the system opens no folders."""
    while True:
        path.mkdir(mode)
        try:
            descriptor = open_folder(path)
        except FileNotFoundError:  # a sweep came before it was opened
            continue
        if descriptor is None or _locked_at(path, descriptor):
            return descriptor


def _locked_at(path: Path, descriptor: int) -> bool:
    """Lock what was made at a path, if the disk knows locks; False, and closed, where a sweep came before the lock."""
    with suppress(OSError):
        lock(descriptor, wait=True)
    if _is_at(path, descriptor):
        return True
    os.close(descriptor)
    return False


def _is_at(path: Path, descriptor: int) -> bool:
    try:
        return os.path.samestat(path.lstat(), os.fstat(descriptor))
    except FileNotFoundError:
        return False


def _sweep(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY | NO_FOLLOW | NO_WAIT)
    try:
        lock(descriptor, wait=False)  # a living run has it
        status = os.fstat(descriptor)
        if not is_own(status):
            return
        mine = path.name.startswith(_OURS) or path.name.endswith(_LOCK)
        if not mine and time.time() - status.st_mtime < _MAX_FOREIGN_AGE_S:
            return
        if _is_at(path, descriptor):
            if path.is_dir():
                shutil.rmtree(path, ignore_errors=True)
            else:
                path.unlink()
    finally:
        os.close(descriptor)
