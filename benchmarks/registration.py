"""Count successes, failures and warnings of registrations, against other libraries: python benchmarks/registration.py

--seeds 3      scenes per case
--quick        one scene, few cases
--only a,b     only these sweeps, or `speed`
--rows FILE    save the outcomes, or read them if the file exists
--chart FILE   draw the outcomes

Each case has two independent samples of one city with 2 cm noise; the truth is exact. The error is the root mean
square distance between the reference's points under the measured and the true transform; at most 5 cm (2.5 sigma) is a
success.
A failure is *said* if the method raises or warns; for a peer, if it reports no convergence or matches less than 30 % of
the candidate (KISS-Matcher: less than 5 inliers, the rule of its example). Any other failure is *confidently wrong*.
Peers run coarse to fine, with maximum correspondence distances of 20, 6 and 2 m, on voxels of 0.5 m (features: 2 m).
"""

import argparse
import importlib.util
import json
import os
import resource
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from measure import alternate, setting
from registration_cases import ALSO_GLOBAL, SWEEPS, Case, clouds, rotation
from registration_peers import (
    MAX_DISTANCES,
    VOXEL,
    Method,
    global_methods,
    pcbench_method,
    refinements,
    small_gicp_method,
)

from pcbench import register
from pcbench.geometry.neighbors import Index
from pcbench.geometry.normals import Surface
from pcbench.geometry.transform import Similarity
from pcbench.registration import Target, local_origin
from pcbench.scenes.synthetic import demo

MAX_SUCCESS_ERROR = 0.05  # largest error of a success, in metres


# ---- measuring ----


def outcome(method: Method, case: Case, seed: int) -> dict:
    """Run a method on one case."""
    reference, candidate, T_true = clouds(case, seed)
    wall, cpu = time.perf_counter(), _cpu_seconds()
    transform, confident = method(reference, candidate)
    row = {"wall": time.perf_counter() - wall, "cpu": _cpu_seconds() - cpu, "error": None, "confident": confident}
    if transform is not None:
        aligned = transform.apply(T_true.inverse().apply(reference))
        row["error"] = float(np.sqrt(np.square(aligned - reference).sum(axis=1).mean()))
    return row


def verdict(row: dict) -> str:
    """Classify an outcome."""
    if row["error"] is not None and row["error"] <= MAX_SUCCESS_ERROR:
        return "success"
    return "wrong" if row["confident"] else "said"


def run(name: str, seeds: int, *, quick: bool) -> list[dict]:
    """Run all methods on a sweep and print its table."""
    sweep, rows = SWEEPS[name], []
    methods = global_methods() if sweep.everyone else refinements()
    methods |= {method: pcbench_method(method) for method in ALSO_GLOBAL.get(name, ())}
    print(f"\n{sweep.title}, {sweep.unit}".rstrip(", "))
    print(f"{'':>8}  {'method':24}{'success':>8}{'said so':>9}{'wrong':>7}{'error mm':>10}{'wall s':>8}{'CPU s':>8}")
    for value in sweep.quick if quick else sweep.values:
        for method, call in methods.items():
            results = [outcome(call, sweep.case(value), seed) for seed in range(1, seeds + 1)]
            verdicts = [verdict(row) for row in results]
            share = {kind: verdicts.count(kind) / seeds for kind in ("success", "said", "wrong")}
            errors = [row["error"] for row in results if verdict(row) == "success"]
            error = f"{1000 * statistics.median(errors):.1f}" if errors else "-"
            wall, cpu = (statistics.median(row[clock] for row in results) for clock in ("wall", "cpu"))
            print(
                f"{value!s:>8}  {method:24}{share['success']:>8.0%}{share['said']:>9.0%}{share['wrong']:>7.0%}"
                f"{error:>10}{wall:>8.2f}{cpu:>8.2f}",
                flush=True,
            )
            rows.append({"sweep": name, "value": value, "method": method, **share, "wall": wall, "cpu": cpu})
    return rows


