"""CPU seconds, wall seconds and peak memory of a command with all processes that it starts.

`python benchmarks/process_tree.py COMMAND ...` prints them as JSON in the last line. The kernel hands processes whose
parent has ended to this one, so that the CPU seconds of killed workers and of their children are counted too.
"""

from __future__ import annotations

import ctypes
import json
import os
import resource
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import NamedTuple

_PR_SET_CHILD_SUBREAPER = 36
_POLL_S = 0.1


class Usage(NamedTuple):
    """Time and memory that a command needed.

    Attributes:
        wall: wall seconds.
        cpu: CPU seconds of all its processes.
        peak: largest memory of all its processes at one time, in bytes; pages that they share are counted once (PSS).
        peak_main: largest memory of its first process, in bytes.
    """

    wall: float
    cpu: float
    peak: int
    peak_main: int


class CommandFailed(Exception):
    """The command ended with an error; the text is the end of its output."""


def measure(command: list[str], environment: dict[str, str] | None = None) -> Usage:
    """Run a command in a process that measures it.

    Raises:
        CommandFailed: it ended with an error.
    """
    done = subprocess.run(
        [sys.executable, __file__, *command], capture_output=True, text=True, env={**os.environ, **(environment or {})}
    )
    if done.returncode:
        raise CommandFailed("\n".join((done.stdout + done.stderr).strip().splitlines()[-3:]))
    return Usage(*json.loads(done.stdout.splitlines()[-1]))


def _main(command: list[str]) -> int:
    ctypes.CDLL(None).prctl(_PR_SET_CHILD_SUBREAPER, 1)
    start = time.perf_counter()
    main = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    peaks, ended = [0, 0], threading.Event()
    watcher = threading.Thread(target=_watch, args=(main.pid, peaks, ended))
    watcher.start()
    code = main.wait()
    wall = time.perf_counter() - start
    ended.set()
    watcher.join()
    while True:  # processes without parent
        try:
            os.wait()
        except ChildProcessError:
            break
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    print(json.dumps(Usage(wall, usage.ru_utime + usage.ru_stime, *peaks)))
    return code


def _watch(main: int, peaks: list[int], ended: threading.Event) -> None:
    while not ended.wait(_POLL_S):
        memory = {process: _memory(process) for process in _descendants(os.getpid())}
        peaks[0] = max(peaks[0], sum(memory.values()))
        peaks[1] = max(peaks[1], memory.get(main, 0))


def _descendants(ancestor: int) -> list[int]:
    found, todo = list[int](), [ancestor]
    while todo:
        process = todo.pop()
        for file in Path(f"/proc/{process}/task").glob("*/children"):
            try:
                children = list(map(int, file.read_text().split()))
            except OSError:  # it has ended
                continue
            found += children
            todo += children
    return found


def _memory(process: int) -> int:
    try:
        lines = Path(f"/proc/{process}/smaps_rollup").read_text().splitlines()
    except OSError:  # it has ended
        return 0
    return next((int(line.split()[1]) << 10 for line in lines if line.startswith("Pss:")), 0)


if __name__ == "__main__":
    sys.exit(_main(sys.argv[1:]))
