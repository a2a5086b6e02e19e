"""A complete comparison at the paper's sizes, next to a plain Open3D script and CloudCompare's command line.

    python benchmarks/compare.py [--points 1270820] [--runs 3]
    python benchmarks/compare.py --scaling [--sizes 1e4,3e4,...] [--chart FILE]

Each side runs in a separate process, alternating; prints medians of wall and CPU seconds per step, peak memory, and the
metrics of each side beside those of pcbench with the same registration. Peers that are not installed are named.

--scaling       cost against the number of points of the reference; the candidate has 0.19 times as many
--sizes         numbers of points; the default takes about ten minutes, and 3e7 points need 24 GB of memory
--limit-s       wall seconds after which a side is stopped; it is not tried with more points
--limit-gib     the same for memory; default: 80 % of the available memory
--chart FILE    draw the table of --scaling
"""

from __future__ import annotations

import argparse
import os
import statistics
import tempfile
from pathlib import Path
from typing import Any

import compare_scaling
from compare_sides import METRICS, NAMES, SCOPE, SIDES, STEPS, metrics_at_transform, missing_sides, run_side
from measure import setting


def alternate(sides: list[str], folder: Path, runs: int) -> dict[str, list[dict[str, Any]]]:
    """Return the results of all runs of each side; sides that fail are named and left out."""
    results: dict[str, list[dict[str, Any]]] = {side: [] for side in sides}
    for number in range(runs):
        for side in list(results) if number % 2 == 0 else list(results)[::-1]:
            result = run_side(side, folder)
            if isinstance(result, str):
                print(f"{NAMES[side]}: {result}")
                del results[side]
            else:
                results[side].append(result)
    return results


def median_seconds(runs: list[dict[str, Any]], key: str, name: str) -> tuple[float, float]:
    """Return median wall and CPU seconds of a step or stage."""
    wall, cpu = (statistics.median(run[key].get(name, (0.0, 0.0))[i] for run in runs) for i in range(2))
    return wall, cpu


def print_steps(results: dict[str, list[dict[str, Any]]]) -> None:
    """Print wall and CPU seconds per step of each side, with their ratios to pcbench's, and peak memory."""
    peers = [side for side in results if side != "ours"]
    print(f"{'':20}{'pcbench':>16}" + "".join(f"{NAMES[side]:>16}{'ratio':>16}" for side in peers))
    print(f"{'seconds':20}" + f"{'wall':>8}{'CPU':>8}" * (1 + 2 * len(peers)))
    for step in STEPS:
        ours = median_seconds(results["ours"], "steps", step)
        row = f"{step:20}{ours[0]:8.2f}{ours[1]:8.2f}"
        for side in peers:
            peer = median_seconds(results[side], "steps", step)
            row += f"{peer[0]:8.2f}{peer[1]:8.2f}"
            row += "".join(f"{b / a:8.1f}" if a else f"{'-':>8}" for a, b in zip(ours, peer, strict=True))
        print(row)
    ours_mib, *peers_mib = (statistics.median(run["peak"] for run in runs) / 2**20 for runs in results.values())
    row = f"{'peak memory, MiB':20}{ours_mib:16.0f}"
    print(row + "".join(f"{mib:16.0f}{mib / ours_mib:16.1f}" for mib in peers_mib))


def print_stages(runs: list[dict[str, Any]]) -> None:
    """Print pcbench's stages: those that it announces with CPU seconds, and the parts that its results record."""
    print(f"\n{'stages of pcbench, seconds':44}{'wall':>8}{'CPU':>8}{'busy cores':>12}")
    for stage in runs[0]["stages"]:
        wall, cpu = median_seconds(runs, "stages", stage)
        print(f"{stage:44}{wall:8.2f}{cpu:8.2f}{cpu / wall if wall else 0:12.1f}")
    names = list(runs[0]["timings_s"])
    print(f"\n{'timings_s, wall seconds':28}" + "".join(f"{name:>16}" for name in names))
    for part in runs[0]["timings_s"][names[0]]:
        medians = (statistics.median(run["timings_s"][name].get(part, 0.0) for run in runs) for name in names)
        print(f"{part:28}" + "".join(f"{seconds:16.2f}" for seconds in medians))


def print_values(results: dict[str, list[dict[str, Any]]], scene: Any) -> None:
    """Print the metrics of each side, and those of pcbench with the registration of each peer."""
    peers = [side for side in results if side != "ours"]
    print(f"\n{'':22}{'pcbench':>14}" + "".join(f"{NAMES[side]:>14}{'at its pose':>14}" for side in peers))
    for name, values in results["ours"][0]["values"].items():
        of_peers = [results[side][0]["values"][name] for side in peers]
        at_pose = [metrics_at_transform(scene.reference, scene.candidates[name], peer["T"]) for peer in of_peers]
        for metric in METRICS:
            row = f"{name + ' ' + metric:22}{values[metric]:14.9g}"
            for peer, ours in zip(of_peers, at_pose, strict=True):
                row += f"{peer[metric]:14.9g}" if metric in peer else f"{'-':>14}"
                row += f"{ours[metric]:14.9g}"
            print(row)
    print("at its pose: pcbench's metrics with the registration of this peer, which separates search from registration")


def print_scope(sides: list[str]) -> None:
    """Print what each side computes in these times."""
    indices = [list(NAMES).index(side) for side in sides]
    print(f"\n{'computed':34}" + "".join(f"{NAMES[side]:38}" for side in sides).rstrip())
    for what, by_side in SCOPE.items():
        print(f"{what:34}" + "".join(f"{by_side[i]:38}" for i in indices).rstrip())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--points", type=int, default=1_270_820)
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--scaling", action="store_true")
    parser.add_argument("--sizes", default="1e4,3e4,1e5,3e5,1e6,3e6")
    parser.add_argument("--limit-s", type=float, default=300.0)
    parser.add_argument("--limit-gib", type=float)
    parser.add_argument("--chart", type=Path)
    options = parser.parse_args()
    missing = missing_sides()
    sides = [side for side in SIDES if side not in missing]
    for reason in missing.values():
        print(reason)
    if options.scaling:
        sizes = [round(float(size)) for size in options.sizes.split(",")]
        limit_gib = options.limit_gib or 0.8 * compare_scaling.available_gib()
        print(setting())
        rows = compare_scaling.measure(sides, sizes, options.runs, options.limit_s, limit_gib)
        compare_scaling.print_exponents(rows)
        if options.chart:
            compare_scaling.draw(rows, options.chart)
        return

    from pcbench import write_cloud
    from pcbench.scenes.synthetic import demo

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        scene = demo(options.points)
        for cloud_name, cloud in {"reference": scene.reference, **scene.candidates}.items():
            write_cloud(folder / f"{cloud_name}.ply", cloud)
        results = alternate(sides, folder, options.runs)
    if "ours" not in results:
        return
    sizes = ", ".join(f"{len(cloud):,}" for cloud in scene.candidates.values())
    print(f"{sizes} against {options.points:,} points; {options.runs} alternating runs, medians")
    print(f"{setting()}, {len(os.sched_getaffinity(0))} usable\n")
    print_steps(results)
    print_stages(results["ours"])
    print_values(results, scene)
    print_scope(list(results))


if __name__ == "__main__":
    main()
