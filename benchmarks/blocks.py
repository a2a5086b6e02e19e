"""Memory and accuracy of reconstructions in blocks, against those at once: python benchmarks/blocks.py

The area of the synthetic city grows with the number of images. Each is reconstructed with each `--memory` in gigabytes,
of which the first should be enough for a single block. `peak` is that of the process tree. Clouds are compared with the
exact surface, at two pixel footprints, and with the cloud of the first `--memory`: `moved` is the mean distance from
there, and `same` the share of points with equal coordinates.

`--folder` keeps cities and workspaces, so that depth maps are computed once.
"""

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from measure import setting

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from dense_cases import read_city, score_cloud

from pcbench.geometry.neighbors import Index
from pcbench.io import read_cloud

PAGE_BYTES = 4096
AREA_PER_IMAGE = 833.0  # square metres of the city
SETTINGS = {"mvs": [], "splat": ["density=fixed", "steps=200", "image_side=480"]}
GAUSSIANS_PER_IMAGE = 1250


def resident_mib(pid: int) -> float:
    """Return the resident memory of a process and its descendants, in MiB."""
    folder = Path(f"/proc/{pid}")
    try:
        pages = int((folder / "statm").read_text().split()[1])
        children = [int(child) for path in folder.glob("task/*/children") for child in path.read_text().split()]
    except (OSError, IndexError):  # it has ended
        return 0.0
    return pages * PAGE_BYTES / 2**20 + sum(map(resident_mib, children))


def reconstruct(plugin: str, city: Path, out: Path, workspace: Path, settings: list[str]) -> float:
    """Run a reconstructor; return the peak of the resident memory of its process tree, in MiB."""
    options = [part for text in settings for part in ("--set", text)]
    command = [sys.executable, "-m", "pcbench.cli", "reconstruct", plugin, city, "--out", out, "--workspace", workspace]
    process, peak = subprocess.Popen([*command, "--quiet", *options]), 0.0
    while process.poll() is None:
        peak = max(peak, resident_mib(process.pid))
        time.sleep(0.02)
    if process.returncode:
        raise SystemExit(process.returncode)
    return peak


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--plugin", choices=SETTINGS, default="mvs")
    parser.add_argument("--images", default="12,24,48")
    parser.add_argument("--size", default="480x320")
    parser.add_argument("--memory", default="4,0.1")
    parser.add_argument("--seed", type=int, default=5)
    parser.add_argument("--folder", type=Path)
    options = parser.parse_args()
    print(f"{setting()}; city {options.seed}, images of {options.size}")
    print(
        f"{'images':>6}{'memory':>8}{'peak MiB':>10}{'points':>11}{'precision':>11}{'recall':>8}{'F-score':>9}", end=""
    )
    print(f"{'moved m':>9}{'same':>7}")
    with tempfile.TemporaryDirectory() as temporary:
        root = options.folder or Path(temporary)
        for count in map(int, options.images.split(",")):
            folder = root / f"city{count}"
            if not folder.is_dir():
                extent = round((AREA_PER_IMAGE * count) ** 0.5)
                command = [sys.executable, "-m", "pcbench.cli", "synth", "city", "--out", folder, "--rig", "drone"]
                command += ["--images", str(count), "--size", options.size, "--extent", str(extent), "--quiet"]
                subprocess.run([*command, "--seed", str(options.seed), "--points", "200000"], check=True)
            city, first = read_city(folder), None
            for memory in options.memory.split(","):
                out = root / f"{options.plugin}{count}-{memory}.ply"
                settings = [*SETTINGS[options.plugin], f"memory={memory}"]
                if options.plugin == "splat":
                    settings.append(f"gaussians={GAUSSIANS_PER_IMAGE * count}")
                peak = reconstruct(options.plugin, folder, out, root / f"{options.plugin}{count}", settings)
                points = read_cloud(out).points
                score = score_cloud(city, points)
                first = points if first is None else first
                moved = Index(first).query(points).distances
                print(f"{count:6}{memory:>8}{peak:10.0f}{len(points):11,}{score.precision[1]:11.4f}", end="")
                print(
                    f"{score.recall[1]:8.4f}{score.fscore[1]:9.4f}{moved.mean():9.4f}{np.mean(moved == 0):7.3f}",
                    flush=True,
                )


if __name__ == "__main__":
    main()
