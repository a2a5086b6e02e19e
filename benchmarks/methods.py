"""Accuracy of all reconstructors by CPU time: python benchmarks/methods.py --chart docs/gallery

Each reconstructor runs with several budgets on synthetic cities whose surfaces are known exactly, with the true cameras
and one thread; COLMAP's sparse points and OpenCV's semi-global matching of pairs (methods_peers.py) run beside them.
CPU seconds are those of the whole run, from photographs to cloud, so those of `splat` include its initial `mvs`.
F-score at two pixel footprints over the part of the surface that at least three cameras see; accuracy is the mean
distance from the cloud to the surface. Prints a table; `--chart` draws means over the cities.
"""

import argparse
import importlib.util
import json
import os
import statistics
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from measure import setting

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from splat_cities import EXTENT, City, city, score_cloud

from pcbench.plugins.run import ReconstructionJob, Run, run

if TYPE_CHECKING:
    from matplotlib.axis import Axis

CITIES = ("circles, seed 11", "oblique, half texture", "grid, hard")


class Budget(NamedTuple):
    """A reconstructor, ours or a peer, with settings, and the scale of its images."""

    method: str
    label: str
    settings: dict[str, str]
    image_scale: float = 1.0


_FIXED = {"density": "fixed", "gaussians": "10000"}
BUDGETS = (
    Budget("sfm", "2,000 features", {"features": "2000", "upsample": "no"}),
    Budget("sfm", "default", {}),
    Budget("mvs", "0.6 of the size", {}, 0.6),
    Budget("mvs", "default", {}),
    Budget("splat", "10,000, 100 steps", _FIXED | {"steps": "100"}),
    Budget("splat", "10,000, 300 steps", _FIXED | {"steps": "300"}),
    Budget("splat", "default", {}),
    Budget("field", "64 voxels, 200 steps", {"resolution": "64", "steps": "200"}),
    Budget("field", "128 voxels, 300 steps", {"resolution": "128", "steps": "300"}),
    Budget("field", "128 voxels, 700 steps", {"resolution": "128", "steps": "700"}),
    Budget("field", "default", {}),
    Budget("COLMAP", "sparse, default", {}),
    Budget("OpenCV", "SGBM of pairs", {}),
)
_PEERS_FILE = Path(__file__).with_name("methods_peers.py")
PEERS = {"COLMAP": f"{_PEERS_FILE}:Colmap", "OpenCV": f"{_PEERS_FILE}:OpenCvPairs"}
HAS_OPENCV = importlib.util.find_spec("cv2") is not None
MISSING = "" if HAS_OPENCV else "; missing: cv2 (pip install opencv-python-headless)"
LINE_STYLES = {
    "sfm": ("#0072b2", "o"),
    "mvs": ("#009e73", "s"),
    "splat": ("#cc79a7", "D"),
    "field": ("#e69f00", "v"),
    "COLMAP": ("#56b4e9", "P"),
    "OpenCV": ("#555555", "X"),
}


class Measured(NamedTuple):
    """Result of a run: CPU seconds, peak memory in MiB, number of points, distances in metres, and F-score."""

    seconds: float
    memory: float
    points: float
    accuracy: float
    completeness: float
    fscore: float


def runnable(budgets: Sequence[Budget]) -> list[Budget]:
    """Return the budgets whose libraries are installed; `MISSING` names the others."""
    return [budget for budget in budgets if budget.method != "OpenCV" or HAS_OPENCV]


def reconstruct(budget: Budget, folder: Path, workspace: Path) -> Run:
    """Run a reconstructor with the scene's cameras."""
    if budget.method in PEERS:
        job = ReconstructionJob(PEERS[budget.method], folder, budget.settings, image_scale=budget.image_scale)
    else:
        settings = {"poses": "given"} | budget.settings
        job = ReconstructionJob(budget.method, folder, settings, image_scale=budget.image_scale)
    return run(job, workspace)


def measure(scored_city: City, folder: Path, budget: Budget, workspace: Path) -> Measured:
    """Run a reconstructor in a new workspace and compare its cloud with the true surface."""
    outcome = reconstruct(budget, folder, workspace)
    score = score_cloud(scored_city.truth, outcome.require_reconstruction().cloud.points)
    memory = (outcome.peak_rss_bytes or 0) / 2**20
    return Measured(outcome.cpu_s, memory, score.points, score.accuracy, score.seen, score.fscore_seen)


