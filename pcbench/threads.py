"""Limits of the numbers of threads: before numpy and the compiled core are loaded, and during linear algebra.

Their libraries end the process if a thread cannot be started.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from typing import NamedTuple

from pcbench.errors import InputError
from pcbench.systems import cpu_count, memory_limit

ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
"""Environment of processes that have one thread each. Libraries read these variables when they are loaded."""
_MAX_THREADS = 1024  # or the number of CPUs if that is larger
_THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")
_BYTES_PER_THREAD = 256 << 20  # of limited address space, for stack, heap and buffers of one thread
# Names of OpenBLAS's functions in numpy's wheels and in Linux distributions, with {} for `get` or `set`.
_BLAS_FUNCTIONS = (
    "scipy_openblas_{}_num_threads64_",
    "scipy_openblas_{}_num_threads",
    "openblas_{}_num_threads64_",
    "openblas_{}_num_threads",
)


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


class _BlasThreads(NamedTuple):
    """Functions that read and set the number of threads of numpy's BLAS library."""

    get: Callable[[], int]
    set: Callable[[int], object]


class _BlasLimit:
    """State of the limit: the number of open blocks, and of the library's threads before the first of them."""

    def __init__(self) -> None:
        self.lock = threading.Lock()
        self.blocks = 0
        self.threads_before = 1


_blas_limit = _BlasLimit()


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Limit numpy's BLAS library to one thread within a `with` block.

    More threads do not accelerate small matrices, but wait for each other in busy loops, and change the order of sums.
    Blocks may be nested and may run in several threads; the limit ends with the last of them. It is silently omitted if
    the library is not OpenBLAS.
    """
    blas, limit = _blas_threads(), _blas_limit
    if blas is None:
        yield
        return
    with limit.lock:
        if limit.blocks == 0:
            limit.threads_before = blas.get()
            blas.set(1)
        limit.blocks += 1
    try:
        yield
    finally:
        with limit.lock:
            limit.blocks -= 1
            if limit.blocks == 0:
                blas.set(limit.threads_before)


@cache
def _blas_threads() -> _BlasThreads | None:
    """Return the functions of numpy's OpenBLAS; None if it uses another library."""
    import ctypes

    from numpy.linalg import _umath_linalg  # linked to the library

    try:
        # Names are looked up in the module and in the libraries it is linked to, except on Windows.
        module = ctypes.CDLL(_umath_linalg.__file__)
    except OSError:
        return None
    for name in _BLAS_FUNCTIONS:
        try:
            return _BlasThreads(getattr(module, name.format("get")), getattr(module, name.format("set")))
        except AttributeError:
            pass
    return None


def _first_number(text: str) -> int | None:
    """Return the first number of a comma-separated list, which applies to the outermost threads; None without one.

    Numbers of 20 or more digits are returned as 10^19.
    """
    word = text.split(",")[0].strip()
    return int(word) if word.isdecimal() and len(word) < 20 else 10**19 if word.isdecimal() else None
