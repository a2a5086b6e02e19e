"""Limit the number of threads before numpy and the compiled core are loaded.

Their libraries end the process if a thread cannot be started.
"""

from __future__ import annotations

import os

from pcbench.errors import InputError
from pcbench.systems import cpu_count, memory_limit

_MAX_THREADS = 1024  # or the number of CPUs if that is larger
_THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")
_BYTES_PER_THREAD = 256 << 20  # of limited address space, for stack, heap and buffers of one thread


def limit_threads() -> None:
    """Refuse an excessive number of threads, and reduce it to fit a limited address space.

    Idle threads sleep. Results are the same with any number of threads.

    Raises:
        InputError: OMP_NUM_THREADS is too large.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # spinning would take CPU time from other programs
    max_threads = max(_MAX_THREADS, cpu_count())
    requested = {name: _first_number(os.environ.get(name, "")) for name in _THREAD_VARIABLES}
    if (count := requested["OMP_NUM_THREADS"]) is not None and count > max_threads:
        raise InputError(f"OMP_NUM_THREADS={count}: expected at most {max_threads} threads: lower it, or unset it")
    memory = memory_limit()
    if memory is not None:
        fitting = max(1, memory // _BYTES_PER_THREAD)
        for name, count in requested.items():
            if (count or cpu_count()) > fitting:
                os.environ[name] = str(fitting)


def _first_number(text: str) -> int | None:
    """Return the first number of a comma-separated list, which applies to the outermost threads; None without one.

    Numbers of 20 or more digits are returned as 10^19.
    """
    word = text.split(",")[0].strip()
    return int(word) if word.isdecimal() and len(word) < 20 else 10**19 if word.isdecimal() else None
