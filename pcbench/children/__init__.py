"""Start, limit and clean up child processes.

Libraries that crash, hang or print, and third-party reconstructors, run in separate Python processes. A child cannot
read the terminal and ends with its parent. When it ends, all processes that it started are ended too (on Linux even
daemons). Its output is kept up to a limit.
"""

from __future__ import annotations

import locale
import os
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from threading import Thread, Timer
from typing import IO, BinaryIO

from pcbench.systems import end_tree, reap, wait_until_ended

_START_SCRIPT = str(Path(__file__).with_name("start.py"))
# The folder of the package `pcbench`, which is not imported here because it exports names of higher layers.
_IMPORT_ROOT = str(Path(sys.modules["pcbench"].__path__[0]).parent)
MAX_LOG_BYTES = 16 << 20  # kept from the start of a log; the end is kept too
_MAX_TAIL_BYTES = 1 << 20  # kept at the end of a child's output
_GRACE_S = 10.0  # maximum time to end the processes that a child left


@dataclass(frozen=True)
class Limits:
    """Resource limits of a child; None means the limits of its parent.

    Args:
        seconds: wall time after which the child and all processes that it started are killed.
        cpu_seconds: CPU time of all its threads, after which the system kills it.
        memory: bytes of address space. A child with this limit writes no core file.
        one_cpu: whether it runs on one CPU, so that libraries that count CPUs start one thread.
    """

    seconds: float | None = None
    cpu_seconds: int | None = None
    memory: int | None = None
    one_cpu: bool = False


@dataclass(frozen=True)
class ChildResult:
    """Exit status and output of a child.

    Args:
        code: exit code; minus the signal number if a signal ended it.
        timed_out: whether it was killed at its time limit.
        cpu_s: CPU seconds of the child and of the children it waited for.
        output: last part of its standard output; empty if that went elsewhere.
        errors: last part of its standard error; empty if that went elsewhere.
        received: bytes of its standard output written into the caller's buffer.
    """

    code: int
    timed_out: bool
    cpu_s: float
    output: str
    errors: str
    received: int

    @property
    def last_error_line(self) -> str:
        """The last line of its standard error that is not blank; empty if there is none."""
        return last_line(self.errors)


def last_line(text: str) -> str:
    """Return the last line that is not blank; empty if there is none."""
    return next((line.strip() for line in reversed(text.splitlines()) if line.strip()), "")


def run_module(
    name: str,
    *arguments: str,
    limits: Limits | None = None,
    environment: Mapping[str, str] | None = None,
    log: BinaryIO | None = None,
) -> ChildResult:
    """Run a module of this pcbench package as a program and wait for it.

    Args:
        name: name of the module.
        arguments: command-line arguments.
        limits: resource limits.
        environment: variables to add to those of this process.
        log: open file for standard output and error. If there are more than `MAX_LOG_BYTES`, a note in the log replaces
            the middle part.

    Raises:
        OSError: the log cannot be written.
    """
    return _run([name, *arguments], _import_path(), limits, environment, log=log)


def _import_path() -> list[str]:
    """Return the folders that a child searches first for imports: this package's folder and those of PYTHONPATH.

    Their order is that of this process. The current folder is not among them.
    """
    python_path = os.environ.get("PYTHONPATH", "")
    before = sys.path[: sys.path.index(_IMPORT_ROOT)] if _IMPORT_ROOT in sys.path else []
    overrides = set(python_path.split(os.pathsep)) & set(before)
    return [python_path, _IMPORT_ROOT] if overrides else [_IMPORT_ROOT, python_path]


def run_script(
    file: str | Path,
    *arguments: str,
    limits: Limits | None = None,
    environment: Mapping[str, str] | None = None,
    into: memoryview | None = None,
) -> ChildResult:
    """Run a Python file that imports nothing of pcbench and wait for it; its imports resolve as in this process.

    Args:
        file: a .py file.
        arguments: command-line arguments.
        limits: resource limits.
        environment: variables to add to those of this process.
        into: buffer for standard output, written until it is full.
    """
    return _run([str(file), *arguments], sys.path, limits, environment, into=into)


def start_module(
    name: str,
    *,
    environment: Mapping[str, str],
    stdin: BinaryIO | int,
    stdout: BinaryIO | int,
    stderr: BinaryIO | int,
) -> subprocess.Popen[bytes]:
    """Start a module of this pcbench package as a program; its imports resolve as in this process.

    The caller ends it with `pcbench.systems.end_tree` and `reap`. On Linux it ends with the thread that started it.

    Args:
        name: name of the module.
        environment: variables to add to those of this process.
        stdin: standard input, as for `subprocess.Popen`.
        stdout: standard output.
        stderr: standard error.
    """
    return _start([name], sys.path, Limits(), environment, stdin=stdin, stdout=stdout, stderr=stderr, buffer=-1)


