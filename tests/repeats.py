"""Repeated reconstructions with different numbers of threads and CPUs, and next to busy processes."""

import hashlib
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from pcbench.plugins.run import ReconstructionJob, run
from pcbench.threads import cpu_count

# Settings of each reconstructor, by its name, with which it takes seconds.
FAST_SETTINGS = {
    "sfm": {"poses": "solve", "features": "1500", "upsample": "no"},
    "mvs": {"backend": "bundled"},
    "splat": {"start": "sfm", "supervision": "none", "steps": "60", "gaussians": "1000", "device": "cpu"},
    "field": {"steps": "150", "resolution": "64"},
}


class Conditions(NamedTuple):
    """Conditions of a run.

    Args:
        cpus: number of CPUs that it may use.
        threads: OMP_NUM_THREADS.
        busy: number of other processes that keep CPUs busy.
    """

    cpus: int
    threads: int
    busy: int


# At least one condition uses all CPUs; with more threads than CPUs, threads are preempted anywhere.
CONDITIONS = (Conditions(1, 1, 0), Conditions(cpu_count(), 2, 2), Conditions(cpu_count(), 7, 2))


class Repeat(NamedTuple):
    """Result of a run: the number of points, and the SHA-256 of the cloud's file."""

    points: int
    sha256: str


def repeat(method: str, scene: Path, workspace: Path, conditions: Conditions, **settings: str) -> Repeat:
    """Run a reconstructor with fast settings in a new workspace."""
    with apply_conditions(conditions):
        result = run(ReconstructionJob(method, scene, FAST_SETTINGS[method] | settings), workspace)
    points = len(result.require_reconstruction().cloud)
    return Repeat(points, hashlib.sha256((workspace / "cloud.ply").read_bytes()).hexdigest())


@contextmanager
def apply_conditions(conditions: Conditions) -> Iterator[None]:
    """Run the child processes of the block under these conditions."""
    available_cpus = os.sched_getaffinity(0)
    threads = os.environ.get("OMP_NUM_THREADS")
    busy_command = [sys.executable, "-c", "while True: pass"]
    processes = [subprocess.Popen(busy_command) for _ in range(conditions.busy)]
    try:
        os.sched_setaffinity(0, sorted(available_cpus)[: conditions.cpus])
        os.environ["OMP_NUM_THREADS"] = str(conditions.threads)
        yield
    finally:
        for process in processes:
            process.kill()
            process.wait()
        os.sched_setaffinity(0, available_cpus)
        if threads is None:
            del os.environ["OMP_NUM_THREADS"]
        else:
            os.environ["OMP_NUM_THREADS"] = threads
