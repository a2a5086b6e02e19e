"""Clouds of Gaussians, next to sparse and dense stereo: python benchmarks/splat_clouds.py

Each row is a cloud of a synthetic city with exact truth: `sfm`, `mvs`, and for splats initialised from either the
centres of the Gaussians, those of the opaque ones, the surface, and the surface combined with the points of `mvs`. CPU
seconds include everything that a cloud needs: a splat initialised from `mvs` includes its time. With several cities,
the last table has the medians, least and greatest values. `--seeds 101-103` chooses cities of these seeds and of
`--rig`. With one thread: OMP_NUM_THREADS=1.
"""

import argparse
import os
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from measure import setting

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from splat_cities import EXTENT, City, CloudScore, city, score_cloud

from pcbench.plugins import Reconstruction, Reconstructor
from reconstructors.mvs.mvs import DenseMvs
from reconstructors.sfm.sfm import ColmapSfm
from reconstructors.splat.splat import GaussianSplatting

MIN_OPAQUE_OPACITY = 0.5  # minimum opacity
TABLE_HEAD = (
    f"{'':38}{'CPU s':>7}{'points':>9}{'accuracy':>10}{'by area':>9}{'completeness':>14}{'of seen':>9}{'precision':>11}"
    f"{'recall':>8}{'F-score':>9}{'of seen':>9}"
)
SUMMARY_HEAD = f"{'':38}{'CPU s':>16}{'accuracy':>22}{'by area':>22}{'precision':>22}{'recall':>22}{'F-score':>22}"


class Row(NamedTuple):
    """A row of the table."""

    name: str
    seconds: float
    score: CloudScore

    def __str__(self) -> str:
        s = self.score
        return (
            f"{self.name:38}{self.seconds:7.0f}{s.points:9,}{s.accuracy:10.3f}{s.accuracy_by_area:9.3f}{s.completeness:14.2f}{s.seen:9.2f}"
            f"{s.precision:11.3f}{s.recall:8.3f}{s.fscore:9.3f}{s.fscore_seen:9.3f}"
        )


def summary(name: str, rows: list[Row]) -> str:
    """Return the medians of several cities, with least and greatest values."""
    scores = [row.score for row in rows]
    quantities = (
        [score.accuracy for score in scores],
        [score.accuracy_by_area for score in scores],
        [score.precision for score in scores],
        [score.recall for score in scores],
        [score.fscore for score in scores],
    )
    ranges = (f"{np.median(q):.3f} ({min(q):.3f}, {max(q):.3f})" for q in quantities)
    return f"{name:38}{np.median([row.seconds for row in rows]):16.0f}" + "".join(f"{text:>22}" for text in ranges)


def cpu_seconds() -> float:
    """Return the CPU seconds of this process and its children."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


def rows(city: City, work: Path, options: argparse.Namespace) -> Iterator[Row]:
    """Yield the rows of a city."""

    def reconstruct_timed(method: Reconstructor, folder: Path) -> tuple[Reconstruction, float]:
        """Run a method in a workspace that later splats use as their initial model."""
        folder.mkdir(parents=True, exist_ok=True)
        start = cpu_seconds()
        reconstruction = method.reconstruct(city.scene, folder)
        return reconstruction, cpu_seconds() - start

    seconds_by_start = {}
    methods: tuple[tuple[str, Reconstructor], ...] = (("sfm", ColmapSfm()), ("mvs", DenseMvs()))
    for start, method in methods:
        reconstruction, seconds_by_start[start] = reconstruct_timed(method, work / start / start)
        yield Row(start, seconds_by_start[start], score_cloud(city.truth, reconstruction.cloud.points))
    budget = {"steps": options.steps, "gaussians": options.gaussians}
    splats = (
        {}
        if options.quick
        else {
            "sfm, classic": GaussianSplatting(start="sfm", density="classic", **budget),
            "mvs, unsupervised": GaussianSplatting(density="fixed", supervision="none", **budget),
        }
    )
    splats["mvs"] = GaussianSplatting(density="fixed", **budget)
    for name, splat in splats.items():
        training_s = None
        clouds = {
            "surface": replace(splat, cloud="surface"),
            "means": replace(splat, cloud="means"),
            f"means, opacity {MIN_OPAQUE_OPACITY}": replace(splat, cloud="means", min_opacity=MIN_OPAQUE_OPACITY),
        }
        if splat.start == "mvs":
            clouds["combined"] = splat
        for cloud, method in clouds.items():
            reconstruction, seconds = reconstruct_timed(method, work / splat.start)
            if training_s is None:  # the first one trains; the others use its model
                training_s, seconds = seconds, 0.0
            seconds += seconds_by_start[splat.start] + training_s
            yield Row(f"splat from {name}: {cloud}", seconds, score_cloud(city.truth, reconstruction.cloud.points))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", default="circles, seed 11;circles, seed 12;oblique, half texture")
    parser.add_argument("--seeds", help="first and last seed of cities of the rig, instead of cases: 101-103")
    parser.add_argument("--rig", default="circles", help="rig of the cities of --seeds")
    parser.add_argument("--quick", action="store_true", help="without splats from sfm, and without unsupervised ones")
    parser.add_argument("--images", type=int, default=40)
    parser.add_argument("--size", default="320x180")
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--gaussians", type=int, default=20_000)
    parser.add_argument("--folder", type=Path, help="folder that keeps the cities; existing ones are used again")
    options = parser.parse_args()
    cases = options.cases.split(";")
    if options.seeds:
        first, last = map(int, options.seeds.split("-"))
        cases = [f"{options.rig}, seed {seed}" for seed in range(first, last + 1)]
    print(setting())
    print(
        f"{options.images} images of {options.size}, cities of {EXTENT} m, {options.steps} steps, at most"
        f" {options.gaussians:,} Gaussians"
    )
    rows_by_name: dict[str, list[Row]] = {}
    with tempfile.TemporaryDirectory() as temporary:
        root = options.folder or Path(temporary)
        for number, case in enumerate(cases):
            scored_city = city(root / case.replace(", ", "_").replace(" ", "_"), case, options.images, options.size)
            print(f"\n{case}; two footprints of a pixel are {2 * scored_city.truth.pixel:.2f} m\n{TABLE_HEAD}")
            for row in rows(scored_city, Path(temporary) / f"work{number}", options):
                print(row, flush=True)
                rows_by_name.setdefault(row.name, []).append(row)
    if len(cases) > 1:
        print(f"\nmedians of {len(cases)} cities (least, greatest)\n{SUMMARY_HEAD}")
        for name, same in rows_by_name.items():
            print(summary(name, same))


if __name__ == "__main__":
    main()
