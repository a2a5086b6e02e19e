"""Accuracy and completeness of dense clouds of cities with exact truth: python benchmarks/mvs_city.py

Each row is a city: the shares of correct points and of covered surface at 1, 2 and 5 pixel footprints, and the errors
of depth and normal maps. `moved` is a city with a moving object in each of its photographs. `--missed` lists the
surface of the first city that images observe and the cloud misses, by cause.

`--seeds 101-110` prints a row per seed, and for each case the median and the range of the seeds. To compare two
versions, run this file with each of them first in PYTHONPATH, with the same seeds and without `--folder`.
"""

import argparse
import resource
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from measure import setting
from PIL import Image

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from dense_cases import MIN_WRONG_FOOTPRINTS, City, CloudScore, read_city, recall_by_cause, score_cloud, score_maps

from pcbench.geometry.neighbors import Index
from pcbench.io import read_cloud
from pcbench.scenes.synthetic.layout import lay_out
from pcbench.scenes.synthetic.plan import CitySettings

LAKES_SEED = 6  # a seed that creates two lakes of four blocks
CASES = {
    "city": "",
    "texture 0": "--texture 0",
    "repeated": "--repeated",
    "water": "--water --reflections",
    "hard": "--hard",
    "moved": "",
}
LAKES = ("water", "hard")  # cases with lakes
DEFAULT_SEED = 5  # of the cases without lakes
CITY_EXTENT = 100  # side of the cities, in metres
SHORE_MARGIN = 3.0  # margin of the lakes that is left out, in metres
MOVING_OBJECT_SHARE = 0.2  # size of the moving object, as a share of the image's sides


def pcbench(*arguments: object) -> None:
    """Run a command."""
    subprocess.run([sys.executable, "-m", "pcbench.cli", *map(str, arguments)], check=True)


def make_city(folder: Path, name: str, options: argparse.Namespace, seed: int) -> None:
    """Create the city of a case."""
    size = ["--images", options.images, "--size", options.size, "--extent", CITY_EXTENT, "--rig", options.rig]
    city_options = [*size, "--seed", seed, *CASES[name].split()]
    pcbench("synth", "city", "--out", folder, "--points", 200_000, "--quiet", *city_options)
    if name == "moved":
        add_moving_objects(folder, np.random.default_rng(seed))


