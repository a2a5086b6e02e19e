"""Calls that travel to workers: a function with its arguments, and the file of its result."""

from __future__ import annotations

import pickle
import struct
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any, NamedTuple

from pcbench.errors import PcbenchError
from pcbench.tasks.files import files_written
from pcbench.tasks.results import write_result

_LENGTH = struct.Struct("<Q")


class Call(NamedTuple):
    """A task as it is run by a worker.

    Attributes:
        function: function of a module, which is imported by its name.
        arguments: its arguments.
        file: file of the result.
        key: key of the stage.
    """

    function: Callable[..., Any]
    arguments: tuple[Any, ...]
    file: Path
    key: str

    def run(self) -> int:
        """Call the function, write its result, and return the size of the file in bytes."""
        with files_written() as files:
            result = self.function(*self.arguments)
        return write_result(self.file, self.key, result, files)


class WorkerLost(Exception):
    """A worker ended before its task was done; the text says how.

    Attributes:
        killed: whether it was killed, as happens if memory runs out.
        times: how many workers the task ended.
    """

    def __init__(self, ending: str, *, killed: bool, times: int = 1) -> None:
        super().__init__(ending)
        self.killed, self.times = killed, times


class ConnectionLost(Exception):
    """The connection to the cluster was lost, or the cluster has forgotten a task."""


def portable(error: Exception) -> Exception:
    """Return an exception that can be pickled: the same one if possible; programming errors note their traceback."""
    text = "".join(traceback.format_exception(error))
    if not isinstance(error, (PcbenchError, OSError)):
        error.add_note(f"In a worker:\n{text}")
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:  # pickling may raise anything
        return RuntimeError(text)
    return error


def send(pipe: IO[bytes], message: bytes) -> None:
    """Write a message to a pipe."""
    pipe.write(_LENGTH.pack(len(message)))
    pipe.write(message)
    pipe.flush()


def receive(pipe: IO[bytes]) -> bytes:
    """Read a message from a pipe.

    Raises:
        EOFError: the other end was closed.
    """
    header = pipe.read(_LENGTH.size)
    if len(header) == _LENGTH.size:
        (length,) = _LENGTH.unpack(header)
        message = pipe.read(length)
        if len(message) == length:
            return message
    raise EOFError
