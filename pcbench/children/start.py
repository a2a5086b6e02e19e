"""Start a child process: `start.py PARENT CPU_SECONDS BYTES ONE_CPU PROGRAM [ARGUMENT...]`.

The program runs in a process with these limits. On Linux a second process waits for it, then ends all processes that it
left. PARENT is the id of the process that started this script. A limit of 0 means no limit. The program is a .py file
or the name of a module.

A daemon leaves its session and its parent, so neither shows who started it. If a process declares itself a subreaper
(prctl(2)), every orphan among its descendants becomes its child; so on Linux no process that a program started outlives
it. The subreaper only waits, because the program's own process may be killed.

This script is never imported and imports nothing of pcbench, nor anything slow, because the LAZ reader has to start in
25 ms. Limits that a system does not support are not set (all on Windows, CPU affinity on macOS).
"""

import os
import runpy
import signal
import sys
from contextlib import suppress

_PR_SET_PDEATHSIG, _PR_SET_CHILD_SUBREAPER = 1, 36  # <sys/prctl.h>


class _Stop(BaseException):
    """Raised when the parent no longer needs the program."""


def main() -> None:
    """Limit this process and run the program in it; on Linux a second process waits for it."""
    parent, cpu_seconds, memory, one_cpu = map(int, sys.argv[1:5])
    program, sys.argv = sys.argv[5], sys.argv[5:]
    if sys.platform.startswith("linux"):
        _end_with_parent(parent, signal.SIGTERM)
        _prctl(_PR_SET_CHILD_SUBREAPER, 1)
        signal.signal(signal.SIGTERM, _stop)
        watch = os.getpid()
        if child := os.fork():
            _watch(child)
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        os.setsid()  # a program that kills its own process group leaves the waiting process alive
        _end_with_parent(watch, signal.SIGKILL)
    if one_cpu and hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    if cpu_seconds:
        _lower_limit("RLIMIT_CPU", cpu_seconds)
    if memory:
        _lower_limit("RLIMIT_CORE", 0)
        _lower_limit("RLIMIT_AS", memory)
    if program.endswith(".py"):
        runpy.run_path(program, run_name="__main__")
    else:
        runpy.run_module(program, run_name="__main__", alter_sys=True)


def _end_with_parent(parent: int, number: int) -> None:
    """Ask the system to send this process a signal when its parent ends; end now if the parent has ended already."""
    _prctl(_PR_SET_PDEATHSIG, number)
    if os.getppid() != parent:
        os._exit(1)


def _watch(child: int) -> None:
    """Wait for the program, end its remaining processes, and end with the same exit code or signal."""
    status = signal.SIGKILL.value
    with suppress(_Stop):
        while True:
            pid, child_status = os.wait()  # returns adopted orphans too
            if pid == child:
                status = child_status
                break
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    _end_descendants()
    code = os.waitstatus_to_exitcode(status)
    if code < 0:
        _lower_limit("RLIMIT_CORE", 0)  # the program has written its own core file
        with suppress(OSError, ValueError):  # SIGKILL and SIGSTOP have fixed handlers
            signal.signal(-code, signal.SIG_DFL)
        os.kill(os.getpid(), -code)
    os._exit(code)


def _end_descendants() -> None:
    """Kill children until none is left: the children of a killed process become children of this one."""
    with suppress(ChildProcessError):
        while True:
            os.waitid(os.P_ALL, 0, os.WEXITED | os.WNOHANG | os.WNOWAIT)  # raises if there are no children
            children = _children()
            for pid in children:
                with suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
            if not children:  # without /proc, children cannot be listed
                return
            os.wait()


def _children() -> list[int]:
    children: list[int] = []
    with suppress(OSError), os.scandir("/proc") as entries:
        children += [int(entry.name) for entry in entries if entry.name.isdecimal() and _is_child(int(entry.name))]
    return children


def _is_child(pid: int) -> bool:
    try:
        file = os.open(f"/proc/{pid}/stat", os.O_RDONLY)
        try:
            return int(os.read(file, 1000).rpartition(b")")[2].split()[1]) == os.getpid()
        finally:
            os.close(file)
    except OSError:  # the process has ended
        return False


def _stop(*_: object) -> None:
    raise _Stop


def _prctl(option: int, value: int) -> None:
    import ctypes

    ctypes.CDLL(None).prctl(option, value)


def _lower_limit(kind: str, limit: int) -> None:
    """Lower a limit of <sys/resource.h> permanently, if the system has it."""
    try:
        import resource
    except ImportError:
        return
    _, hard = resource.getrlimit(getattr(resource, kind))
    limit = limit if hard == resource.RLIM_INFINITY else min(limit, hard)
    resource.setrlimit(getattr(resource, kind), (limit, limit))


if __name__ == "__main__":
    main()