def add_moving_objects(folder: Path, rng: np.random.Generator) -> None:
    """Paste a textured part of another photograph at a random position of each; no two images agree on it."""
    paths = sorted((folder / "images").iterdir())
    photographs = [Image.open(path).copy() for path in paths]
    for number, path in enumerate(paths):
        width, height = photographs[number].size
        patch_width, patch_height = int(MOVING_OBJECT_SHARE * width), int(MOVING_OBJECT_SHARE * height)
        source = photographs[(number + len(paths) // 2) % len(paths)]
        (x, y), (left, upper) = rng.integers(0, [[width - patch_width, height - patch_height]] * 2)
        edited = photographs[number].copy()
        edited.paste(source.crop((left, upper, left + patch_width, upper + patch_height)), (x, y))
        edited.save(path)


def reconstruct(folder: Path, work: Path, correlation: float | None = None) -> float:
    """Reconstruct the dense cloud of a city; return the CPU seconds of the job.

    With a minimum correlation, points are kept whatever their confidence.
    """
    start = children_cpu_seconds()
    setting_options = [] if correlation is None else ["--set", f"correlation={correlation}", "--set", "precision=0"]
    pcbench(
        "reconstruct",
        "mvs",
        folder,
        "--out",
        work / "cloud.ply",
        "--workspace",
        work / "work",
        "--quiet",
        *setting_options,
    )
    return children_cpu_seconds() - start


def children_cpu_seconds() -> float:
    """Return the CPU seconds of all child processes that have ended."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


class SeedResult(NamedTuple):
    """Result of one seed.

    Args:
        precision: share of the points within two footprints of the surface.
        recall: share of the observed surface within two footprints of a point.
        textured: recall of textured surface.
        fscore: F-score of precision and recall.
        wrong: share of the points farther than five footprints from the surface.
        accuracy: median distance from the points to the surface, in footprints.
        completeness: mean distance from the observed surface to the points, in footprints.
        cpu: CPU seconds of the job.
        cpu_per_map: CPU seconds of the job per image.
    """

    precision: float
    recall: float
    textured: float
    fscore: float
    wrong: float
    accuracy: float
    completeness: float
    cpu: float
    cpu_per_map: float

    @classmethod
    def of(cls, score: CloudScore, cpu: float, images: int) -> "SeedResult":
        """Return the result of a city from its score and the CPU seconds of its job."""
        return cls(
            score.precision[1],
            score.recall[1],
            score.textured[1],
            score.fscore[1],
            score.wrong,
            score.accuracy,
            score.completeness,
            cpu,
            cpu / images,
        )


SEED_FORMATS = SeedResult(*["{:.3f}"] * 4, "{:.2%}", *["{:.3f}"] * 2, "{:.1f}", "{:.2f}")


def describe_seeds(name: str, results: Sequence[SeedResult]) -> str:
    """Return the medians and the ranges of a case over its seeds, as text."""
    lines = [f"{name}, {len(results)} seeds:"]
    for field, form, values in zip(SeedResult._fields, SEED_FORMATS, zip(*results, strict=True), strict=True):
        median, low, high = (form.format(value) for value in (np.median(values), min(values), max(values)))
        lines.append(f"{'':4}{field.replace('_', ' '):14}{median:>8}  [{low}, {high}]")
    return "\n".join(lines)


def parse_seeds(text: str) -> list[int]:
    """Return the seeds of a list of numbers and ranges, such as 1,5,101-110."""
    ranges = [part.split("-") for part in text.split(",")]
    return [seed for ends in ranges for seed in range(int(ends[0]), int(ends[-1]) + 1)]


TABLE_HEAD = (
    f"{'':12}{'':>9}{'points within':>21}{'wrong':>8}{'seen, within':>21}{'empty':>7}{'textured':>10}"
    f"{'depth error, footprints':>27}{'normal':>8}{'plain pixels':>21}{'sky':>7}\n"
    f"{'':12}{'points':>9}{'1':>7}{'2':>7}{'5':>7}{'':8}{'1':>7}{'2':>7}{'5':>7}{'':7}{'2':>10}"
    f"{'50%':>9}{'90%':>6}{'95%':>6}{'99%':>6}{'deg':>8}{'share':>7}{'kept':>7}{'wrong':>7}{'kept':>7}"
)


def row(name: str, city: City, score: CloudScore, workspace: Path) -> str:
    """Return the table row of a city."""
    map_scores = score_maps(city, workspace)
    precisions = "".join(f"{share:7.3f}" for share in score.precision)
    recalls = "".join(f"{share:7.3f}" for share in score.recall)
    depth_errors = "".join(f"{error:6.2f}" for error in map_scores.depth)
    shares = (
        f"{map_scores.plain:7.1%}{map_scores.plain_known:7.1%}{map_scores.plain_wrong:7.2%}{map_scores.sky_known:7.2%}"
    )
    return (
        f"{name:12}{score.points:9,}{precisions}{score.wrong:8.2%}{recalls}{score.empty:7.1%}"
        f"{score.textured[1]:10.3f}   {depth_errors}{map_scores.normal:8.1f}{shares}"
    )


def describe_lakes(city: City, points: np.ndarray, seed: int) -> str:
    """Return the share of water with points nearby, and the share of wrong points over it, as text."""
    plan = lay_out(CitySettings(extent=CITY_EXTENT, water=True, seed=seed))
    limit, is_covered, is_wrong = MIN_WRONG_FOOTPRINTS * city.footprint, [], []
    for lake in (block for block in plan.blocks if block.kind == "lake"):
        low, high = np.add(lake.low, SHORE_MARGIN), np.subtract(lake.high, SHORE_MARGIN)
        water_points = city.seen[((city.seen[:, :2] > low) & (city.seen[:, :2] < high)).all(axis=1)]
        level = np.median(water_points[:, 2])
        points_over_lake = points[((points[:, :2] > low) & (points[:, :2] < high)).all(axis=1)]
        is_covered.append(Index(points).query(water_points[np.abs(water_points[:, 2] - level) < 0.1]).distances < limit)
        is_wrong.append(np.abs(points_over_lake[:, 2] - level) > limit)
    covered_share, wrong_share = (float(np.mean(np.concatenate(flags))) for flags in (is_covered, is_wrong))
    return (
        f"{'':12}of its lakes {covered_share:.1%} have points near, and of the points over them {wrong_share:.2%} are"
        " wrong"
    )


def score_workspace(city: City, work: Path) -> CloudScore:
    """Score the cloud of a workspace."""
    return score_cloud(city, read_cloud(work / "cloud.ply").points)


def print_cities(root: Path, names: Sequence[str], options: argparse.Namespace) -> None:
    """Create, reconstruct and score cities."""
    print(TABLE_HEAD)
    for name in names:
        results = []
        for seed in options.seeds or [LAKES_SEED if name in LAKES else DEFAULT_SEED]:
            folder, work = root / f"{name.replace(' ', '')}{seed}", root / f"{name.replace(' ', '')}{seed}_work"
            if not folder.exists():
                make_city(folder, name, options, seed)
            work.mkdir(exist_ok=True)
            cpu = reconstruct(folder, work)
            city = read_city(folder)
            score = score_workspace(city, work)
            results.append(SeedResult.of(score, cpu, options.images))
            label = f"{name} {seed}" if options.seeds else name
            print(row(label, city, score, work / "work" / "plugin"), flush=True)
            if name in LAKES and not options.seeds:
                print(describe_lakes(city, read_cloud(work / "cloud.ply").points, seed), flush=True)
            if options.missed and name == names[0]:
                print_missed_surface(city, work)
        if options.seeds:
            print(describe_seeds(name, results), flush=True)


def print_missed_surface(city: City, work: Path) -> None:
    """Print how much of the observed surface is missing, and why."""
    parts = recall_by_cause(city, read_cloud(work / "cloud.ply").points)
    print(f"\n{'observed surface':26}{'share':>8}{'within 2':>10}{'of the missed':>15}")
    for name, part in parts.items():
        print(f"{name:26}{part.share:8.1%}{part.recall:10.3f}{part.missed:15.1%}")
    print(f"{'all':26}{1:8.1%}{sum(part.share * part.recall for part in parts.values() if part.share):10.3f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", default=",".join(CASES))
    parser.add_argument("--images", type=int, default=20)
    parser.add_argument("--size", default="480x320")
    parser.add_argument("--rig", default="oblique")
    parser.add_argument("--seeds", type=parse_seeds, help="Seeds of the cities, such as 5 or 101-110.")
    parser.add_argument("--missed", action="store_true")
    parser.add_argument("--folder", type=Path, help="Folder that keeps all files; existing ones are used again.")
    options = parser.parse_args()
    print(setting())
    print(f"{options.images} images of {options.size}, rig {options.rig}, cities of {CITY_EXTENT} m")
    with tempfile.TemporaryDirectory() as temporary:
        root = options.folder or Path(temporary)
        root.mkdir(parents=True, exist_ok=True)
        print_cities(root, options.cases.split(","), options)


if __name__ == "__main__":
    main()
