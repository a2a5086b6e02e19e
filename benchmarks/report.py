"""The time to write and to open a report: python benchmarks/report.py [--sizes 1.2e4 2.5e5 1.3e6] [--runs 5]

Each report compares the three clouds of the demo: a dense reference of the given size, and two candidates. `page` is
the time to write report.html, `pictures` the CPU time of the process that draws all pictures, its start included.
`first picture` is the time from the beginning of loading report.html to the first picture, of some points, and `all
points` that to the picture of all of them: in a fresh headless Chromium with software WebGL, and after the page is
loaded again in the same browser. A fresh browser takes most of that time to start its graphics.
"""

from __future__ import annotations

import argparse
import resource
import statistics
import sys
import tempfile
import time
from pathlib import Path

from measure import setting

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from browser import CHROMIUM, Browser

from pcbench import compare
from pcbench.report import document, write_report
from pcbench.report.html import page
from pcbench.report.plot import draw
from pcbench.scenes.synthetic import demo

_HEAD = (
    f"{'reference':>11}{'all points':>12}{'page s':>8}{'page MB':>9}{'pictures':>10}{'CPU s':>7}{'s':>6}"
    f"{'first picture s':>17}{'all points s':>14}{'again s':>9}{'all points s':>14}"
)


def child_seconds() -> float:
    """Return the CPU time of all child processes that have ended."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def opening_seconds(file: Path, runs: int) -> list[float]:
    """Return median seconds to the first picture and to all points, in fresh browsers and on loading the page again."""
    times = []
    for _ in range(runs):
        with Browser() as browser:
            row = []
            for _ in range(2):
                browser.open(file)
                row += browser.run("[pcbenchReport.firstPictureMs, pcbenchReport.allPointsMs]")
            times.append(row)
    return [statistics.median(column) / 1000 for column in zip(*times, strict=True)]


def measure(size: int, runs: int) -> str:
    """Return a table row for a reference of `size` points."""
    scene = demo(size)
    comparison = compare(scene.reference, scene.candidates)
    points = size + sum(len(cloud) for cloud in scene.candidates.values())
    writing, drawing, cpu = [], [], []
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder)
        write_report(report, comparison)
        for _ in range(runs):
            start = time.perf_counter()
            text = page(comparison, document(comparison)["provenance"])
            writing.append(time.perf_counter() - start)
            start, before = time.perf_counter(), child_seconds()
            count = len(draw(report))
            drawing.append(time.perf_counter() - start)
            cpu.append(child_seconds() - before)
        file = report / "report.html"
        seconds = [""] * 4 if CHROMIUM is None else [f"{s:.2f}" for s in opening_seconds(file, runs)]
    return (
        f"{size:11,}{points:12,}{statistics.median(writing):8.2f}{len(text.encode()) / 1e6:9.2f}{count:10}"
        f"{statistics.median(cpu):7.1f}{statistics.median(drawing):6.1f}{seconds[0]:>17}{seconds[1]:>14}"
        f"{seconds[2]:>9}{seconds[3]:>14}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sizes", type=float, nargs="+", default=[1.2e4, 2.5e5, 1.3e6], help="points of the reference")
    parser.add_argument("--runs", type=int, default=5)
    options = parser.parse_args()
    print(setting())
    print(_HEAD, flush=True)
    for size in options.sizes:
        print(measure(int(size), options.runs), flush=True)


if __name__ == "__main__":
    main()
