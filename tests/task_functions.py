"""Functions of tasks, which worker processes import by name."""

import errno
import os
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from pcbench.errors import InputError
from pcbench.geometry.neighbors import Index


def square(x):
    return x * x


def logged(folder, x):
    """Append a line for each call, and return x."""
    with (Path(folder) / "calls.txt").open("a") as file:
        file.write(f"{x} {os.getpid()}\n")
    return x


def calls(folder):
    """The arguments of the calls of `logged` in `folder`."""
    file = Path(folder) / "calls.txt"
    return [int(line.split()[0]) for line in file.read_text().splitlines()] if file.exists() else []


def worker_ids(folder):
    return {int(line.split()[1]) for line in (Path(folder) / "calls.txt").read_text().splitlines()}


def slow(folder, x, seconds):
    time.sleep(seconds)
    return logged(folder, x)


def ended(folder, x, victim, times):
    """End its own process by SIGKILL if x is the victim, at the first `times` calls."""
    logged(folder, x)
    if x == victim and calls(folder).count(x) <= times:
        os.kill(os.getpid(), signal.SIGKILL)
    return x


def ended_by(number):
    os.kill(os.getpid(), number)


def exited():
    sys.stdout.write("on standard output\n")
    sys.stderr.write("a library has failed\n")
    sys.stderr.flush()
    os._exit(3)


def printed(x):
    print("a library that prints")
    os.write(1, b"more\n")
    subprocess.run([sys.executable, "-c", "print('and its children')"], check=True)
    return x


def refused(x, refused_ones):
    if x in refused_ones:
        raise InputError(f"{x}: expected another number")
    return x


def wrong(x):
    return 1 // (x - x)


def wrong_argument(error):
    raise error


def full_disk(folder, x, full):
    if x == full:
        raise OSError(errno.ENOSPC, "No space left on device", f"{folder}/points")
    return logged(folder, x)


def limited_file(size):
    """An array that does not fit on a disk with files of at most half its size."""
    resource.setrlimit(resource.RLIMIT_FSIZE, (size // 2, resource.RLIM_INFINITY))
    return np.zeros(size, np.uint8)


def function_in_result():
    return lambda: None


def concurrency(folder):
    """The number of calls that run at the same time."""
    own = Path(folder) / f"{os.getpid()}-{time.monotonic_ns()}"
    own.touch()
    time.sleep(0.05)
    count = len(list(Path(folder).iterdir()))
    own.unlink()
    return count


def thread_counts():
    """Number of threads after a closest-point search and a product of matrices, and of numpy's BLAS library."""
    from pcbench.threads import _blas_threads

    before = _threads()
    points = np.random.default_rng(0).random((20_000, 3))
    Index(points).query(points)
    matrix = np.ones((500, 500))
    assert (matrix @ matrix)[0, 0] == 500
    blas = _blas_threads()
    return _threads() - before, 1 if blas is None else blas.get(), os.environ["OMP_NUM_THREADS"]


def _threads():
    return len(list(Path("/proc/self/task").iterdir()))


def array(x):
    return {"x": x, "values": np.arange(x, dtype=float)}


def cell(shared, cell, step):
    """A cell of a study that announces itself and returns what it got, and its folder and process."""
    step(f"cell {cell}")
    logged(shared["folder"], cell)
    return shared["factor"] * cell, str(Path.cwd()), os.getpid()


def ended_cell(shared, cell, step):
    """A cell whose worker is killed the first time."""
    return ended(shared, cell, 1, 1)


def refused_cell(shared, cell, step):
    if cell == 2:
        raise InputError(f"{cell}: expected another number")
    return logged(shared, cell)
