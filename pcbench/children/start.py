"""Where each child process starts: `start.py CPU_SECONDS BYTES ONE_CPU PROGRAM [ARGUMENT...]` limits itself, then runs
the program. A limit of 0 is none; the program is a .py file or the name of a module.

Only the process itself can do this before anything else happens in it. Run as a script, never imported: nothing of
pcbench is imported here, nor anything that takes long, because the reader of LAZ files starts in 25 ms.
"""

import os
import resource
import runpy
import sys

_PR_SET_PDEATHSIG, _SIGKILL = 1, 9  # <sys/prctl.h>, <signal.h>


def main() -> None:
    cpu_seconds, memory, one_cpu = map(int, sys.argv[1:4])
    program, sys.argv = sys.argv[4], sys.argv[4:]
    _end_with_parent()
    if one_cpu:
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    if cpu_seconds:
        _limit(resource.RLIMIT_CPU, cpu_seconds)
    if memory:
        _limit(resource.RLIMIT_CORE, 0)
        _limit(resource.RLIMIT_AS, memory)
    if program.endswith(".py"):
        runpy.run_path(program, run_name="__main__")
    else:
        runpy.run_module(program, run_name="__main__", alter_sys=True)


def _end_with_parent() -> None:
    """Where the process that waits for this one is killed, nobody would stop it: it would be in the way of the next."""
    if sys.platform.startswith("linux"):
        import ctypes

        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, _SIGKILL)


def _limit(kind: int, most: int) -> None:
    _, hard = resource.getrlimit(kind)
    most = most if hard == resource.RLIM_INFINITY else min(most, hard)
    resource.setrlimit(kind, (most, most))


if __name__ == "__main__":
    main()
