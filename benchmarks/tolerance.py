"""Comparisons with `--tolerance`: coverage of the intervals of D2, and gain of time.

    python benchmarks/tolerance.py [--runs 1000]
    python benchmarks/tolerance.py --gain [--sizes 2e6,1e7] [--runs 3]

The first command samples the distances to tangent planes of each scene with many seeds. It prints in how many runs the
interval contains the exact mean square, and in how many the estimate is within the tolerance. Of the folder
PCBENCH_DATA, the scenes are two vehicle scans in their true pose, and random halves of other clouds. The second command
compares clouds of `clouds.py`, the candidate with a fifth of the points, with and without a tolerance.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path

import clouds
import numpy as np
from measure import alternate, setting
from real_data import data_note, data_root

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from plane_samples import coverage, directions

from pcbench import compare, read_cloud

TOLERANCES = (0.01, 0.05)
HALVED = {
    "airborne scan": "autzen/autzen_trim.las",
    "terrain": "wild/Topography.laz",
    "memorial": "copc/lone-star.copc.laz",
}


def scenes(count: int) -> Iterator[tuple[str, clouds.Points, clouds.Points]]:
    """Yield name, reference and candidate of each scene."""
    for density in clouds.DENSITIES:
        yield density, *clouds.pair(density, count)
    root = data_root()
    if root is None:
        return
    for name, path in HALVED.items():
        points = read_cloud(root / path).points
        order = np.random.default_rng(0).permutation(len(points))
        yield name, *(points[np.sort(rows)] for rows in np.array_split(order, 2))
    target, source = (read_cloud(root / f"small_gicp/{name}.ply").points for name in ("target", "source"))
    motion = np.loadtxt(root / "small_gicp/T_target_source.txt")
    yield "vehicle scans", target, source @ motion[:3, :3].T + motion[:3, 3]


def print_coverage(runs: int, count: int) -> None:
    print(setting() + data_note())
    print(f"{'scene':20}{'tolerance':>10}{'direction':>10}{'points':>11}{'sample':>10}{'sampled':>9}", end="")
    print(f"{'covered':>9}{'within':>9}")
    for name, reference, candidate in scenes(count):
        for way, direction in directions(reference, candidate).items():
            for tolerance in TOLERANCES:
                found = coverage(direction, tolerance, range(runs))
                row = f"{name:20}{tolerance:10.0%}{way:>10}{len(direction.to_points):11,}"
                if found.sampled == 0:
                    print(f"{row}{'all':>10}", flush=True)
                    continue
                shares = "".join(f"{count / found.sampled:9.1%}" for count in (found.covered, found.within))
                print(f"{row}{found.points:10,.0f}{found.sampled / runs:9.0%}{shares}", flush=True)


def print_gain(runs: int, sizes: list[int]) -> None:
    print(setting())
    print(
        f"{'scene':15}{'points':>12}" + "".join(f"{name:>14}" for name in ("exact", *map("{:.0%}".format, TOLERANCES)))
    )
    print(f"{'seconds':27}" + f"{'wall':>7}{'CPU':>7}" * (1 + len(TOLERANCES)))
    for size in sizes:
        for density in ("uniform city", "scan lines"):
            reference, candidate = clouds.pair(density, size)
            contestants = {
                str(tolerance): lambda t=tolerance: compare(reference, candidate, tolerance=t)  # noqa: B023
                for tolerance in (None, *TOLERANCES)
            }
            found = alternate(contestants, runs)
            print(f"{density:15}{size:12,}" + "".join(f"{s.wall:7.2f}{s.cpu:7.2f}" for s in found.values()), flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int)
    parser.add_argument("--points", type=int, default=1_000_000, help="points of the synthetic references")
    parser.add_argument("--gain", action="store_true")
    parser.add_argument("--sizes", default="2e6,1e7")
    options = parser.parse_args()
    if options.gain:
        print_gain(options.runs or 3, [int(float(size)) for size in options.sizes.split(",")])
    else:
        print_coverage(options.runs or 1_000, options.points)


if __name__ == "__main__":
    main()
