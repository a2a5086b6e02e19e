"""Confidence of dense points against exact truth, and what dropping the least confident ones brings:
python benchmarks/mvs_confidence.py --seeds 201-203

Each row is a city: its scores with all points and with those that `mvs` keeps by default. Precision, recall and F-score
are at two pixel footprints, over the surface that at least three images show. The second table compares confidences
with the shares of points within two footprints. `--fit` prints the weights that fit these cities best.
"""

import argparse
import sys
import tempfile
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from measure import setting
from mvs_city import parse_seeds, pcbench

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from dense_cases import City, CloudScore, read_city, score_cloud

from pcbench.geometry.cloud import Cloud
from pcbench.geometry.neighbors import Index
from pcbench.io import read_cloud
from pcbench.io.colmap_model import read_colmap_cameras
from reconstructors.mvs.blocks import fused_files
from reconstructors.mvs.bundled import GEOMETRIC_FOLDER
from reconstructors.mvs.confidence import (
    CONFIDENCE,
    CUE_WEIGHTS,
    POINT_WEIGHTS,
    SCORE_LIMITS,
    depth_cues,
    keep_precise,
)
from reconstructors.mvs.filter import Criteria, filter_map
from reconstructors.mvs.flatten import NEIGHBORS
from reconstructors.mvs.fusion import VIEWS, read_visibility
from reconstructors.mvs.halos import remove_halos
from reconstructors.mvs.maps import read_map
from reconstructors.mvs.mvs import MAPS, DenseMvs
from reconstructors.mvs.views import VIEWS as PHOTOGRAPHS
from reconstructors.mvs.views import read_view

CASES = {
    "city": "--rig oblique --images 14",
    "repeated": "--rig oblique --images 14 --repeated",
    "hard": "--rig oblique --images 14 --hard",
    "wide": "--rig orbit --images 10",
    "texture 0": "--rig oblique --images 14 --texture 0",
    "texture 0, grid": "--rig grid --images 14 --texture 0",
}
BINS = np.append(np.arange(0, 1, 0.1), 1.0001)
MIN_BIN_SHARE = 0.005  # of the points of a case; smaller bins are not shown
FIT_POINTS = 4_000  # of each city


class Result(NamedTuple):
    """Result of a city.

    Args:
        cloud: all points.
        is_right: (N,) True for points within two footprints of the surface.
        scores: scores of all points, and of the kept ones.
        is_kept: (N,) True for the points that are kept.
    """

    cloud: Cloud
    is_right: np.ndarray
    scores: tuple[CloudScore, CloudScore]
    is_kept: np.ndarray

    @property
    def confidence(self) -> np.ndarray:
        """The confidences of all points."""
        return self.cloud.attributes[CONFIDENCE].astype(float)

    def columns(self) -> np.ndarray:
        """Return the numbers of a row: with all points and with the kept ones, and the shares of dropped points."""
        two = self.cloud.attributes[VIEWS] == 2
        pairs = []
        for score, kept in zip(self.scores, (np.ones_like(two), self.is_kept), strict=True):
            right = self.is_right[two & kept]
            pairs.append([score.precision[1], score.recall[1], score.fscore[1], score.wrong, np.mean(right)])
        dropped = [np.mean(~self.is_kept & self.is_right), np.mean(~self.is_kept & ~self.is_right)]
        return np.array([*np.transpose(pairs).ravel(), *dropped])


HEAD = (
    f"{'':22}{'precision':>14}{'recall':>14}{'F-score':>14}{'wrong':>16}{'two images':>14}{'dropped':>16}\n"
    f"{'':22}{'all':>7}{'kept':>7}{'all':>7}{'kept':>7}{'all':>7}{'kept':>7}{'all':>8}{'kept':>8}{'all':>7}{'kept':>7}"
    f"{'right':>8}{'wrong':>8}"
)