def row(measured: Measured) -> str:
    """Return a row of the table."""
    return (
        f"{measured.seconds:8.1f}{measured.memory:8.0f}{measured.points:10,.0f}{measured.accuracy:10.3f}"
        f"{measured.completeness:10.3f}{measured.fscore:9.3f}"
    )


def mean(rows: list[Measured]) -> Measured:
    """Return the mean of each column."""
    return Measured(*map(statistics.fmean, zip(*rows, strict=True)))


def plain_ticks(axis: "Axis") -> None:
    """Label the ticks 1, 2 and 5 of each decade of a logarithmic axis as plain numbers."""
    from matplotlib.ticker import LogLocator, NullLocator, StrMethodFormatter

    axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(StrMethodFormatter("{x:g}"))


def draw(means: list[tuple[Budget, Measured]], path: Path) -> None:
    """Draw F-score and accuracy against CPU seconds, one line per reconstructor."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 4.2), dpi=120, layout="constrained")
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2)
    for method, (color, shape) in LINE_STYLES.items():
        rows = [(budget, measured) for budget, measured in means if budget.method == method]
        if not rows:
            continue
        seconds = [measured.seconds for _, measured in rows]
        style = {"color": color, "alpha": 0.85, "label": method}
        left.plot(seconds, [measured.fscore for _, measured in rows], f"-{shape}", **style)
        right.plot(seconds, [measured.accuracy for _, measured in rows], f"-{shape}", **style)
    left.set_ylabel("F-score over the visible part, 2 footprints")
    right.set_ylabel("accuracy: cloud to surface, mean [m]")
    right.set_yscale("log")
    plain_ticks(right.yaxis)
    for axis in (left, right):
        axis.set_xscale("log")
        plain_ticks(axis.xaxis)
        axis.set_xlabel("CPU seconds")
        axis.margins(0.09, 0.14)
        axis.grid(True, alpha=0.3, which="both")
        axis.spines[["top", "right"]].set_visible(False)
    left.legend(frameon=False, loc="best")
    figure.savefig(path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--images", type=int, default=16)
    parser.add_argument("--size", default="300x200")
    parser.add_argument("--cities", type=int, default=len(CITIES), help="number of cities")
    parser.add_argument("--folder", type=Path, help="folder that keeps cities and rows, which are used again")
    parser.add_argument("--chart", type=Path, metavar="FOLDER", help="draw methods.png")
    options = parser.parse_args()
    os.environ["OMP_NUM_THREADS"] = "1"
    budgets = runnable(BUDGETS)
    print(f"{setting()}{MISSING}")
    print(f"{options.images} images of {options.size}, cities of {EXTENT} m, true cameras, one thread")
    print(f"{'':8}{'':25}{'CPU s':>8}{'MiB':>8}{'points':>10}{'accuracy':>10}{'complete':>10}{'F-score':>9}")
    rows: dict[int, list[Measured]] = {number: [] for number in range(len(budgets))}
    with tempfile.TemporaryDirectory() as temporary:
        for case in CITIES[: options.cities]:
            folder = (options.folder or Path(temporary)) / case.replace(", ", "_").replace(" ", "_")
            scored_city = city(folder, case, options.images, options.size)
            print(case)
            for number, budget in enumerate(budgets):
                record = folder.with_name(f"{folder.name}_{budget.method}_{budget.label}.json".replace(" ", "_"))
                if not record.exists():
                    with tempfile.TemporaryDirectory() as workspace:
                        measured = measure(scored_city, folder, budget, Path(workspace))
                    record.write_text(json.dumps(measured))
                rows[number].append(Measured(*json.loads(record.read_text())))
                print(f"{budget.method:8}{budget.label:25}{row(rows[number][-1])}", flush=True)
            means = [(budget, mean(rows[number])) for number, budget in enumerate(budgets)]
            if options.chart:
                draw(means, options.chart / "methods.png")
    print("mean")
    for budget, measured in means:
        print(f"{budget.method:8}{budget.label:25}{row(measured)}")


if __name__ == "__main__":
    main()
