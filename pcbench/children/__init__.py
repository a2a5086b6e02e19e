"""Child processes: what they find, what they may take, and that nothing of them is left.

Libraries that crash, hang or print, and reconstructors that anybody wrote, run in Python processes of their own. A
child never reads the terminal, ends with its parent, and when it ends everything that it started is ended too (on
Linux daemons as well). What it prints is kept as far as there is a limit.
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

_START = str(Path(__file__).with_name("start.py"))
# The folder that this very package is imported from. Looked up, not imported: pcbench gives names of rooms above.
_PACKAGES = str(Path(sys.modules["pcbench"].__path__[0]).parent)
MAX_LOG = 16 << 20  # bytes of a log, before its end
_MAX_TAIL = 1 << 20  # bytes of the end of a child's output that are kept
_GRACE_S = 10.0  # for what a child started to be ended with it


@dataclass(frozen=True)
class Limits:
    """What a child may take; None: as much as its parent.

    Args:
        seconds: from its start until it and all that it started are killed.
        cpu_seconds: of all its threads, until the system kills it.
        memory: bytes of address space. A child with this limit leaves no core file either.
        one_cpu: whether it runs on one CPU: libraries that count CPUs then start one thread.
    """

    seconds: float | None = None
    cpu_seconds: int | None = None
    memory: int | None = None
    one_cpu: bool = False


@dataclass(frozen=True)
class Ended:
    """How a child ended.

    Args:
        code: its exit code; minus the signal's number where a signal ended it.
        timed_out: whether it was killed for taking too long.
        cpu_s: seconds of CPU time that it and the children it waited for took.
        output, errors: the last part of its standard output and error; empty where they went elsewhere.
        received: bytes of its standard output that were written into the buffer given for them.
    """

    code: int
    timed_out: bool
    cpu_s: float
    output: str
    errors: str
    received: int

    @property
    def last_words(self) -> str:
        """The last line of its standard error that is not blank; empty where there is none."""
        return last_line(self.errors)


def last_line(text: str) -> str:
    """The last line that is not blank; empty where there is none."""
    return next((line.strip() for line in reversed(text.splitlines()) if line.strip()), "")


def run_module(
    name: str,
    *arguments: str,
    limits: Limits | None = None,
    environment: Mapping[str, str] | None = None,
    log: BinaryIO | None = None,
) -> Ended:
    """Run a module of pcbench as a program, and wait for it. It finds this very package, wherever it is run from.

    Args:
        environment: variables beside those of this process.
        log: an open file that gets standard output and error. Of more than `MAX_LOG` bytes the middle is left out,
            which is said there.

    Raises:
        OSError: the log cannot be written.
    """
    return _run([name, *arguments], _import_path(), limits, environment, log=log)


def _import_path() -> list[str]:
    """Return the folders that a child imports from first: the folder of this very package, and those of PYTHONPATH.

    They have the order of this process. The current folder is not among them.
    """
    named = os.environ.get("PYTHONPATH", "")
    before = sys.path[: sys.path.index(_PACKAGES)] if _PACKAGES in sys.path else []
    return [named, _PACKAGES] if set(named.split(os.pathsep)) & set(before) else [_PACKAGES, named]


def run_script(
    file: str | Path,
    *arguments: str,
    limits: Limits | None = None,
    environment: Mapping[str, str] | None = None,
    stdin: BinaryIO | None = None,
    into: memoryview | None = None,
) -> Ended:
    """Run a Python file that imports nothing of pcbench, and wait for it. It imports what this program would import.

    Args:
        file: a .py file.
        environment: variables beside those of this process.
        stdin: an open file that it reads as standard input.
        into: bytes that its standard output is written into, until they are full.
    """
    return _run([str(file), *arguments], sys.path, limits, environment, stdin=stdin, into=into)


def _run(
    program: list[str],
    path: list[str],
    limits: Limits | None,
    environment: Mapping[str, str] | None,
    *,
    log: BinaryIO | None = None,
    stdin: BinaryIO | None = None,
    into: memoryview | None = None,
) -> Ended:
    limits = limits or Limits()
    own = {"PYTHONPATH": os.pathsep.join(filter(None, path)), "PYTHONUNBUFFERED": "1"}
    obeyed = [str(os.getpid()), str(limits.cpu_seconds or 0), str(limits.memory or 0), str(int(limits.one_cpu))]
    process = subprocess.Popen(
        [sys.executable, "-P", _START, *obeyed, *program],
        stdin=subprocess.DEVNULL if stdin is None else stdin,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE if log is None else subprocess.STDOUT,
        bufsize=0,
        env={**os.environ, **own, **(environment or {})},
        start_new_session=True,  # all that it starts can be ended with it
    )
    output = _Drain(process.stdout if into is None else None, log)
    errors = _Drain(process.stderr)
    code, timed_out, cpu_s, received = _wait(process, limits.seconds, into)
    if (failed := output.finish()) is not None:
        raise OSError(failed.errno, failed.strerror, getattr(log, "name", None)) from failed
    errors.finish()
    return Ended(code, timed_out, cpu_s, output.text(), errors.text(), received)


class _Drain(Thread):
    """Takes what comes out of a pipe, so that the child never waits: into a log up to its limit, and its end."""

    def __init__(self, pipe: IO[bytes] | None, log: BinaryIO | None = None) -> None:
        super().__init__(daemon=True)
        self.error: OSError | None = None
        self._pipe, self._log = pipe, log
        self._room = MAX_LOG if log is not None else 0
        self._end, self._left_out = bytearray(), 0
        self.start()

    def run(self) -> None:
        if self._pipe is None:
            return
        with self._pipe as pipe:
            while chunk := os.read(pipe.fileno(), 1 << 16):
                written, rest = chunk[: self._room], chunk[self._room :]
                self._room -= len(written)
                self._write(written)
                self._end += rest
                if len(self._end) > 2 * _MAX_TAIL:
                    self._left_out += len(self._end) - _MAX_TAIL
                    del self._end[:-_MAX_TAIL]

    def finish(self) -> OSError | None:
        """Once the child has ended: the rest of the log, and why it could not be written."""
        self.join(_GRACE_S)
        if self._log is not None and self._end:
            if self._left_out:
                note = f"\n[{self._left_out} bytes are left out here: a log has {MAX_LOG} bytes and its end]\n"
                self._write(note.encode())
            self._write(bytes(self._end))
        return self.error

    def text(self) -> str:
        """The last part of what went into no log."""
        if self._log is not None:
            return ""
        return self._end[-_MAX_TAIL:].decode(locale.getpreferredencoding(False), errors="replace")

    def _write(self, data: bytes) -> None:
        if self._log is None or self.error is not None:
            return
        try:
            while data:  # a file without a buffer may take a part
                data = data[self._log.write(data) :]
            self._log.flush()
        except OSError as error:
            self.error = error


def _wait(
    process: subprocess.Popen[bytes], seconds: float | None, into: memoryview | None
) -> tuple[int, bool, float, int]:
    """Exit code, whether it was killed at the limit, CPU seconds, and the bytes received. Nothing of it is left."""
    expired: list[bool] = []

    def expire() -> None:
        expired.append(True)
        end_tree(process, _GRACE_S)

    watch = Timer(seconds, expire) if seconds is not None else None
    received = 0
    try:
        if watch is not None:
            watch.daemon = True
            watch.start()
        if into is not None:
            received = _receive(process, into)
        wait_until_ended(process)
    finally:
        if watch is not None:
            watch.cancel()
            watch.join()
        end_tree(process, _GRACE_S)  # what it started may outlive it
        code, cpu_s = reap(process)
    return code, bool(expired), cpu_s, received


def _receive(process: subprocess.Popen[bytes], into: memoryview) -> int:
    """Fills the buffer from the child's standard output; how many bytes came."""
    assert process.stdout is not None
    got = 0
    with process.stdout as pipe:
        while got < len(into) and (more := pipe.readinto(into[got:])):  # type: ignore[attr-defined]
            got += more
    return got
