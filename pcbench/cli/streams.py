"""Standard streams that are closed, full, or read by nobody any more: one line and an exit code, never a traceback."""

from __future__ import annotations

import errno
import io
import os
import sys
from contextlib import suppress
from typing import TextIO


class _Unread(io.BytesIO):
    """A buffer that takes the place of a closed standard output and keeps what is printed."""


def prepare_streams() -> None:
    """Make all three standard streams usable before anything is opened or printed.

    Where one is closed, its descriptor is given to the null device: the next file that is opened would get it, and
    whatever a library prints would end in that file. What is printed to a closed standard output is kept, so that
    `finish_output` can tell that it was lost.
    """
    for descriptor in (0, 1, 2):
        _fill(descriptor)
    if sys.stdout is None:
        sys.stdout = io.TextIOWrapper(_Unread(), encoding="utf-8")
    if sys.stderr is None:
        sys.stderr = io.TextIOWrapper(io.FileIO(os.devnull, "w"), encoding="utf-8", write_through=True)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # a terminal without arrows still gets its table
            stream.reconfigure(errors="replace")


def finish_output() -> None:
    """Hand on what standard output still holds.

    Raises:
        OSError: it does not take it, or it was closed from the start and something was printed.
    """
    sys.stdout.flush()
    buffer = getattr(sys.stdout, "buffer", None)
    if isinstance(buffer, _Unread) and buffer.tell():
        raise OSError(errno.EBADF, os.strerror(errno.EBADF))


def is_of_a_stream(error: OSError) -> bool:
    """Return whether an OSError is that of a standard stream: it names no file.

    Writers of files add the name of theirs (`scratch.naming`).
    """
    return error.filename is None and error.errno in (errno.ENOSPC, errno.EFBIG, errno.EBADF)


def discard(*streams: TextIO | None) -> None:
    """Let the interpreter end quietly: what it still has for these streams goes to the null device."""
    for stream in streams:
        with suppress(OSError, ValueError, AttributeError):  # one that has no descriptor
            null = os.open(os.devnull, os.O_WRONLY)
            os.dup2(null, stream.fileno())  # type: ignore[union-attr]
            os.close(null)


def _fill(descriptor: int) -> None:
    try:
        os.fstat(descriptor)
    except OSError:
        null = os.open(os.devnull, os.O_RDWR)
        if null != descriptor:
            os.dup2(null, descriptor)
            os.close(null)
