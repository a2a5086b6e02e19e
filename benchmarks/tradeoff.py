"""Cost of cheaper comparisons of a pair, and the errors that they make: python benchmarks/tradeoff.py demo

Runs `pcbench tradeoff` on one of three pairs: `demo`, the reference of 50,000 points and the densified candidate of
`pcbench demo`; `autzen` and `forest`, random halves of an airborne scan of the folder PCBENCH_DATA. Prints what the
command prints. `--chart FOLDER` keeps two of its pictures as tradeoff_PAIR_errors.png and tradeoff_PAIR_bias.png.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from measure import setting
from PIL import Image
from real_data import data_root

from pcbench import read_cloud, write_cloud

SCANS = {"autzen": "autzen/autzen_trim.las", "forest": "wild/MixedConifer.laz"}
CHARTS = "errors", "bias"


def pcbench(*words: str | Path, is_printed: bool = False) -> None:
    """Run a command of pcbench."""
    output = None if is_printed else subprocess.DEVNULL
    subprocess.run([sys.executable, "-m", "pcbench", *words], check=True, stdout=output)


def make_pair(name: str, folder: Path) -> tuple[Path, Path]:
    """Write the clouds of a pair and return their paths, the reference first."""
    if name not in SCANS:
        pcbench("demo", "--points", "50000", "--no-bench", "--no-figures", "--quiet", "--out", folder)
        return folder / "clouds" / "reference.ply", folder / "clouds" / "densified.ply"
    if (data := data_root()) is None:
        sys.exit(f"missing: the folder PCBENCH_DATA with {SCANS[name]}")
    cloud = read_cloud(data / SCANS[name])
    rows = np.random.default_rng(0).permutation(len(cloud))
    halves = folder / f"{name}_a.ply", folder / f"{name}_b.ply"
    for path, its_rows in zip(halves, np.array_split(rows, 2), strict=True):
        write_cloud(path, cloud.select(np.sort(its_rows)))
    return halves


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pair", choices=("demo", *SCANS))
    parser.add_argument("--levels", default="50%,25%,10%")
    parser.add_argument("--seeds", default="3")
    parser.add_argument("--chart", type=Path, metavar="FOLDER")
    options = parser.parse_args()
    print(f"{setting()}\n", flush=True)
    with tempfile.TemporaryDirectory() as temporary:
        study = Path(temporary) / "study"
        how = ["--levels", options.levels, "--seeds", options.seeds, "--out", study]
        pcbench("tradeoff", *make_pair(options.pair, Path(temporary)), *how, is_printed=True)
        for chart in CHARTS if options.chart else ():
            picture = Image.open(study / "figures" / f"{chart}.png").convert("RGB").quantize(256)
            picture.save(options.chart / f"tradeoff_{options.pair}_{chart}.png", optimize=True)


if __name__ == "__main__":
    main()
