"""The deformation verdict for known deformations: python benchmarks/deformation.py [--runs 20] [--only TEXT]

Each pair is evaluated completely, registration included; see `tests/deformation_cases.py` for the scenes and their
noise. Real clouds are left out if the data folder is absent. `--domes` measures how small a dome is detected, `--times`
measures the time for complete clouds.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from measure import limit_threads, setting
from real_data import data_note

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

import pytest
from deformation_cases import BENDS, NULLS, PARTS, Pair, bent_city, true_rms, turned_city

from pcbench.deformation import Deformation, deform

VERDICTS = ("none", "undecided", "similarity", "affine", "non-affine")
DOME_SIZES = (0.1, 0.2, 0.35, 0.5, 1.0)  # RMS in units of a point's noise
LENGTH_RATIOS = (100, 50, 25)
TABLE_HEAD = f"{'':26}{'runs':>5}" + "".join(f"{verdict:>12}" for verdict in VERDICTS)


def evaluate(make: Callable[[int], Pair], seed: int, method: str = "icp") -> Deformation:
    """Return the verdict on one pair."""
    pair = make(seed)
    return deform(pair.reference, pair.candidate, method)[1]


def table_row(name: str, results: list[Deformation]) -> str:
    """Return a table row with the counts of the verdicts."""
    verdicts = [result.verdict for result in results]
    return f"{name:26}{len(results):5}" + "".join(f"{verdicts.count(verdict):12}" for verdict in VERDICTS)


def print_nulls(runs: int, name_part: str, first_seed: int) -> None:
    """Print the verdicts on undeformed pairs."""
    print(f"\nundeformed\n{TABLE_HEAD}{'smallest p':>12}{'moved':>7}{'changed tiles':>15}")
    for name, make in NULLS.items():
        if name_part not in name:
            continue
        try:
            results = [evaluate(make, seed) for seed in range(first_seed, first_seed + runs)]
        except pytest.skip.Exception:
            continue
        smallest = min((result.p_value for result in results if result.p_value is not None), default=1.0)
        moved_count = sum("a part moved" in result.sentence() for result in results)
        local = [result.local for result in results if result.local is not None]
        tiles = sum(changes.tiles_changed for changes in local), sum(changes.tiles_tested for changes in local)
        changed = f"{tiles[0] / max(tiles[1], 1):15.2%}"
        print(f"{table_row(name, results)}{smallest:12.1e}{moved_count:7}{changed}", flush=True)


def print_bends(runs: int, name_part: str, first_seed: int) -> None:
    """Print the verdicts on deformed pairs, with the sizes of the deformations."""
    print("\ndeformed; ratio of measured to true deformation, and coverage of its interval: along the normals of the")
    print(f"pairs, and over the surface\n{TABLE_HEAD}{'pairs':>8}{'':>6}{'surface':>9}{'':>6}")
    for name, make in BENDS.items():
        if name_part not in name:
            continue
        try:
            rows = [(evaluate(make, seed), true_rms(make(seed))) for seed in range(first_seed, first_seed + runs)]
        except pytest.skip.Exception:
            continue
        sizes = [(result.amplitude, truth) for result, truth in rows if result.amplitude is not None]
        ratios = [np.mean([a.rms / t[0] for a, t in sizes]), np.mean([(a.rms_surface or 0) / t[1] for a, t in sizes])]
        coverage = [
            np.mean([a.ci[0] <= t[0] <= a.ci[1] for a, t in sizes]),
            np.mean([a.ci_surface is not None and a.ci_surface[0] <= t[1] <= a.ci_surface[1] for a, t in sizes]),
        ]
        numbers = f"{ratios[0]:8.2f}{coverage[0]:6.0%}{ratios[1]:9.2f}{coverage[1]:6.0%}"
        print(f"{table_row(name, [result for result, _ in rows])}{numbers}", flush=True)


def print_parts(runs: int, name_part: str, first_seed: int) -> None:
    """Print the verdicts on pairs with moved parts, and on unregistered pairs."""
    print(f"\nparts that moved, and clouds that are not registered\n{TABLE_HEAD}  warnings")
    for name, make in {**PARTS, "turned by 3 degrees, not registered": turned_city(3.0)}.items():
        if name_part not in name:
            continue
        method = "none" if name.startswith("turned") else "icp"
        results = [evaluate(make, seed, method) for seed in range(first_seed, first_seed + runs)]
        codes = [notice.code for result in results for notice in result.warnings]
        counts = {code: codes.count(code) for code in sorted(set(codes))}
        counts["a part moved"] = sum("a part moved" in result.sentence() for result in results)
        print(
            f"{table_row(name, results)}  {', '.join(f'{label} {count}' for label, count in counts.items() if count)}",
            flush=True,
        )


def print_domes(runs: int, first_seed: int) -> None:
    """Print the shares of domes that are detected."""
    print("\nshare of detected domes in a city, by RMS in units of a point's noise")
    print(f"{'noise':8}{'runs':>5}" + "".join(f"{dome_size:8.2f}" for dome_size in DOME_SIZES))
    for ratio in LENGTH_RATIOS:
        shares = []
        for dome_size in DOME_SIZES:
            results = [
                evaluate(bent_city("dome", dome_size, ratio), seed) for seed in range(first_seed, first_seed + runs)
            ]
            shares.append(np.mean([result.verdict == "non-affine" for result in results]))
        print(f"L/{ratio:<6}{runs:5}" + "".join(f"{share:8.2f}" for share in shares), flush=True)


def print_times(sizes: list[int]) -> None:
    """Print seconds for two complete clouds with known registration, indices and normals, as in `compare`."""
    from pcbench.deformation import Side, residual_deformation
    from pcbench.geometry.neighbors import Index
    from pcbench.geometry.normals import Surface
    from pcbench.registration import Target, local_origin, register
    from pcbench.scenes.synthetic import demo

    print(f"\n{'reference':>10}{'candidate':>11}{'seconds':>9}  verdict")
    for size in sizes:
        scene = demo(size)
        origin = local_origin(scene.reference)
        surface = Surface(Index(scene.reference.points - origin))
        surface.normals(np.arange(len(surface)))
        reference_side = Side(surface, np.ones(len(surface), bool), scene.reference)
        for cloud in scene.candidates.values():
            registration = register(scene.reference, cloud, target=Target(surface))
            index = Index(registration.T_local.apply(cloud.points - origin))
            seconds = []
            for _ in range(5):
                start = time.perf_counter()
                candidate_side = Side(Surface(index), np.ones(len(index), bool), cloud)
                result = residual_deformation(reference_side, candidate_side, registration, origin)
                seconds.append(time.perf_counter() - start)
            print(f"{size:10,}{len(cloud):11,}{np.median(seconds):9.2f}  {result.verdict}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=20, help="runs per row")
    parser.add_argument("--only", default="", metavar="TEXT", help="rows whose name contains TEXT")
    parser.add_argument("--first", type=int, default=0, metavar="SEED", help="seed of the first run")
    parser.add_argument("--domes", action="store_true", help="only measure how small a dome is detected")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--times", action="store_true", help="only measure seconds for complete clouds")
    options = parser.parse_args()
    limit_threads(options.threads)
    print(setting() + data_note())
    if options.domes:
        return print_domes(options.runs, options.first)
    if options.times:
        return print_times([100_000, 1_270_820, 5_000_000])
    for table in (print_nulls, print_bends, print_parts):
        table(options.runs, options.only, options.first)


if __name__ == "__main__":
    main()
