"""Comparisons in tiles: cost against memory and peers, scaling with points and workers, memory of all processes.

`python benchmarks/tiles.py` prints the tables of docs/measured/tiles.md. Clouds are tiles of LAZ, see large_clouds.py;
sizes are points of the reference, and the candidate has as many. Peers that are not installed are named.
"""

from __future__ import annotations

import argparse
import importlib.util
import math
import shutil
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from large_clouds import DENSITY, ORIGIN, write_clouds
from measure import setting
from process_tree import CommandFailed, Usage, measure

_M3C2_RADIUS = 2.0 / math.sqrt(DENSITY)  # holds about 12 points, for normals and cylinders alike
_M3C2 = f"""
import os, sys, numpy
os.chdir(os.path.dirname(sys.argv[1]))  # py4dgeo writes a log there
import py4dgeo
from pcbench import read_cloud
reference, candidate = (read_cloud(path).points for path in sys.argv[1:])
origin = reference.mean(axis=0)
epochs = [py4dgeo.Epoch(points - origin) for points in (reference, candidate)]
py4dgeo.set_num_threads(1)
m3c2 = py4dgeo.M3C2(epochs=tuple(epochs), corepoints=epochs[0].cloud, cyl_radius={_M3C2_RADIUS}, max_distance=5.0,
                    normal_radii=[{_M3C2_RADIUS}])
distances, _ = m3c2.run()
print(numpy.nanmedian(numpy.abs(distances)))
"""


class Row(NamedTuple):
    """Time and memory that one command needed for a reference and a candidate of this size each."""

    what: str
    size: int
    usage: Usage

    @property
    def line(self) -> str:
        """Line of the table."""
        usage, points = self.usage, 2 * self.size
        return (
            f"{self.what:36}{self.size:13,}{usage.wall:9.1f}{usage.cpu:9.1f}{usage.cpu / points * 1e6:10.2f}"
            f"{points / usage.cpu / 1e3:13.0f}{usage.peak / 2**20:10.0f}{usage.peak_main / 2**20:8.0f}"
        )


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sizes", type=_sizes, default=[10**6, 10**7, 3 * 10**7])
    parser.add_argument("--most-in-memory", type=float, default=1e7, help="largest size that is compared in memory")
    parser.add_argument("--most-of-peers", type=float, default=1e7, help="largest size for the peers")
    parser.add_argument("--memory", default="1GiB", help="memory of the comparisons in tiles")
    parser.add_argument("--folder", type=Path, help="folder for the clouds, kept for the next run; default: temporary")
    arguments = parser.parse_args()
    print(f"{setting()}\none run each; pcbench and peers have one thread per process; LAZ is read in all times\n")
    print(
        f"{'':36}{'points':>13}{'wall s':>9}{'CPU s':>9}{'us/point':>10}{'kpts/s/core':>13}{'peak MiB':>10}{'main':>8}"
    )
    rows = list[Row]()
    with tempfile.TemporaryDirectory() as temporary:
        for size in arguments.sizes:
            folder = (arguments.folder or Path(temporary)) / f"{size}"
            if not folder.exists():
                write_clouds(folder, size)
            for what, command in _commands(folder, size, arguments):
                try:
                    row = Row(what, size, measure(command, {"OMP_NUM_THREADS": "1", "QT_QPA_PLATFORM": "offscreen"}))
                except CommandFailed as error:
                    print(f"{what:36}{size:13,}  failed: {error}", flush=True)
                else:
                    rows.append(row)
                    print(row.line, flush=True)
            if arguments.folder is None:
                shutil.rmtree(folder)
    print()
    _print_ratios(rows)
    for missing in _missing_peers():
        print(missing)


def _sizes(text: str) -> list[int]:
    return [int(float(size)) for size in text.split(",")]