def make_row(name: str, columns: np.ndarray) -> str:
    """Return a row of the first table."""
    shares = [f"{value:7.3f}" for value in columns]
    percents = [f"{value:8.2%}" for value in columns]
    return f"{name:22}" + "".join([*shares[:6], *percents[6:8], *shares[8:10], *percents[10:]])


def measure(folder: Path, options: str, seed: int) -> tuple[City, Result]:
    """Create, reconstruct and score a city."""
    if not (folder / "city").exists():
        size = ["--size", "400x300", "--extent", 100, "--points", 200_000, "--quiet"]
        pcbench("synth", "city", "--out", folder / "city", *size, "--seed", seed, *options.split())
    if not (folder / "cloud.ply").exists():
        places = ["--out", folder / "cloud.ply", "--workspace", folder / "work", "--quiet"]
        pcbench("reconstruct", "mvs", folder / "city", *places, "--set", "precision=0")
    city, cloud = read_city(folder / "city"), read_cloud(folder / "cloud.ply", on_warning=lambda _: None)
    is_right = city.index.query(cloud.points).distances <= 2 * city.footprint
    kept = keep_precise(cloud, DenseMvs.precision)
    is_kept = cloud.attributes[CONFIDENCE] >= kept.attributes[CONFIDENCE].min()
    return city, Result(cloud, is_right, (score_cloud(city, cloud.points), score_cloud(city, kept.points)), is_kept)


def make_reliability(name: str, results: list[Result]) -> str:
    """Return a row of the second table: of each bin the mean confidence, the share of right points, and its size."""
    confidence = np.concatenate([result.confidence for result in results])
    is_right = np.concatenate([result.is_right for result in results])
    cells = []
    for low, high in pairwise(BINS):
        inside = (confidence >= low) & (confidence < high)
        shown = inside.mean() >= MIN_BIN_SHARE
        cells.append(f"{confidence[inside].mean():.2f} {is_right[inside].mean():.2f}" if shown else "")
    return f"{name:16}" + "".join(f"{cell:>11}" for cell in cells)


class Sample(NamedTuple):
    """Random points of a city, and the depths of these and of the points around them.

    Args:
        cues: (D, 5) cues of the depths.
        point: (D,) the number of the point that a depth belongs to.
        around: (N, 20) numbers of the nearest points of each random point; the first is the point itself.
        is_right: (N,) whether a random point is within two footprints of the surface.
    """

    cues: np.ndarray
    point: np.ndarray
    around: np.ndarray
    is_right: np.ndarray


def draw_sample(folder: Path, result: Result) -> Sample:
    """Draw random points of a city."""
    workspace = folder / "work" / "plugin"
    cameras = {camera.name: camera for camera in read_colmap_cameras(workspace / MAPS)}
    maps = {name: read_map(workspace / GEOMETRIC_FOLDER / name) for name in cameras}
    (fused,) = fused_files(workspace)
    fused_points = read_cloud(fused, on_warning=lambda _: None).points
    chosen = np.sort(np.random.default_rng(0).permutation(len(fused_points))[:FIT_POINTS])
    used, around = np.unique(Index(fused_points).query(fused_points[chosen], NEIGHBORS).indices, return_inverse=True)
    numbers = np.full(len(fused_points), -1)
    numbers[used] = np.arange(len(used))
    fused_points = fused_points + next(iter(cameras.values())).position.round()
    point, image = read_visibility(fused.with_name(f"{fused.name}.vis"))
    cues, points = [], []
    for k, (name, camera) in enumerate(cameras.items()):
        view = read_view(workspace / PHOTOGRAPHS / name, camera)
        with np.load(workspace / MAPS / name / "links.npz") as file:
            sources = [str(source) for source in file["sources"]]
        others = [(cameras[source], maps[source]) for source in sources]
        kept, agree = remove_halos(filter_map(camera, maps[name], others, Criteria(), view.valid), view.gray)
        number = np.full(kept.known.shape, -1)
        number[kept.known] = np.arange(np.count_nonzero(kept.known))
        here = point[(image == k) & (numbers[point] >= 0)]
        column, row = np.floor(camera.project(fused_points[here])[0]).astype(int).T
        height, width = number.shape
        depths = number[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)]
        cues.append(depth_cues(camera, kept, agree, [other for other, _ in others], view.gray)[depths[depths >= 0]])
        points.append(numbers[here[depths >= 0]])
    return Sample(
        np.concatenate(cues),
        np.concatenate(points),
        around.reshape(len(chosen), NEIGHBORS),
        result.is_right[chosen],
    )


