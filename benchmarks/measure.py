"""Side-by-side timing: runs of the contestants alternate, medians are reported, nothing is asserted."""

import gc
import os
import platform
import statistics
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple


class Seconds(NamedTuple):
    """Wall and CPU time."""

    wall: float
    cpu: float


def alternate(contestants: dict[str, Callable[[], object]], runs: int) -> dict[str, Seconds]:
    """Return median wall and CPU seconds per contestant.

    Runs alternate, and each second round is in reverse order, so that load affects all of them equally.
    """
    samples: dict[str, list[Seconds]] = {name: [] for name in contestants}
    for number in range(runs):
        for name in list(contestants)[:: 1 if number % 2 == 0 else -1]:
            gc.collect()
            wall, cpu = time.perf_counter(), time.process_time()
            contestants[name]()
            samples[name].append(Seconds(time.perf_counter() - wall, time.process_time() - cpu))
    return {
        name: Seconds(statistics.median(s.wall for s in seconds), statistics.median(s.cpu for s in seconds))
        for name, seconds in samples.items()
    }


def limit_threads(threads: int) -> None:
    """Limit the threads; call before libraries are imported: OpenMP reads the variable, TBB the affinity."""
    os.environ["OMP_NUM_THREADS"] = str(threads)
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:threads])


def commit() -> str:
    """Return the commit of the working tree, with `-dirty` if files other than pages have changed since."""

    def git(*words: str) -> str:
        root = Path(__file__).parents[1]
        return subprocess.run(["git", *words], cwd=root, capture_output=True, text=True).stdout.strip()

    name = git("rev-parse", "--short", "HEAD")
    is_dirty = bool(git("status", "--porcelain", "--untracked-files=no", "--", ":!docs", ":!*.md"))
    return f"{name}-dirty" if is_dirty else name or "unknown"


def setting() -> str:
    """Return commit and machine, for the head of a table."""
    model = next(
        (line.split(":")[1].strip() for line in Path("/proc/cpuinfo").read_text().splitlines() if "model name" in line),
        platform.processor(),
    )
    return f"commit {commit()}; {model}, {os.cpu_count()} CPUs, load {os.getloadavg()[0]:.1f}"
