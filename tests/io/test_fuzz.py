"""Damaged files by the thousand: a cloud or PcbenchError comes out, in little memory and time.

Run as a script (`python tests/test_fuzz.py FORMAT COUNT SEED FOLDER`) it is the worker: the test gives it a process of
its own, so that memory and time are limited by the system and a crash is seen.
"""

import collections
import os
import random
import resource
import signal
import struct
import subprocess
import sys
import warnings
from pathlib import Path

import las_bytes
import pcd_bytes
import ply_bytes
import pytest
from repository import TESTS

MEMORY = 2 << 30  # bytes of address space; numpy and its threads take about a fifth of it
SECONDS_PER_FILE = 5
TEXTS = {
    "plain": "0 1 2\n3.5 -4e3 5\n" * 9,
    "header": "x,y,z,red,green,blue,id\n" + "1.5,2.5,3.5,255,0,9,7\n" * 9,
    "remarks": "# crs EPSG:32617\n//X Y Z R G B\n3\n1 2 3 4 5 6\n# half\n1 2 3 4 5 6\n\n1 2 3 4 5 7 # end\n",
    "semicolons": "x;y;z;nx;ny;nz\r\n" + "1.25; 2; nan; 0; 0; 1\r\n1;2;3;0;1;0\r\n" * 5,
    "tabs": "1\t2\t3\t0.5\n" * 9,
}
CORPORA = {
    "ply": ply_bytes.corpus,
    "las": las_bytes.corpus,
    "laz": las_bytes.laz_corpus,
    "pcd": pcd_bytes.corpus,
    "txt": lambda: {name: text.encode() for name, text in TEXTS.items()},
}


def damaged(data, rng):
    """What is done to PLY is done to all; in binary headers a number may become an extreme one besides."""
    if rng.random() < 0.5:
        return ply_bytes.damaged(data, rng)
    data = bytearray(data)
    for _ in range(rng.randint(1, 3)):
        code = rng.choice("BHIQd")
        extremes = [0, 1, 255, 2**15, 2**16 - 1, 2**31 - 1, 2**32 - 1, 2**40, 2**63, 2**64 - 1]
        number = rng.choice([float("nan"), float("inf"), 0.0, 1e300] if code == "d" else extremes)
        piece = struct.pack("<d", number) if code == "d" else struct.pack("<Q", number)[: struct.calcsize(code)]
        # Most often where the header is, or the chunk table of a LAZ file.
        place = rng.choice([rng.randrange(400), rng.randrange(1, 100) + len(data) - 100, rng.randrange(len(data))])
        data[max(place, 0) : max(place, 0) + len(piece)] = piece
    return bytes(data)


def worker(form, count, seed, folder):
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    from pcbench.errors import PcbenchError
    from pcbench.io import read_cloud

    warnings.simplefilter("error")
    rng = random.Random(seed)
    files = list(CORPORA[form]().items())
    path = folder / f"a.{form}"
    outcomes = collections.Counter()

    def check(number, name, message):
        if not message.startswith(f"{path}: ") or not message.isprintable() or len(message) > len(str(path)) + 400:
            raise SystemExit(f"{number} ({name}): not one clear line: {message!r}")
        if "memory" in message:
            raise SystemExit(f"{number} ({name}): an allocation of the size that the damage asks for")

    for number in range(count):
        name, data = rng.choice(files)
        path.write_bytes(damaged(data, rng))  # stays behind for a look if anything below fails
        notes = []
        signal.alarm(SECONDS_PER_FILE)
        try:
            cloud = read_cloud(path, on_warning=notes.append)
        except PcbenchError as error:
            check(number, name, str(error))
            outcomes["refused"] += 1
        else:
            if not len(cloud):
                raise SystemExit(f"{number} ({name}): a cloud without points")
            outcomes["read"] += 1
        signal.alarm(0)
        for note in notes:
            check(number, name, note)
    print(dict(outcomes))
    if min(outcomes["refused"], outcomes["read"]) < count // 50:
        raise SystemExit("the damage is too strong or too weak to tell anything")


def run(form, count, seed, folder):
    if form == "laz":
        pytest.importorskip("lazrs")
    command = [sys.executable, __file__, form, str(count), str(seed), str(folder)]
    done = subprocess.run(
        command, env={**os.environ, "PYTHONPATH": str(TESTS)}, capture_output=True, text=True, timeout=60 + count / 5
    )
    assert done.returncode == 0, f"exit {done.returncode}, file {folder}/a.{form}:\n{done.stdout}{done.stderr}"


# Each LAZ file whose header holds is unpacked by a process of its own, which takes some 15 ms.
@pytest.mark.parametrize(("form", "count"), [("ply", 1000), ("las", 500), ("laz", 500), ("pcd", 500), ("txt", 500)])
def test_some_damaged_files(tmp_path, form, count):
    run(form, count, 1, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("form", "count"), [("ply", 20_000), ("las", 20_000), ("laz", 5000), ("pcd", 20_000), ("txt", 20_000)]
)
def test_many_damaged_files(tmp_path, form, count):
    run(form, count, 2, tmp_path)


if __name__ == "__main__":
    worker(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), Path(sys.argv[4]))