def fit(samples: list[Sample]) -> np.ndarray:
    """Return the weights of the cues and of the scores (8,) with the largest likelihood, all cities alike."""
    from scipy.optimize import minimize

    def loss(weights: np.ndarray) -> tuple[float, np.ndarray]:
        total, gradient = 0.0, np.zeros_like(weights)
        constant, weight, weight_near = weights[5:]
        for cues, point, around, is_right in samples:
            of_depths, depths = 1 / (1 + np.exp(-cues @ weights[:5])), np.maximum(np.bincount(point), 1)
            scores = np.bincount(point, of_depths) / depths
            own, near = (np.clip(p, *SCORE_LIMITS) for p in (scores[around[:, 0]], scores[around].mean(axis=1)))
            odds, odds_near = np.log(own / (1 - own)), np.log(near / (1 - near))
            log_odds = constant + weight * odds + weight_near * odds_near
            total += float(np.mean(np.logaddexp(0, log_odds) - is_right * log_odds))
            errors = (1 / (1 + np.exp(-log_odds)) - is_right) / len(is_right)
            slopes = np.repeat(errors * weight_near / (near * (1 - near)) / NEIGHBORS, NEIGHBORS)
            of_scores = np.bincount(around.ravel(), slopes, len(scores))
            of_scores += np.bincount(around[:, 0], errors * weight / (own * (1 - own)), len(scores))
            gradient[:5] += ((of_scores / depths)[point] * of_depths * (1 - of_depths)) @ cues
            gradient[5:] += errors.sum(), errors @ odds, errors @ odds_near
        return total, gradient

    start = np.array([*CUE_WEIGHTS, *POINT_WEIGHTS])
    return np.asarray(minimize(loss, start, jac=True, method="L-BFGS-B").x)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=parse_seeds, default=[201, 202, 203], help="Seeds, such as 5 or 201-203.")
    parser.add_argument("--fit", action="store_true", help="Also fit all weights to these cities.")
    parser.add_argument("--folder", type=Path, help="Folder that keeps all files; existing ones are used again.")
    options = parser.parse_args()
    print(setting())
    print(f"cities of 100 m, images of 400x300, precision={DenseMvs.precision:g}\n{HEAD}")
    results: dict[str, list[Result]] = {}
    samples: list[Sample] = []
    with tempfile.TemporaryDirectory() as temporary:
        root = options.folder or Path(temporary)
        for case, city_options in CASES.items():
            for seed in options.seeds:
                folder = root / f"{case.replace(', ', '_').replace(' ', '')}{seed}"
                folder.mkdir(parents=True, exist_ok=True)
                _, result = measure(folder, city_options, seed)
                print(make_row(f"{case} {seed}", result.columns()), flush=True)
                results.setdefault(case, []).append(result)
                if options.fit:
                    samples.append(draw_sample(folder, result))
    print()
    for case, of_case in results.items():
        columns = np.array([result.columns() for result in of_case])
        print(make_row(f"{case}, median", np.median(columns, axis=0)))
    print("\nmean confidence, share within two footprints")
    print(f"{'':16}" + "".join(f"{f'{low:.1f} to {low + 0.1:.1f}':>11}" for low in BINS[:-1]))
    for case, of_case in results.items():
        print(make_reliability(case, of_case))
    print(make_reliability("all", [result for of_case in results.values() for result in of_case]))
    if options.fit:
        print("weights", np.round(fit(samples), 3))


if __name__ == "__main__":
    main()
