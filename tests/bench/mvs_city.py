"""Accuracy and completeness of dense clouds of cities with exact truth: python tests/bench/mvs_city.py

Each row is a city: the shares of correct points and of covered surface at 1, 2 and 5 pixel footprints, and the errors
of depth and normal maps. `moved` is a city with a moving object in each of its photographs. `--missed` analyses the
missing textured surface of the first city.
"""

import argparse
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from measure import setting
from PIL import Image

sys.path.insert(0, str(Path(__file__).parents[1]))

from dense_cases import MIN_WRONG_FOOTPRINTS, City, CloudScore, read_city, recall_by_view, score_cloud, score_maps

from pcbench.geometry.neighbors import Index
from pcbench.io import read_cloud
from pcbench.scenes.synthetic.layout import lay_out
from pcbench.scenes.synthetic.plan import CitySettings

LAKES = 6  # a seed that creates two lakes of four blocks
CASES = {
    "city": "",
    "texture 0": "--texture 0",
    "repeated": "--repeated",
    "water": f"--water --reflections --seed {LAKES}",
    "hard": f"--hard --seed {LAKES}",
    "moved": "",
}
EXTENT = 100  # side of the cities, in metres
SHORE = 3.0  # margin of the lakes that is left out, in metres
MOVING = 0.2  # size of the moving object, as a share of the image's sides


def pcbench(*arguments: object) -> None:
    """Run a command."""
    subprocess.run([sys.executable, "-m", "pcbench.cli", *map(str, arguments)], check=True)


def make(folder: Path, name: str, options: argparse.Namespace) -> None:
    """Create the city of a case."""
    size = ["--images", options.images, "--size", options.size, "--extent", EXTENT, "--rig", options.rig]
    chosen = [*size, "--seed", options.seed, *CASES[name].split()]
    pcbench("synth", "city", "--out", folder, "--points", 200_000, "--quiet", *chosen)
    if name == "moved":
        move(folder, np.random.default_rng(options.seed))


def move(folder: Path, rng: np.random.Generator) -> None:
    """Paste a textured part of another photograph at a random position of each; no two images agree on it."""
    paths = sorted((folder / "images").iterdir())
    photographs = [Image.open(path).copy() for path in paths]
    for number, path in enumerate(paths):
        width, height = photographs[number].size
        wide, high = int(MOVING * width), int(MOVING * height)
        other = photographs[(number + len(paths) // 2) % len(paths)]
        (x, y), (left, upper) = rng.integers(0, [[width - wide, height - high]] * 2)
        shown = photographs[number].copy()
        shown.paste(other.crop((left, upper, left + wide, upper + high)), (x, y))
        shown.save(path)


def reconstruct(folder: Path, work: Path, confidence: float | None = None) -> None:
    """Reconstruct the dense cloud of a city."""
    chosen = [] if confidence is None else ["--set", f"confidence={confidence}"]
    pcbench("reconstruct", "mvs", folder, "--out", work / "cloud.ply", "--workspace", work / "work", "--quiet", *chosen)


HEAD = (
    f"{'':12}{'':>9}{'points within':>21}{'wrong':>8}{'seen, within':>21}{'empty':>7}{'textured':>10}"
    f"{'depth error, footprints':>27}{'normal':>8}{'plain pixels':>21}{'sky':>7}\n"
    f"{'':12}{'points':>9}{'1':>7}{'2':>7}{'5':>7}{'':8}{'1':>7}{'2':>7}{'5':>7}{'':7}{'2':>10}"
    f"{'50%':>9}{'90%':>6}{'95%':>6}{'99%':>6}{'deg':>8}{'share':>7}{'kept':>7}{'wrong':>7}{'kept':>7}"
)


def row(name: str, city: City, score: CloudScore, workspace: Path) -> str:
    """Return the table row of a city."""
    found = score_maps(city, workspace)
    right = "".join(f"{share:7.3f}" for share in score.precision)
    there = "".join(f"{share:7.3f}" for share in score.recall)
    depth = "".join(f"{error:6.2f}" for error in found.depth)
    shares = f"{found.plain:7.1%}{found.plain_known:7.1%}{found.plain_wrong:7.2%}{found.sky_known:7.2%}"
    return (
        f"{name:12}{score.points:9,}{right}{score.wrong:8.2%}{there}{score.empty:7.1%}{score.textured[1]:10.3f}   "
        f"{depth}{found.normal:8.1f}{shares}"
    )


def on_lakes(city: City, points: np.ndarray) -> str:
    """Return the share of water with points nearby, and the share of wrong points over it, as text."""
    plan = lay_out(CitySettings(extent=EXTENT, water=True, seed=LAKES))
    limit, seen, over = MIN_WRONG_FOOTPRINTS * city.footprint, [], []
    for lake in (block for block in plan.blocks if block.kind == "lake"):
        low, high = np.add(lake.low, SHORE), np.subtract(lake.high, SHORE)
        here = city.seen[((city.seen[:, :2] > low) & (city.seen[:, :2] < high)).all(axis=1)]
        level = np.median(here[:, 2])
        there = points[((points[:, :2] > low) & (points[:, :2] < high)).all(axis=1)]
        seen.append(Index(points).query(here[np.abs(here[:, 2] - level) < 0.1]).distances < limit)
        over.append(np.abs(there[:, 2] - level) > limit)
    kept, wrong = (float(np.mean(np.concatenate(of))) for of in (seen, over))
    return f"{'':12}of its lakes {kept:.1%} have points near, and of the points over them {wrong:.2%} are wrong"


def scored(city: City, work: Path) -> CloudScore:
    """Score the cloud of a workspace."""
    return score_cloud(city, read_cloud(work / "cloud.ply").points)


def cities(root: Path, names: Sequence[str], options: argparse.Namespace) -> None:
    """Create, reconstruct and score cities."""
    print(HEAD)
    for name in names:
        folder, work = root / name.replace(" ", ""), root / f"{name.replace(' ', '')}_work"
        if not folder.exists():
            make(folder, name, options)
        work.mkdir(exist_ok=True)
        reconstruct(folder, work)
        city = read_city(folder)
        print(row(name, city, scored(city, work), work / "work" / "plugin"), flush=True)
        if f"--seed {LAKES}" in CASES[name]:
            print(on_lakes(city, read_cloud(work / "cloud.ply").points), flush=True)


def what_is_missed(root: Path) -> None:
    """Print the properties of the missing textured surface."""
    city = read_city(root / "city")
    print(f"\n{'textured, visible in':24}{'share':>8}{'within 2':>10}{'of the missed':>15}")
    for name, found in recall_by_view(city, read_cloud(root / "city_work" / "cloud.ply").points).items():
        print(f"{name:24}{found.share:8.1%}{found.recall:10.3f}{found.missed:15.1%}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", default=",".join(CASES))
    parser.add_argument("--images", type=int, default=20)
    parser.add_argument("--size", default="480x320")
    parser.add_argument("--rig", default="oblique")
    parser.add_argument("--seed", type=int, default=5)
    parser.add_argument("--missed", action="store_true")
    parser.add_argument("--folder", type=Path, help="Folder that keeps all files; existing ones are used again.")
    options = parser.parse_args()
    print(setting())
    print(f"{options.images} images of {options.size}, rig {options.rig}, cities of {EXTENT} m, seed {options.seed}")
    with tempfile.TemporaryDirectory() as temporary:
        root = options.folder or Path(temporary)
        root.mkdir(parents=True, exist_ok=True)
        cities(root, options.cases.split(","), options)
        if options.missed:
            what_is_missed(root)


if __name__ == "__main__":
    main()
