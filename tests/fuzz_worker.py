"""Read thousands of damaged files: each gives a cloud, a mesh or a one-line PcbenchError, in bounded memory and time.

`fuzz_worker.run` starts this file as a script in a separate process, so that memory and time are limited by the
system and a crash is detected: `fuzz_worker.py CORPORA COUNT SEED FOLDER`, with commas between names of corpora.
"""

import collections
import gzip
import os
import random
import resource
import signal
import struct
import subprocess
import sys
import warnings
from pathlib import Path

import e57_bytes
import height_grid_files
import las_bytes
import mesh_bytes
import mvs_bytes
import pcd_bytes
import ply_bytes
import ptx_bytes
import splat_bytes
from repository import TESTS

MAX_MEMORY = 2 << 30  # bytes of address space; numpy and its threads take about a fifth of it
MAX_SECONDS_PER_FILE = 5  # of the processor
TEXTS = {
    "plain": "0 1 2\n3.5 -4e3 5\n" * 9,
    "header": "x,y,z,red,green,blue,id\n" + "1.5,2.5,3.5,255,0,9,7\n" * 9,
    "remarks": "# crs EPSG:32617\n//X Y Z R G B\n3\n1 2 3 4 5 6\n# half\n1 2 3 4 5 6\n\n1 2 3 4 5 7 # end\n",
    "semicolons": "x;y;z;nx;ny;nz\r\n" + "1.25; 2; nan; 0; 0; 1\r\n1;2;3;0;1;0\r\n" * 5,
    "tabs": "1\t2\t3\t0.5\n" * 9,
}
# Files of each corpus as name -> bytes. The extension is the name of the corpus; meshes have that of their name.
CORPORA = {
    "ply": lambda: ply_bytes.corpus() | splat_bytes.packed_ply_corpus(),
    "las": las_bytes.corpus,
    "laz": las_bytes.laz_corpus,
    "pcd": pcd_bytes.corpus,
    "txt": lambda: {name: text.encode() for name, text in TEXTS.items()},
    "meshes": lambda: mesh_bytes.CUBES | {"grid.asc": height_grid_files.asc().encode()},
    "e57": e57_bytes.corpus,
    "mvs": mvs_bytes.corpus,
    "ptx": ptx_bytes.corpus,
    "bin": lambda: {"kitti": struct.pack("<40f", *range(40))},
    "splat": splat_bytes.splat_corpus,
    "spz": splat_bytes.spz_corpus,
    "ksplat": splat_bytes.ksplat_corpus,
    "tif": height_grid_files.tif_corpus,
    "glb": lambda: {
        "points": mesh_bytes.glb_parts((0, mesh_bytes.VERTICES, None), (0, mesh_bytes.VERTICES, [1, 0, 5]))
    },
}


def run(corpora, count, seed, folder):
    """Check files of each corpus in one process, whose imports take longer than a hundred files."""
    command = [sys.executable, __file__, ",".join(corpora), str(count), str(seed), str(folder)]
    process = subprocess.run(
        command,
        env={**os.environ, "PYTHONPATH": str(TESTS)},
        capture_output=True,
        text=True,
        timeout=60 + len(corpora) * count / 5,
    )
    assert process.returncode == 0, (
        f"exit {process.returncode}, last file in {folder}:\n{process.stdout}{process.stderr}"
    )


def damage(data, rng):
    """Damage a file as for PLY; in binary headers also replace a number with an extreme one."""
    if rng.random() < 0.5:
        return ply_bytes.damage(data, rng)
    data = bytearray(data)
    for _ in range(rng.randint(1, 3)):
        code = rng.choice("BHIQd")
        extremes = [0, 1, 255, 2**15, 2**16 - 1, 2**31 - 1, 2**32 - 1, 2**40, 2**63, 2**64 - 1]
        number = rng.choice([float("nan"), float("inf"), 0.0, 1e300] if code == "d" else extremes)
        number_bytes = struct.pack("<d", number) if code == "d" else struct.pack("<Q", number)[: struct.calcsize(code)]
        # Two thirds of the offsets are in the header or near the end, where LAZ has its chunk table.
        offset = rng.choice([rng.randrange(400), rng.randrange(1, 100) + len(data) - 100, rng.randrange(len(data))])
        data[max(offset, 0) : max(offset, 0) + len(number_bytes)] = number_bytes
    return bytes(data)


def damage_packed(data, rng):
    """Damage a gzip file; most often what is packed in it, since its checksum reveals other damage at once."""
    if rng.random() < 0.8:
        return gzip.compress(damage(gzip.decompress(data), rng), mtime=0)
    return damage(data, rng)


def main(corpus, count, seed, folder):
    """Check damaged files of a corpus."""
    from pcbench.errors import PcbenchError
    from pcbench.io import read_cloud
    from pcbench.io.meshes import read_mesh
    from pcbench.io.openmvs import read_openmvs

    def read_scene_file(path, on_warning):
        return read_openmvs(path, lambda name: (64, 48), on_warning).cameras

    read = {"meshes": read_mesh, "mvs": read_scene_file}.get(corpus, read_cloud)
    warnings.simplefilter("error")
    rng = random.Random(seed)
    files = list(CORPORA[corpus]().items())
    outcomes = collections.Counter()

    def check(message):
        if not message.startswith(f"{path}: ") or not message.isprintable() or len(message) > len(str(path)) + 400:
            raise SystemExit(f"{corpus} {number} ({name}): not one clear line: {message!r}")
        if "memory" in message:
            raise SystemExit(f"{corpus} {number} ({name}): an allocation of the size that the damage asks for")

    for number in range(count):
        name, data = rng.choice(files)
        path = folder / f"a{Path(name).suffix if corpus == 'meshes' else f'.{corpus}'}"
        data = damage_packed(data, rng) if corpus == "spz" else damage(data, rng)
        # Most files get new checksums, since E57 checksums reveal damage at once.
        if corpus == "glb":
            data = data[:8] + struct.pack("<I", len(data)) + data[12:]  # its length is checked first
        path.write_bytes(e57_bytes.add_checksums(data) if corpus == "e57" and rng.random() < 0.8 else data)  # kept
        notes = []
        signal.setitimer(signal.ITIMER_PROF, MAX_SECONDS_PER_FILE)
        try:
            result = read(path, on_warning=notes.append)
        except PcbenchError as error:
            check(str(error))
            outcomes["refused"] += 1
        else:
            if not len(result):
                raise SystemExit(f"{corpus} {number} ({name}): nothing in it")
            outcomes["read"] += 1
        signal.setitimer(signal.ITIMER_PROF, 0)
        for note in notes:
            check(note)
    print(corpus, dict(outcomes), flush=True)
    if min(outcomes["refused"], outcomes["read"]) < count // 50:
        raise SystemExit(f"{corpus}: the damage is too strong or too weak to tell anything")


if __name__ == "__main__":
    resource.setrlimit(resource.RLIMIT_AS, (MAX_MEMORY, MAX_MEMORY))
    for name_of_corpus in sys.argv[1].split(","):
        main(name_of_corpus, int(sys.argv[2]), int(sys.argv[3]), Path(sys.argv[4]))