def print_sums(rows: list[dict], seeds: int) -> None:
    """Print how many runs of each method are right, or wrong without a warning, over the sweeps of refinements."""
    of_method: dict[str, list[dict]] = {}
    for row in rows:
        if not SWEEPS[row["sweep"]].everyone:
            of_method.setdefault(row["method"], []).append(row)
    complete = max(map(len, of_method.values()), default=0)
    print(f"\n{'all starts near the pose':28}{'runs':>6}{'right':>8}{'said so':>9}{'wrong':>7}")
    for method, its_rows in of_method.items():
        if len(its_rows) == complete:
            right, said, wrong = (round(seeds * sum(row[kind] for row in its_rows)) for kind in COLORS)
            print(f"{method:28}{seeds * len(its_rows):6}{right:8}{said:9}{wrong:7}")


def speed(runs: int) -> None:
    """Time registrations at the sizes of Gao et al. (1,270,820 and 244,849 points) from 5 degrees and 2 m."""
    scene = demo()
    reference = scene.reference
    origin = local_origin(reference)
    start = Similarity(rotation(np.array([0.0, 0.0, 1.0]), np.radians(5)), np.array([2.0, 0.0, 0.0]))
    T_true = scene.T_reference_candidate["densified"]
    candidate = start.apply(T_true.apply(scene.candidates["densified"].points))
    target = Target(Surface(Index(reference.points - origin)))
    register(reference, candidate, target=target)  # computes the normals that are needed
    contestants: dict[str, Callable[[], object]] = {
        "pcbench icp, index included": lambda: register(reference, candidate),
        "pcbench icp, index and normals there": lambda: register(reference, candidate, target=target),
    }
    if importlib.util.find_spec("small_gicp"):
        import small_gicp

        threads = len(os.sched_getaffinity(0))
        preprocessed_target, tree = small_gicp.preprocess_points(reference.points, VOXEL, num_threads=threads)
        preprocessed_candidate, _ = small_gicp.preprocess_points(candidate, VOXEL, num_threads=threads)

        def align(kind: str) -> None:
            T = np.eye(4)
            for max_distance in MAX_DISTANCES:
                T = small_gicp.align(
                    preprocessed_target,
                    preprocessed_candidate,
                    tree,
                    T,
                    registration_type=kind,
                    max_correspondence_distance=max_distance,
                    max_iterations=60,
                    num_threads=threads,
                ).T_target_source

        for kind in ("PLANE_ICP", "GICP", "VGICP"):
            run_all = small_gicp_method(kind)
            contestants[f"small_gicp {kind}, preprocessing included"] = lambda run_all=run_all: run_all(
                reference.points, candidate
            )
        contestants["small_gicp PLANE_ICP, preprocessed"] = lambda: align("PLANE_ICP")
        contestants["small_gicp GICP, preprocessed"] = lambda: align("GICP")
    print(f"\n{len(reference):,} against {len(candidate):,} points, start 5 degrees and 2 m; median of {runs} runs")
    print(f"{'':44}{'wall s':>8}{'CPU s':>8}")
    for name, (wall, cpu) in alternate(contestants, runs).items():
        print(f"{name:44}{wall:>8.2f}{cpu:>8.2f}")


def _cpu_seconds() -> float:
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + children.ru_utime + children.ru_stime


# ---- chart ----

COLORS = {"success": "#0072B2", "said": "#D8DADD", "wrong": "#D55E00"}  # palette of Okabe and Ito
LABELS = {
    "success": f"right to {100 * MAX_SUCCESS_ERROR:.0f} cm",
    "said": "failed with a warning",
    "wrong": "confidently wrong",
}


