"""The same reconstruction several times: on few and many threads and CPUs, and beside busy processes."""

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

# Small settings of the reconstructors, by name: seconds each.
SMALL = {
    "sfm": {"poses": "solve", "features": "1500", "upsample": "no"},
    "mvs": {"backend": "bundled"},
    "splat": {"start": "sfm", "supervision": "none", "steps": "60", "gaussians": "1000", "device": "cpu"},
}


class Conditions(NamedTuple):
    """How a reconstruction is run.

    Args:
        cpus: how many it may use.
        threads: OMP_NUM_THREADS.
        busy: processes beside it that do nothing but compute.
    """

    cpus: int
    threads: int
    busy: int


# As many CPUs as there are is at least one of these; more threads than CPUs are switched between at any place.
CONDITIONS = (Conditions(1, 1, 0), Conditions(cpus(), 2, 2), Conditions(cpus(), 7, 2))


class Repeat(NamedTuple):
    """What a run made: its number of points, and SHA-256 of the bytes of the cloud's file."""

    points: int
    sha256: str


def repeat(method: str, scene: Path, workspace: Path, conditions: Conditions, **settings: str) -> Repeat:
    """Run a reconstructor with small settings in a new workspace."""
    with under(conditions):
        made = run(ReconstructionJob(method, scene, SMALL[method] | settings), workspace)
    points = len(made.required().cloud)
    return Repeat(points, hashlib.sha256((workspace / "cloud.ply").read_bytes()).hexdigest())


@contextmanager
def under(conditions: Conditions) -> Iterator[None]:
    """Child processes that are started meanwhile run under these conditions."""
    allowed = os.sched_getaffinity(0)
    threads = os.environ.get("OMP_NUM_THREADS")
    spin = [sys.executable, "-c", "while True: pass"]
    spinning = [subprocess.Popen(spin) for _ in range(conditions.busy)]
    try:
        os.sched_setaffinity(0, sorted(allowed)[: conditions.cpus])
        os.environ["OMP_NUM_THREADS"] = str(conditions.threads)
        yield
    finally:
        for process in spinning:
            process.kill()
            process.wait()
        os.sched_setaffinity(0, allowed)
        if threads is None:
            del os.environ["OMP_NUM_THREADS"]
        else:
            os.environ["OMP_NUM_THREADS"] = threads
