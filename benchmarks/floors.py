"""Scores of independent, error-free samples over their sampling floors: python benchmarks/floors.py [--runs 60]

Each row is a surface, the numbers of points of reference and candidate, and the ratio of the candidate's densities at
both ends of the scene. The mean score over runs is divided by the mean floor; 1 is correct. The last lines have the
least and the largest ratio, without the rows of 50 points, and D2 without the plane, where it is 0. `--noise`
displaces the candidate along the normals, in units of its mean spacing: the score grows, and the floor (in brackets:
relative to the floor without noise) should not.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
from measure import limit_threads, setting

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from floor_cases import METRICS, Case, mean_floors

SIZES = (
    (50, 50, 1),
    (200, 200, 1),
    (1_000, 1_000, 1),
    (5_000, 5_000, 1),
    (8_000, 2_000, 1),
    (8_000, 500, 1),
    (2_000, 8_000, 1),
    (500, 8_000, 1),
    (4_000, 4_000, 16),
)
CASES = [Case(name, *size) for name in ("plane", "torus", "sphere", "cylinder", "boxes", "city") for size in SIZES]
MAX_FEW_POINTS = 50  # of clouds that are not in the ranges
NOISES = (0.0, 0.25, 0.5, 1.0, 2.0)
NOISY_CASES = [Case(name, 5_000, 5_000, 1, noise) for name in ("plane", "torus", "boxes") for noise in NOISES]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=60)
    parser.add_argument("--noise", action="store_true")
    options = parser.parse_args()
    limit_threads(1)
    print(setting())
    columns = "".join(f"{arrow + ' ' + name:>18}" for arrow in ("c→r", "r→c") for name in METRICS)
    print(f"{'surface':9}{'reference':>10}{'candidate':>10}{'falling':>8}{'noise':>6}{columns}")
    noise_free_floors = np.ones((2, len(METRICS)))
    ratios: dict[Case, np.ndarray] = {}
    for case in NOISY_CASES if options.noise else CASES:
        result = mean_floors(case, options.runs)
        ratios[case] = result.ratios
        if case.noise == 0:
            noise_free_floors = np.maximum(result.floors, 1e-30)
        floor_ratios = result.floors / noise_free_floors
        cells = "".join(
            f"{ratio:11.3f} ({floor_ratio:4.2f})" if options.noise else f"{ratio:18.3f}"
            for ratio, floor_ratio in zip(result.ratios.ravel(), floor_ratios.ravel(), strict=True)
        )
        name, reference, candidate, falling, noise = case
        print(f"{name:9}{reference:10,}{candidate:10,}{falling:8g}{noise:6g}{cells}", flush=True)
    if not options.noise:
        print_ranges(ratios)


def print_ranges(ratios: dict[Case, np.ndarray]) -> None:
    """Print the least and the largest ratio of each metric, and the number of rows with them."""
    print(f"\n{'score over floor':20}{'rows':>6}{'c→r':>18}{'r→c':>18}")
    for place, metric in enumerate(METRICS):
        rows = [
            values[:, place]
            for case, values in ratios.items()
            if case.reference > MAX_FEW_POINTS and not (metric == "d2_mse" and case.surface == "plane")
        ]
        ends = zip(np.min(rows, axis=0), np.max(rows, axis=0), strict=True)
        ranges = "".join(f"{f'{least:.2f} to {most:.2f}':>18}" for least, most in ends)
        print(f"{metric:20}{len(rows):6}{ranges}")


if __name__ == "__main__":
    main()
