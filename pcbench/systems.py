"""Differences between operating systems: file locks, memory, CPUs, and waiting for and ending processes.

No other module of the package imports `fcntl` or `resource`, or uses names of `os` and `signal` that only some systems
have. The exception is `children/start.py`, which runs in child processes without pcbench.
"""

from __future__ import annotations

import errno
import importlib
import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO

NO_FOLLOW: int = getattr(os, "O_NOFOLLOW", 0)  # flags of os.open
NO_WAIT: int = getattr(os, "O_NONBLOCK", 0)
SIGKILL: int = getattr(signal, "SIGKILL", 9)

# A Windows lock covers bytes that other processes then cannot read: lock one byte where few files have data.
_LOCK_OFFSET = (1 << 31) - 2
_POLL_INTERVAL_S = 0.01


def lock(descriptor: int, *, wait: bool) -> None:
    """Lock an open file or folder until its descriptor is closed or the process ends.

    Raises:
        BlockingIOError: another process holds the lock, and `wait` is False.
        OSError: the disk or the system does not support locks.
    """
    try:
        import fcntl
    except ImportError:
        _lock_byte(descriptor, wait)
    else:
        fcntl.flock(descriptor, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))


def _lock_byte(descriptor: int, wait: bool) -> None:
    try:
        msvcrt: Any = importlib.import_module("msvcrt")
    except ImportError:
        raise OSError("this system has no file locks") from None
    position = os.lseek(descriptor, 0, os.SEEK_CUR)
    try:
        os.lseek(descriptor, _LOCK_OFFSET, os.SEEK_SET)
        while not _try_lock_byte(msvcrt, descriptor):  # LK_LOCK gives up after ten seconds
            if not wait:
                raise BlockingIOError(errno.EAGAIN, os.strerror(errno.EAGAIN))
            time.sleep(_POLL_INTERVAL_S)
    finally:
        os.lseek(descriptor, position, os.SEEK_SET)


def _try_lock_byte(msvcrt: Any, descriptor: int) -> bool:
    """Lock the byte at the position of a file; return False if another process has locked it."""
    try:
        msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)
    except PermissionError:
        return False
    return True


def open_folder(path: Path) -> int | None:
    """Open a folder to lock it; None on Windows, which cannot open folders.

    Raises:
        FileNotFoundError: the folder does not exist.
    """
    folder: int | None = getattr(os, "O_DIRECTORY", None)
    return None if folder is None else os.open(path, os.O_RDONLY | folder)


def is_owned_by_user(status: os.stat_result) -> bool:
    """Return whether a file belongs to the user of this process; True on systems without users."""
    return not hasattr(os, "geteuid") or status.st_uid == os.geteuid()


def close_and_remove(path: Path, descriptor: int) -> None:
    """Remove a locked file. It stays locked until it is gone, except on Windows, which cannot remove open files."""
    try:
        path.unlink(missing_ok=True)
    except PermissionError:
        os.close(descriptor)
        path.unlink(missing_ok=True)
    else:
        os.close(descriptor)


def rename_open(file: BinaryIO, path: Path, target: Path) -> None:
    """Rename a written file to `target`, replacing it. On Windows, the file is closed (and unlocked) first."""
    file.flush()
    if sys.platform == "win32":
        file.close()
    path.replace(target)


def cpu_count() -> int:
    """Return the number of CPUs that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def memory_limit() -> int | None:
    """Return the limit of this process's address space in bytes; None without a limit."""
    return _limit("RLIMIT_AS")


def file_size_limit() -> int | None:
    """Return the limit of the size of files that this process writes, in bytes; None without a limit."""
    return _limit("RLIMIT_FSIZE")


def _limit(kind: str) -> int | None:
    """Return a limit of <sys/resource.h>; None without one, or if the system has none."""
    try:
        import resource
    except ImportError:
        return None
    limit, _ = resource.getrlimit(getattr(resource, kind))
    return None if limit == resource.RLIM_INFINITY else limit


def peak_memory() -> int:
    """Return the peak resident memory of this process in bytes; 0 if unknown."""
    try:
        import resource
    except ImportError:
        return _peak_working_set()
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * _rss_unit()


