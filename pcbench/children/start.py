"""Start a child process: `start.py PARENT CPU_SECONDS BYTES ONE_CPU PROGRAM [ARGUMENT...]`.

The program runs in a process of its own that limits itself. This one waits for it, and ends whatever it left running.
PARENT is the process that started this one. A limit of 0 is none; the program is a .py file or the name of a module.

A daemon leaves its session and its parent, so that neither says whose it is. But where a process declares itself the
subreaper (prctl(2)), every orphan among its descendants becomes its child: on Linux nothing of a program outlives it.
A process that only waits can do this; the program's own, which may be killed, cannot.

Run as a script, never imported: nothing of pcbench is imported here, nor anything that takes long, because the reader
of LAZ files starts in 25 ms. Where a system has no limits (Windows) or no affinity (macOS too), none is set.
"""

import os
import runpy
import signal
import sys
from contextlib import suppress

_PR_SET_PDEATHSIG, _PR_SET_CHILD_SUBREAPER = 1, 36  # <sys/prctl.h>


class _Stop(BaseException):
    """The process that waits for the program has no more use for it."""


def main() -> None:
    parent, cpu_seconds, memory, one_cpu = map(int, sys.argv[1:5])
    program, sys.argv = sys.argv[5], sys.argv[5:]
    if sys.platform.startswith("linux"):
        _end_with(parent, signal.SIGTERM)
        _prctl(_PR_SET_CHILD_SUBREAPER, 1)
        signal.signal(signal.SIGTERM, _stop)
        watch = os.getpid()
        if child := os.fork():
            _watch(child)
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        os.setsid()  # a program that kills its own group leaves the watch alive
        _end_with(watch, signal.SIGKILL)
    if one_cpu and hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    if cpu_seconds:
        _limit("RLIMIT_CPU", cpu_seconds)
    if memory:
        _limit("RLIMIT_CORE", 0)
        _limit("RLIMIT_AS", memory)
    if program.endswith(".py"):
        runpy.run_path(program, run_name="__main__")
    else:
        runpy.run_module(program, run_name="__main__", alter_sys=True)


def _end_with(parent: int, number: int) -> None:
    """Have the system send a signal to this process when its parent ends; end at once where that has happened."""
    _prctl(_PR_SET_PDEATHSIG, number)
    if os.getppid() != parent:
        os._exit(1)


def _watch(child: int) -> None:
    """Wait for the program, end what is left of it, and end as it did."""
    status = signal.SIGKILL.value
    with suppress(_Stop):
        while True:
            pid, ended = os.wait()  # an orphan now and then
            if pid == child:
                status = ended
                break
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    _end_descendants()
    code = os.waitstatus_to_exitcode(status)
    if code < 0:
        _limit("RLIMIT_CORE", 0)  # the program has left its own
        with suppress(OSError, ValueError):  # SIGKILL and SIGSTOP have no other handler
            signal.signal(-code, signal.SIG_DFL)
        os.kill(os.getpid(), -code)
    os._exit(code)


def _end_descendants() -> None:
    """Kill children until there are none: those of a killed one become this process's own."""
    with suppress(ChildProcessError):
        while True:
            os.waitid(os.P_ALL, 0, os.WEXITED | os.WNOHANG | os.WNOWAIT)  # is there any?
            children = _children()
            for pid in children:
                with suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
            if not children:  # no /proc to find them in
                return
            os.wait()


def _children() -> list[int]:
    found: list[int] = []
    with suppress(OSError), os.scandir("/proc") as entries:
        found += [int(entry.name) for entry in entries if entry.name.isdecimal() and _is_child(int(entry.name))]
    return found


def _is_child(pid: int) -> bool:
    try:
        file = os.open(f"/proc/{pid}/stat", os.O_RDONLY)
        try:
            return int(os.read(file, 1000).rpartition(b")")[2].split()[1]) == os.getpid()
        finally:
            os.close(file)
    except OSError:  # it has gone
        return False


def _stop(*_: object) -> None:
    raise _Stop


def _prctl(option: int, value: int) -> None:
    import ctypes

    ctypes.CDLL(None).prctl(option, value)


def _limit(kind: str, most: int) -> None:
    """Lower a limit of <sys/resource.h> for good, where the system has it."""
    try:
        import resource
    except ImportError:
        return
    _, hard = resource.getrlimit(getattr(resource, kind))
    most = most if hard == resource.RLIM_INFINITY else min(most, hard)
    resource.setrlimit(getattr(resource, kind), (most, most))


if __name__ == "__main__":
    main()
