"""How many threads may start: asked before numpy and the compiled core are loaded, whose libraries end the process
where a thread of theirs does not start.
"""

from __future__ import annotations

import os

from pcbench.errors import InputError
from pcbench.systems import cpus, memory_limit

_MAX_THREADS = 1024  # and as many as there are CPUs, where these are more
_COUNTS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")
_MEMORY = 256 << 20  # bytes of limited address space for which one thread is started: its stack, its heap, its work


def fit_threads() -> None:
    """Refuse a number of threads that no machine has, and lower it to what a limited address space has room for; let
    threads that wait sleep.

    Results are the same at any number.

    Raises:
        InputError: OMP_NUM_THREADS is too large.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # spinning takes from other programs what they wait for
    most = max(_MAX_THREADS, cpus())
    asked = {name: _first(os.environ.get(name, "")) for name in _COUNTS}
    if (count := asked["OMP_NUM_THREADS"]) is not None and count > most:
        raise InputError(f"OMP_NUM_THREADS={count}: expected at most {most} threads: give fewer, or unset it")
    memory = memory_limit()
    if memory is not None:
        room = max(1, memory // _MEMORY)
        for name, count in asked.items():
            if (count or cpus()) > room:
                os.environ[name] = str(room)


def _first(text: str) -> int | None:
    """The first number of a list, which is that of the outermost threads; None where it is none."""
    word = text.split(",")[0].strip()
    return int(word) if word.isdecimal() and len(word) < 20 else 10**19 if word.isdecimal() else None
