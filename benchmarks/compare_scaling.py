"""Cost of a complete comparison against the number of points: the part `--scaling` of benchmarks/compare.py."""

from __future__ import annotations

import multiprocessing
import statistics
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from compare_sides import NAMES, run_side

MAX_REPEATED_POINTS = 1_000_000  # larger comparisons are run once
FITTED_RANGE = 10  # the largest sizes are fitted: smaller comparisons are dominated by costs per run, not per point


class Row(NamedTuple):
    """Cost of one side at one size.

    Attributes:
        size: number of points of the reference.
        wall: wall seconds without start and imports.
        cpu: CPU seconds without start and imports.
        mib: peak memory.
        reason: why there are no figures, such as "> 300 s"; None: there are.
    """

    side: str
    size: int
    wall: float = 0.0
    cpu: float = 0.0
    mib: float = 0.0
    reason: str | None = None


def write_clouds(folder: str, size: int) -> None:
    """Write a reference of this size and a candidate."""
    from pcbench import write_cloud
    from pcbench.scenes.synthetic import demo

    scene = demo(size)
    write_cloud(Path(folder) / "reference.ply", scene.reference)
    write_cloud(Path(folder) / "candidate.ply", scene.candidates["densified"])


def measure(sides: list[str], sizes: list[int], runs: int, limit_s: float, limit_gib: float) -> list[Row]:
    """Run all sides at all sizes, alternating; print and return one row for each.

    A side that exceeds a limit or fails is not run with more points.
    """
    repeats = f"medians of {runs} runs up to {MAX_REPEATED_POINTS:,} points, then one" if runs > 1 else "one run each"
    print(f"{repeats}; start and imports are not included")
    print(f"limits per run: {limit_s:.0f} s, {limit_gib:.1f} GiB\n")
    columns = f"{'wall s':>9}{'CPU s':>9}{'us a point':>12}{'MiB':>9}{'wall ratio':>12}{'CPU ratio':>12}"
    print(f"{'points':>12}  {'':14}{columns}")
    rows: list[Row] = []
    given_up: dict[str, str] = {}
    for size in sorted(sizes):
        of_size = list(
            _measure_size(sides, size, runs if size <= MAX_REPEATED_POINTS else 1, limit_s, limit_gib, given_up)
        )
        ours = next((row for row in of_size if row.side == "ours" and row.reason is None), None)
        for row in of_size:
            print(_line(row, ours), flush=True)
            if row.reason:
                given_up.setdefault(row.side, f"not run: {row.reason} with {size:,} points")
        rows += of_size
    return rows


def _measure_size(
    sides: list[str], size: int, runs: int, limit_s: float, limit_gib: float, given_up: dict[str, str]
) -> Iterator[Row]:
    samples: dict[str, list[dict]] = {side: [] for side in sides if side not in given_up}
    reasons = dict(given_up)
    with tempfile.TemporaryDirectory() as folder:
        # Its memory is free again before the sides are run.
        writer = multiprocessing.get_context("spawn").Process(target=write_clouds, args=(folder, size))
        writer.start()
        writer.join()
        for number in range(runs):
            for side in list(samples) if number % 2 == 0 else list(samples)[::-1]:
                result = run_side(side, Path(folder), limit_s=limit_s, limit_bytes=limit_gib * 2**30)
                if isinstance(result, str):
                    reasons[side] = result
                    del samples[side]
                else:
                    samples[side].append(result)
    for side in sides:
        if side in reasons:
            yield Row(side, size, reason=reasons[side])
        else:
            wall, cpu = (
                statistics.median(run["steps"]["total"][i] - run["steps"]["import"][i] for run in samples[side])
                for i in range(2)
            )
            yield Row(side, size, wall, cpu, statistics.median(run["peak"] for run in samples[side]) / 2**20)


def _line(row: Row, ours: Row | None) -> str:
    start = f"{row.size:12,}  {NAMES[row.side]:14}"
    if row.reason:
        return f"{start}  {row.reason}"
    ratios = f"{row.wall / ours.wall:12.1f}{row.cpu / ours.cpu:12.1f}" if ours else f"{'-':>12}{'-':>12}"
    return f"{start}{row.wall:9.2f}{row.cpu:9.2f}{row.cpu / row.size * 1e6:12.2f}{row.mib:9.0f}{ratios}"


def exponent(rows: list[Row]) -> tuple[float, list[int]] | None:
    """Fit CPU seconds proportional to a power of the number of points, to the rows of one side in ascending order.

    Returns:
        The exponent by least squares of the logarithms, and the sizes that were fitted: those from a tenth of the
        largest; None: fewer than two.
    """
    import numpy as np

    finished = [row for row in rows if row.reason is None]
    fitted = [row for row in finished if row.size * FITTED_RANGE >= finished[-1].size]
    if len(fitted) < 2:
        return None
    sizes, seconds = (np.log([getattr(row, name) for row in fitted]) for name in ("size", "cpu"))
    return float(np.polyfit(sizes, seconds, 1)[0]), [row.size for row in fitted]


def by_side(rows: list[Row]) -> dict[str, list[Row]]:
    """Return the rows of each side."""
    return {side: [row for row in rows if row.side == side] for side in dict.fromkeys(row.side for row in rows)}


def print_exponents(rows: list[Row]) -> None:
    """Print the fitted exponent of each side."""
    print()
    for side, its_rows in by_side(rows).items():
        if fit := exponent(its_rows):
            print(
                f"{NAMES[side]}: CPU seconds grow as points^{fit[0]:.2f} from {min(fit[1]):,} to {max(fit[1]):,} points"
            )


def draw(rows: list[Row], file: Path) -> None:
    """Draw seconds and memory against the number of points."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(10, 5))
    for side, its_rows in by_side(rows).items():
        measured = [row for row in its_rows if row.reason is None]
        stopped = [row for row in its_rows if row.reason is not None]
        fit = exponent(its_rows)
        label = NAMES[side] + (f": time ∝ $n^{{{fit[0]:.2f}}}$ from {min(fit[1]):,} points" if fit else "")
        if stopped:
            label += f"; with {stopped[0].size:,}: {stopped[0].reason}"
        for axis, name in zip(axes, ("cpu", "mib"), strict=True):
            axis.loglog(
                [row.size for row in measured],
                [getattr(row, name) for row in measured],
                marker="o",
                linewidth=2.5 if side == "ours" else 1.2,
                label=label,
            )
    axes[0].set(title="Time", ylabel="CPU seconds, without start and imports")
    axes[1].set(title="Memory", ylabel="peak memory, MiB")
    for axis in axes:
        axis.set_xlabel("points of the reference (candidate: 0.19 times as many)")
        axis.grid(True, which="both", alpha=0.3)
        axis.yaxis.set_major_formatter("{x:g}")
        axis.yaxis.set_minor_formatter(lambda x, _: f"{x:g}" if f"{x:g}"[0] in "25" else "")
    figure.tight_layout(rect=(0, 0.15, 1, 1))
    figure.legend(*axes[0].get_legend_handles_labels(), loc="lower center", frameon=False)
    figure.savefig(file, dpi=150)


def available_gib() -> float:
    """Return the memory that is available for new processes, in GiB."""
    line = next(line for line in Path("/proc/meminfo").read_text().splitlines() if line.startswith("MemAvailable"))
    return int(line.split()[1]) / 2**20