def _run(
    program: list[str],
    path: list[str],
    limits: Limits | None,
    environment: Mapping[str, str] | None,
    *,
    log: BinaryIO | None = None,
    into: memoryview | None = None,
) -> ChildResult:
    process = _start(
        program,
        path,
        limits or Limits(),
        environment,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE if log is None else subprocess.STDOUT,
    )
    output = _PipeReader(process.stdout if into is None else None, log)
    errors = _PipeReader(process.stderr)
    code, timed_out, cpu_s, received = _wait(process, limits.seconds if limits else None, into)
    if (error := output.finish()) is not None:
        raise OSError(error.errno, error.strerror, getattr(log, "name", None)) from error
    errors.finish()
    return ChildResult(code, timed_out, cpu_s, output.text(), errors.text(), received)


def _start(
    program: list[str],
    path: list[str],
    limits: Limits,
    environment: Mapping[str, str] | None,
    *,
    stdin: BinaryIO | int,
    stdout: BinaryIO | int,
    stderr: BinaryIO | int,
    buffer: int = 0,
) -> subprocess.Popen[bytes]:
    own = {"PYTHONPATH": os.pathsep.join(filter(None, path)), "PYTHONUNBUFFERED": "1"}
    start_arguments = [
        str(os.getpid()),
        str(limits.cpu_seconds or 0),
        str(limits.memory or 0),
        str(int(limits.one_cpu)),
    ]
    return subprocess.Popen(
        [sys.executable, "-P", _START_SCRIPT, *start_arguments, *program],
        stdin=stdin,
        stdout=stdout,
        stderr=stderr,
        bufsize=buffer,
        env={**os.environ, **own, **(environment or {})},
        start_new_session=True,  # its processes can be ended together
    )


class _PipeReader(Thread):
    """Reads a pipe so that the child never blocks; writes a log up to its limit, and keeps the end of the output."""

    def __init__(self, pipe: IO[bytes] | None, log: BinaryIO | None = None) -> None:
        super().__init__(daemon=True)
        self.error: OSError | None = None
        self._pipe, self._log = pipe, log
        self._log_bytes_left = MAX_LOG_BYTES if log is not None else 0
        self._tail, self._skipped_bytes = bytearray(), 0
        self.start()

    def run(self) -> None:
        if self._pipe is None:
            return
        with self._pipe as pipe:
            while chunk := os.read(pipe.fileno(), 1 << 16):
                written, rest = chunk[: self._log_bytes_left], chunk[self._log_bytes_left :]
                self._log_bytes_left -= len(written)
                self._write(written)
                self._tail += rest
                if len(self._tail) > 2 * _MAX_TAIL_BYTES:
                    self._skipped_bytes += len(self._tail) - _MAX_TAIL_BYTES
                    del self._tail[:-_MAX_TAIL_BYTES]

    def finish(self) -> OSError | None:
        """Write the rest of the log after the child has ended; return the error if it could not be written."""
        self.join(_GRACE_S)
        if self._log is not None and self._tail:
            if self._skipped_bytes:
                note = f"\n[{self._skipped_bytes} bytes omitted: a log keeps {MAX_LOG_BYTES} bytes and its end]\n"
                self._write(note.encode())
            self._write(bytes(self._tail))
        return self.error

    def text(self) -> str:
        """Return the last part of the output that was not logged."""
        if self._log is not None:
            return ""
        return self._tail[-_MAX_TAIL_BYTES:].decode(locale.getpreferredencoding(False), errors="replace")

    def _write(self, data: bytes) -> None:
        if self._log is None or self.error is not None:
            return
        try:
            while data:  # an unbuffered file may write only a part
                data = data[self._log.write(data) :]
            self._log.flush()
        except OSError as error:
            self.error = error


def _wait(
    process: subprocess.Popen[bytes], seconds: float | None, into: memoryview | None
) -> tuple[int, bool, float, int]:
    """Wait for a child and end its processes; return exit code, timeout flag, CPU seconds and received bytes."""
    expired: list[bool] = []

    def expire() -> None:
        expired.append(True)
        end_tree(process, _GRACE_S)

    timer = Timer(seconds, expire) if seconds is not None else None
    received = 0
    try:
        if timer is not None:
            timer.daemon = True
            timer.start()
        if into is not None:
            received = _receive(process, into)
        wait_until_ended(process)
    finally:
        if timer is not None:
            timer.cancel()
            timer.join()
        end_tree(process, _GRACE_S)  # its processes may outlive it
        code, cpu_s = reap(process)
    return code, bool(expired), cpu_s, received


def _receive(process: subprocess.Popen[bytes], into: memoryview) -> int:
    """Fill a buffer from the child's standard output; return the number of bytes."""
    assert process.stdout is not None
    received = 0
    with process.stdout as pipe:
        while received < len(into) and (count := pipe.readinto(into[received:])):  # type: ignore[attr-defined]
            received += count
    return received