def release_free_memory() -> None:
    """Return freed memory of this process to the system, where the C library can (glibc)."""
    import ctypes

    with suppress(OSError, AttributeError, TypeError):
        ctypes.CDLL(None).malloc_trim(0)


def reset_peak_memory() -> int | None:
    """Reset the peak resident memory of this process, and return its memory in bytes; None if the system cannot."""
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        return None
    return _status_bytes("VmRSS")


def peak_memory_since_reset() -> int | None:
    """Return the peak resident memory of this process since `reset_peak_memory` in bytes; None if unknown."""
    return _status_bytes("VmHWM")


def peak_memory_with_children() -> int:
    """Return the peak resident memory of this process or of one of its ended children in bytes; 0 if unknown.

    On Linux `getrusage` includes the memory of the process that started this one, but /proc does not.
    """
    try:
        import resource
    except ImportError:
        return _peak_working_set()
    own = _status_bytes("VmHWM") or peak_memory()
    return max(own, resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss * _rss_unit())


def _status_bytes(name: str) -> int | None:
    """Return an entry of Linux's /proc/self/status in bytes; None if there is none."""
    status = Path("/proc/self/status")
    if not status.is_file():
        return None
    line = next((line for line in status.read_text().splitlines() if line.startswith(f"{name}:")), None)
    return int(line.split()[1]) * 1024 if line else None


def _rss_unit() -> int:
    """Return the unit of `ru_maxrss` in bytes: 1 on macOS, 1024 elsewhere."""
    return 1 if sys.platform == "darwin" else 1024


def _peak_working_set() -> int:
    import ctypes

    class ProcessMemory(ctypes.Structure):  # PROCESS_MEMORY_COUNTERS of <psapi.h>
        _fields_ = (
            ("bytes", ctypes.c_uint32),
            ("page_faults", ctypes.c_uint32),
            ("peak_working_set", ctypes.c_size_t),
            ("others", ctypes.c_size_t * 7),
        )

    try:
        kernel: Any = ctypes.WinDLL("kernel32")  # type: ignore[attr-defined]
    except AttributeError:
        return 0
    kernel.GetCurrentProcess.restype = ctypes.c_void_p
    kernel.K32GetProcessMemoryInfo.argtypes = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_uint32]
    memory = ProcessMemory(bytes=ctypes.sizeof(ProcessMemory))
    has_answer = kernel.K32GetProcessMemoryInfo(kernel.GetCurrentProcess(), ctypes.byref(memory), memory.bytes)
    return int(memory.peak_working_set) if has_answer else 0


def signal_name(number: int) -> str:
    """Return the name of a signal, such as SIGSEGV, or its number if it has no name on this system."""
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"


def wait_until_ended(process: subprocess.Popen[bytes]) -> None:
    """Wait until a child ends.

    If the system allows it, the child stays a zombie until `reap`. Until then no other process gets its id, which is
    also the id of its session.
    """
    if hasattr(os, "waitid"):
        os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)
    else:
        process.wait()


def end_tree(process: subprocess.Popen[bytes], grace_s: float) -> None:
    """End a child that `children/start.py` runs in its own session, and all processes that it started.

    Args:
        process: the child.
        grace_s: seconds that the child has on Linux to end its descendants before its session is killed.
    """
    if sys.platform.startswith("linux"):
        with suppress(ProcessLookupError):
            os.kill(process.pid, signal.SIGTERM)
        for _ in range(round(grace_s / _POLL_INTERVAL_S)):
            if os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT | os.WNOHANG) is not None:
                break
            time.sleep(_POLL_INTERVAL_S)
    if hasattr(os, "killpg"):
        with suppress(ProcessLookupError, PermissionError):  # all have ended
            os.killpg(process.pid, SIGKILL)
    elif process.poll() is None:
        subprocess.run(["taskkill", "/F", "/T", "/PID", str(process.pid)], capture_output=True, check=False)


def reap(process: subprocess.Popen[bytes]) -> tuple[int, float]:
    """Return the exit code of an ended child, and the CPU seconds of it and of the children it waited for.

    The code is minus the signal number if a signal ended the child. The CPU time is 0 on systems that do not report it:
    Windows, and macOS before Python 3.13.
    """
    if process.returncode is not None or not hasattr(os, "wait4"):
        return process.wait(), 0.0
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    return process.returncode, usage.ru_utime + usage.ru_stime
