"""Scripts that run compiled kernels in a fresh process: by instruction set, with threads, or with little memory."""

import json
import os
import subprocess
import sys
from pathlib import Path

from repository import TESTS


def run_script(script, *arguments, **environment):
    """Run a script that may import the modules of this folder; return the completed process."""
    script = f"import sys\nsys.path[:0] = [{str(TESTS)!r}]\n{script}"
    return subprocess.run(
        [sys.executable, "-c", script, *map(str, arguments)],
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
    )


def baseline_digest(script):
    """Return the digest that a script prints, as JSON after its instruction set, with one thread of the baseline."""
    process = run_script(script, PCBENCH_ISA="baseline", OMP_NUM_THREADS="1")
    assert process.returncode == 0, process.stderr
    isa, digest = json.loads(process.stdout)
    assert isa == "baseline"
    return digest


def check_same_bits(script, digest, isa, threads):
    """Check that a script prints the same digest; without these instructions, with several threads of the baseline."""
    process = run_script(script, PCBENCH_ISA=isa, OMP_NUM_THREADS=threads)
    if "PCBENCH_ISA: expected an instruction set that this machine supports" in process.stderr:
        isa, process = "baseline", run_script(script, PCBENCH_ISA="baseline", OMP_NUM_THREADS=threads)
    assert json.loads(process.stdout) == [isa, digest], process.stderr


def run_with_rising_memory(script, *arguments, threads):
    """Run a script that prints the number of MemoryErrors and whether its result is right; check that some occur.

    Blocks of 64 KiB and more are mapped alone and returned when they are freed. Otherwise their number that fails would
    depend on what the heap of each thread has kept.
    """
    process = run_script(script, *arguments, OMP_NUM_THREADS=str(threads), MALLOC_MMAP_THRESHOLD_=str(1 << 16))
    assert process.returncode == 0, process.stderr
    failures, is_right = process.stdout.split()
    assert int(failures) > 3 and is_right == "True", process.stdout


def compute_with_rising_memory(compute):
    """Return the number of MemoryErrors until `compute` succeeds, and its result.

    The limit rises in small steps, so that each large allocation fails once.
    """
    import resource

    failures, headroom = 0, 0
    _, hard_limit = resource.getrlimit(resource.RLIMIT_AS)
    while True:
        used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (used + headroom, hard_limit))
        try:
            result = compute()
            return failures, result
        except MemoryError:
            failures += 1
        finally:
            resource.setrlimit(resource.RLIMIT_AS, (hard_limit, hard_limit))
        headroom += 1 << 18
