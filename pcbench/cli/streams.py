"""Make closed, full and unread standard streams end a run with one line and an exit code, never a traceback."""

from __future__ import annotations

import errno
import io
import os
import sys
from contextlib import suppress
from typing import TextIO


class _ClosedOutput(io.BytesIO):
    """A buffer that replaces a closed standard output."""


def prepare_streams() -> None:
    """Make all three standard streams usable before anything is opened or printed.

    The descriptor of a closed stream is opened on the null device; otherwise the next opened file would get it, and a
    library's output would end up in that file. Output to a closed standard output is buffered, so that `finish_output`
    can report the loss.
    """
    for descriptor in (0, 1, 2):
        _fill(descriptor)
    if sys.stdout is None:
        sys.stdout = io.TextIOWrapper(_ClosedOutput(), encoding="utf-8")
    if sys.stderr is None:
        sys.stderr = io.TextIOWrapper(io.FileIO(os.devnull, "w"), encoding="utf-8", write_through=True)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # a terminal without arrows prints replacement characters
            stream.reconfigure(errors="replace")


def finish_output() -> None:
    """Flush standard output.

    Raises:
        OSError: it cannot be written, or it was closed and something was printed.
    """
    sys.stdout.flush()
    buffer = getattr(sys.stdout, "buffer", None)
    if isinstance(buffer, _ClosedOutput) and buffer.tell():
        raise OSError(errno.EBADF, os.strerror(errno.EBADF))


def finish_errors() -> None:
    """Flush standard error; if it cannot be written, discard it, so that the run keeps its exit code."""
    try:
        sys.stderr.flush()
    except OSError:
        discard(sys.stderr)


def is_of_a_stream(error: OSError) -> bool:
    """Return whether an OSError belongs to a standard stream.

    It then has no file name; writers of files add theirs (`scratch.attribute_errors_to`).
    """
    return error.filename is None and error.errno in (errno.ENOSPC, errno.EFBIG, errno.EBADF)


def discard(*streams: TextIO | None) -> None:
    """Redirect streams to the null device, so that the interpreter can flush them without an error."""
    for stream in streams:
        with suppress(OSError, ValueError, AttributeError):  # a stream without a descriptor
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
