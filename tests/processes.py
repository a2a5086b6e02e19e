"""Checks that processes end."""

import os
import time
from pathlib import Path


def has_ended(pid):
    """Whether a process ends within ten seconds; an orphan is reaped with a short delay."""
    for _ in range(100):
        if not _is_alive(pid):
            return True
        time.sleep(0.1)
    return False


def _is_alive(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    stat = Path(f"/proc/{pid}/stat")
    try:
        return stat.read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return not Path("/proc/self").exists()