def draw(rows: list[dict], file: str) -> None:
    """Draw the shares of outcomes by sweep and method."""
    import matplotlib.pyplot as plt
    from matplotlib.patches import Patch, Rectangle

    names = [name for name in SWEEPS if any(row["sweep"] == name for row in rows)]
    table = {(row["sweep"], row["value"], row["method"]): row for row in rows}
    refinement_sweeps = [name for name in names if not SWEEPS[name].everyone]
    global_sweeps = [name for name in names if SWEEPS[name].everyone]
    blocks = [
        (group, _methods(rows, group))
        for group in (refinement_sweeps[:3], refinement_sweeps[3:], global_sweeps)
        if group
    ]
    # Sizes are in inches, so that bars are equally large in all blocks.
    bar_height, title_height, top_margin, bottom_margin, left_margin, width = 0.27, 0.75, 0.8, 0.3, 1.85, 11.0
    height = top_margin + bottom_margin + sum(title_height + bar_height * len(methods) for _, methods in blocks)
    figure = plt.figure(figsize=(width, height), facecolor="white")
    y0 = height - top_margin
    for group, methods in blocks:
        counts = [len({row["value"] for row in rows if row["sweep"] == name}) for name in group]
        cell_width = min(0.72, (width - left_margin - 0.3 - 0.35 * len(group)) / sum(counts))
        x0, y0 = left_margin, y0 - title_height - bar_height * len(methods)
        for k, (name, columns) in enumerate(zip(group, counts, strict=True)):
            area = (x0 / width, (y0 + 0.45) / height, columns * cell_width / width, bar_height * len(methods) / height)
            axis = figure.add_axes(area)
            x0 += columns * cell_width + 0.35
            values = list(dict.fromkeys(row["value"] for row in rows if row["sweep"] == name))
            for x, value in enumerate(values):
                for y, method in enumerate(methods):
                    row, start = table.get((name, value, method)), x - 0.45
                    if row is None:
                        axis.plot(x, y, marker=".", color="#A9ADB3", markersize=3)
                        continue
                    for kind, color in COLORS.items():
                        hatch = {"hatch": "xxxx", "edgecolor": "white"} if kind == "wrong" else {"edgecolor": "none"}
                        share = 0.9 * row[kind]
                        if share:
                            axis.add_patch(Rectangle((start, y - 0.38), share, 0.76, facecolor=color, lw=0, **hatch))
                        start += share
            axis.set(xlim=(-0.5, len(values) - 0.5), ylim=(len(methods) - 0.5, -0.5))
            axis.set_xticks(range(len(values)), [f"{v}" for v in values])
            axis.set_yticks(range(len(methods)), methods if k == 0 else [""] * len(methods))
            for label, method in zip(axis.get_yticklabels(), methods, strict=True):
                label.set_fontweight("bold" if method in OURS else "normal")
            axis.tick_params(length=0, labelsize=9)
            axis.set_title(
                f"{SWEEPS[name].title} ({SWEEPS[name].unit})" if SWEEPS[name].unit else SWEEPS[name].title,
                fontsize=10,
                loc="left",
                pad=5,
            )
            separators = [y + 0.5 for y in range(len(methods) - 1) if (methods[y] in OURS) != (methods[y + 1] in OURS)]
            axis.hlines(separators, -0.5, len(values) - 0.5, color="#8A8F96", lw=0.8)
            for side in axis.spines.values():
                side.set_visible(False)
    handles = [
        Patch(facecolor=COLORS[k], edgecolor="white", lw=0, hatch="xxxx" if k == "wrong" else "", label=LABELS[k])
        for k in COLORS
    ]
    figure.text(0.15 / width, 1 - 0.36 / height, "Which registration can be relied on?", fontsize=15, fontweight="bold")
    legend_position = (0.1 / width, 1 - 0.46 / height)
    figure.legend(
        handles=handles, loc="upper left", ncols=3, frameon=False, fontsize=10, bbox_to_anchor=legend_position
    )
    note = "Share of scenes: two samples of a 200 m city with 2 cm noise. Bold: pcbench. Dots: not run."
    figure.text(0.15 / width, 0.1 / height, note, fontsize=9, color="#50555C")
    figure.savefig(file, dpi=150)


OURS = ("icp", "icp-point", "similarity", "global", "global-similarity")


def _methods(rows: list[dict], group: list[str]) -> list[str]:
    """Return our methods first, then the others in order."""
    present = list(dict.fromkeys(row["method"] for row in rows if row["sweep"] in group))
    return [m for m in OURS if m in present] + [m for m in present if m not in OURS]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--runs", type=int, default=3, help="runs of the speed table")
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--only", default=",".join([*SWEEPS, "speed"]))
    parser.add_argument("--rows", type=Path)
    parser.add_argument("--chart")
    options = parser.parse_args()
    print(setting())
    rows: list[dict] = []
    if options.rows and options.rows.exists():
        rows = json.loads(options.rows.read_text())
    else:
        for name in options.only.split(","):
            if name != "speed":
                rows += run(name, 1 if options.quick else options.seeds, quick=options.quick)
                if options.rows:
                    options.rows.write_text(json.dumps(rows))
        if rows:
            print_sums(rows, 1 if options.quick else options.seeds)
        if "speed" in options.only.split(","):
            speed(1 if options.quick else options.runs)
    if options.chart and rows:
        draw(rows, options.chart)


if __name__ == "__main__":
    main()