def _commands(folder: Path, size: int, arguments: argparse.Namespace) -> Iterator[tuple[str, list[str]]]:
    """Yield the name and the command of each run with clouds of this size."""
    from pcbench.measure.tiled.settings import TilingSettings, parse_bytes

    clouds = [str(folder.absolute() / kind) for kind in ("reference", "candidate")]
    compare = [sys.executable, "-m", "pcbench.cli", "compare", *clouds, "--json", str(folder / "comparison.json")]
    memory = parse_bytes(arguments.memory)

    def tiled(how: str, workers: int) -> tuple[str, list[str]]:
        # Clouds that would fit into memory are computed in tiles only if a size is given.
        points = TilingSettings(memory=memory, workers=workers).chosen_tile_points
        options = f"--register {how} --tiles {points} --memory {arguments.memory} --workers {workers}"
        name = f"pcbench tiled, {how}, {workers} worker{'s' if workers > 1 else ''}"
        return name, [*compare, *options.split(), "--workspace", str(folder / "workspace")]

    if size <= arguments.most_in_memory:
        for how in ("none", "icp"):
            yield f"pcbench in memory, {how}", [*compare, "--register", how, "--memory", "1000GiB"]
        for how in ("none", "icp"):
            yield tiled(how, 1)
    yield tiled("none", 2)
    if size <= arguments.most_of_peers:
        if shutil.which("CloudCompare"):
            yield "CloudCompare C2C, both directions", _cloudcompare(folder)
        if importlib.util.find_spec("py4dgeo"):
            yield "py4dgeo M3C2, one direction", [sys.executable, "-c", _M3C2, *clouds]


def _cloudcompare(folder: Path) -> list[str]:
    """Return a command that reads the clouds as PLY, which Debian's CloudCompare reads, and measures both ways."""
    from pcbench import read_cloud, write_cloud
    from pcbench.geometry.cloud import Cloud

    for kind in ("reference", "candidate"):
        if not (folder / f"{kind}.ply").exists():
            points = read_cloud(folder / kind).points
            write_cloud(folder / f"{kind}.ply", Cloud(points - ORIGIN))
    reference, candidate = (["-O", str(folder / f"{kind}.ply")] for kind in ("reference", "candidate"))
    run = f"CloudCompare -SILENT -NO_TIMESTAMP -AUTO_SAVE OFF {{}} -C2C_DIST -MAX_TCOUNT 1 > {folder}/cloudcompare.txt"
    both = [run.format(" ".join(pair)) for pair in ([*candidate, *reference], [*reference, *candidate])]
    return ["sh", "-c", " && ".join(both)]


def _print_ratios(rows: list[Row]) -> None:
    """Print the overhead against memory, the speed-up by the second worker, ratios to peers, and exponents."""
    import numpy as np

    usage = {(row.what, row.size): row.usage for row in rows}

    def ratio(text: str, size: int, one: str, other: str, attribute: str) -> None:
        if (one, size) in usage and (other, size) in usage:
            quotient = getattr(usage[one, size], attribute) / getattr(usage[other, size], attribute)
            print(f"{text:52}{size:13,}{quotient:8.2f}")

    for size in sorted({row.size for row in rows}):
        for how in ("none", "icp"):
            tiled, memory = f"pcbench tiled, {how}, 1 worker", f"pcbench in memory, {how}"
            ratio(f"CPU seconds, tiled / in memory, {how}", size, tiled, memory, "cpu")
        one, two = (f"pcbench tiled, none, {workers}" for workers in ("1 worker", "2 workers"))
        ratio("wall seconds, 1 worker / 2 workers", size, one, two, "wall")
        ratio("CPU seconds, 2 workers / 1 worker", size, two, one, "cpu")
        for peer in ("CloudCompare C2C, both directions", "py4dgeo M3C2, one direction"):
            ratio(f"CPU seconds, {peer} / tiled", size, peer, one, "cpu")
    for what in dict.fromkeys(row.what for row in rows):
        of_what = [(row.size, row.usage.cpu) for row in rows if row.what == what]
        if len(of_what) > 1:
            slope = np.polyfit(*np.log(of_what).T, 1)[0]
            print(f"{what}: CPU seconds grow as points^{slope:.2f}, {of_what[0][0]:,} to {of_what[-1][0]:,} points")


def _missing_peers() -> Iterator[str]:
    if shutil.which("CloudCompare") is None:
        yield "CloudCompare is not measured: no command CloudCompare (Debian: cloudcompare)"
    if importlib.util.find_spec("py4dgeo") is None:
        yield "py4dgeo is not measured: pip install py4dgeo"


if __name__ == "__main__":
    main()
