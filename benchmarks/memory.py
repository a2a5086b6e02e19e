"""Peak memory of `pcbench compare` in memory, next to the estimate with which `--memory` chooses tiles.

    python benchmarks/memory.py [--largest 3e6]

Each case runs in a separate process without --out. Clouds are samples of a synthetic city, in .npy files, and in PLY
files with attributes. `_BASE_BYTES` and the other constants of `pcbench/comparison/plan.py` are fitted to these peaks.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from measure import setting

from pcbench import Cloud, Settings, TilingSettings, write_cloud
from pcbench.comparison.plan import CloudsOnDisk
from pcbench.comparison.request import Request
from pcbench.scenes.synthetic import city


class Case(NamedTuple):
    """Numbers of points of the reference and of the candidates, and the number of attributes of each point."""

    counts: tuple[int, ...]
    attributes: int = 0


CASES = (
    Case((10_000, 10_000)),
    Case((30_000, 30_000)),
    Case((100_000, 100_000)),
    Case((300_000, 300_000)),
    Case((1_000_000, 1_000_000)),
    Case((1_000_000, 190_000)),
    Case((190_000, 1_000_000)),
    Case((1_000_000, 1_000_000, 1_000_000, 1_000_000)),
    Case((1_000_000, 1_000_000), attributes=6),
    Case((3_000_000, 3_000_000)),
    Case((10_000_000, 1_900_000, 100_000)),
)


def write_clouds(case: Case, folder: Path) -> list[Path]:
    """Write samples of a city and return their files, the reference first."""
    paths = []
    for number, count in enumerate(case.counts):
        points = city(3).sample(count, np.random.default_rng(number))[0]
        path = folder / f"{number}.{'ply' if case.attributes else 'npy'}"
        if case.attributes:
            write_cloud(
                path, Cloud(points, attributes={f"a{i}": np.arange(count) % 7.0 for i in range(case.attributes)})
            )
        else:
            np.save(path, points)
        paths.append(path)
    return paths


def peak_of(paths: Sequence[Path]) -> int:
    """Return the peak memory in bytes of a comparison in a separate process."""
    command = [Path(sys.executable).with_name("pcbench"), "compare", *map(str, paths)]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    _, status, usage = os.wait4(process.pid, 0)
    if status:
        raise SystemExit("the comparison failed")
    return usage.ru_maxrss * 1024


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--largest", type=float, default=3e6, help="leave out cases with more points")
    options = parser.parse_args()
    print(setting())
    print(f"{'points':50}{'attributes':>12}{'peak, MB':>12}{'estimate':>12}{'ratio':>8}")
    for case in CASES:
        if max(case.counts) > options.largest:
            continue
        with tempfile.TemporaryDirectory() as folder:
            paths = write_clouds(case, Path(folder))
            tiling = TilingSettings()
            estimate = CloudsOnDisk.open(Request.of(paths[0], paths[1:], Settings()), tiling).memory
            peak = peak_of(paths)
        names = ", ".join(f"{count:,}" for count in case.counts)
        print(
            f"{names:50}{case.attributes:12}{peak / 1e6:12.0f}{estimate / 1e6:12.0f}{estimate / peak:8.2f}", flush=True
        )


if __name__ == "__main__":
    main()
