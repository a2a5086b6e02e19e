"""Repeat a reconstruction with few and many threads and CPUs, and with other processes running."""

import hashlib
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from pcbench.plugins.run import ReconstructionJob, run
from pcbench.threads import cpus

# Small settings of each reconstructor, for runs of seconds.
SMALL = {
    "sfm": {"poses": "solve", "features": "1500", "upsample": "no"},
    "mvs": {"backend": "bundled"},
    "splat": {"start": "sfm", "supervision": "none", "steps": "60", "gaussians": "1000", "device": "cpu"},
}


class Conditions(NamedTuple):
    """Conditions under which a reconstruction runs.

    Args:
        cpus: number of CPUs that it may use.
        threads: OMP_NUM_THREADS.
        busy: number of other processes that only compute.
    """

    cpus: int
    threads: int
    busy: int


# Either one CPU or all. More threads than CPUs are preempted at arbitrary positions.
CONDITIONS = (Conditions(1, 1, 0), Conditions(cpus(), 2, 2), Conditions(cpus(), 7, 2))


class Repeat(NamedTuple):
    """Result of a run: the number of points, and the SHA-256 of the cloud's file."""

    points: int
    sha256: str


def repeat(method: str, scene: Path, workspace: Path, conditions: Conditions, **settings: str) -> Repeat:
    """Run a reconstructor with small settings in a new workspace."""
    with under(conditions):
        result = run(ReconstructionJob(method, scene, SMALL[method] | settings), workspace)
    points = len(result.required().cloud)
    return Repeat(points, hashlib.sha256((workspace / "cloud.ply").read_bytes()).hexdigest())


@contextmanager
def under(conditions: Conditions) -> Iterator[None]:
    """Apply the conditions to child processes that are started in the context."""
    allowed = os.sched_getaffinity(0)
    threads = os.environ.get("OMP_NUM_THREADS")
    spin = [sys.executable, "-c", "while True: pass"]
    busy_processes = [subprocess.Popen(spin) for _ in range(conditions.busy)]
    try:
        os.sched_setaffinity(0, sorted(allowed)[: conditions.cpus])
        os.environ["OMP_NUM_THREADS"] = str(conditions.threads)
        yield
    finally:
        for process in busy_processes:
            process.kill()
            process.wait()
        os.sched_setaffinity(0, allowed)
        if threads is None:
            del os.environ["OMP_NUM_THREADS"]
        else:
            os.environ["OMP_NUM_THREADS"] = threads
