"""Coverage of 95 % intervals: python benchmarks/intervals.py [--runs 200] [--points 4000]

Each run samples both clouds and the candidate's noise again; the expectation is the mean over the runs. A cell has the
share of runs whose interval contains the expectation, and the width of the intervals over the range of 95 % of the
scores. The last lines have the least and the largest of both for each noise.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from measure import limit_threads, setting

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from coverage_cases import NOISES, SCORES, Case, Coverage, coverage

from pcbench.measure.results import ARROWS

SURFACES = ("plane", "torus", "boxes", "city")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--points", type=int, nargs=2, default=(4_000, 4_000), metavar=("REFERENCE", "CANDIDATE"))
    parser.add_argument("--surfaces", nargs="*", default=SURFACES)
    parser.add_argument("--noises", nargs="*", default=NOISES)
    options = parser.parse_args()
    limit_threads(1)
    print(setting())
    print(f"{'surface':9}{'noise':10}" + "".join(f"{f'{name} {ARROWS[direction]}':>20}" for name, direction in SCORES))
    found: dict[str, list[Coverage]] = {}
    for name in options.surfaces:
        for noise in options.noises:
            result = coverage(Case(name, noise, *options.points), options.runs)
            found.setdefault(noise, []).append(result)
            pairs = zip(result.shares, result.widths, strict=True)
            print(
                f"{name:9}{noise:10}" + "".join(f"{share:13.3f} ({width:4.2f})" for share, width in pairs), flush=True
            )
    print(f"\n{'all surfaces and scores':26}{'coverage':>16}{'width':>16}")
    for noise, results in found.items():
        shares = [share for result in results for share in result.shares]
        widths = [width for result in results for width in result.widths if width > 0]  # 0: the score did not vary
        print(
            f"{noise:26}{f'{min(shares):.3f} to {max(shares):.3f}':>16}{f'{min(widths):.1f} to {max(widths):.1f}':>16}"
        )


if __name__ == "__main__":
    main()
