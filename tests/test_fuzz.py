"""Damaged PLY files by the thousand: a cloud or PcbenchError comes out, in little memory and time.

Run as a script (`python tests/test_fuzz_ply.py COUNT SEED FOLDER`) it is the worker: the test gives it a process of its
own, so that memory and time are limited by the system and a crash is seen.
"""

import collections
import random
import resource
import signal
import subprocess
import sys
import warnings
from pathlib import Path

import pytest
from ply_bytes import corpus, damaged

MEMORY = 2 << 30  # bytes of address space; numpy and its threads take about a fifth of it
SECONDS_PER_FILE = 5


def worker(count, seed, folder):
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    from pcbench.errors import PcbenchError
    from pcbench.io import read_cloud

    warnings.simplefilter("error")
    rng = random.Random(seed)
    files = list(corpus().items())
    path = folder / "a.ply"
    outcomes = collections.Counter()
    for number in range(count):
        name, data = rng.choice(files)
        path.write_bytes(damaged(data, rng))  # stays behind for a look if anything below fails
        signal.alarm(SECONDS_PER_FILE)
        try:
            cloud = read_cloud(path, on_warning=lambda note: None)
        except PcbenchError as error:
            message = str(error)
            if not message.startswith(f"{path}: ") or not message.isprintable() or len(message) > len(str(path)) + 400:
                raise SystemExit(f"{number} ({name}): not one clear line: {message!r}") from error
            if "memory" in message:
                raise SystemExit(f"{number} ({name}): an allocation of the size that the damage asks for") from error
            outcomes["refused"] += 1
        else:
            if not len(cloud):
                raise SystemExit(f"{number} ({name}): a cloud without points")
            outcomes["read"] += 1
        signal.alarm(0)
    print(dict(outcomes))
    if min(outcomes["refused"], outcomes["read"]) < count // 50:
        raise SystemExit("the damage is too strong or too weak to tell anything")


def run(count, seed, folder):
    command = [sys.executable, __file__, str(count), str(seed), str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60 + count / 10)
    assert done.returncode == 0, f"exit {done.returncode}, file {folder}/a.ply:\n{done.stdout}{done.stderr}"


def test_a_thousand_damaged_files(tmp_path):
    run(1000, 1, tmp_path)


@pytest.mark.slow
def test_twenty_thousand_damaged_files(tmp_path):
    run(20_000, 2, tmp_path)


if __name__ == "__main__":
    worker(int(sys.argv[1]), int(sys.argv[2]), Path(sys.argv[3]))
