"""Ways to start, to grow and to expose Gaussians, side by side: python benchmarks/splat_variants.py --folder FOLDER

Each row is a variant in one scene: CPU seconds of training, number of Gaussians, PSNR and SSIM of 8 held-out blocks,
the same PSNR with the brightness of each image fitted, and the surface against the exact truth (mean distance in
metres, F-score over what three cameras see at two pixel footprints); with several seeds, means and half the ranges.
Variants have the same steps; `parsimonious` takes more for its trials. In a scene with `exposures`, each photograph and
each of its channels is darkened at random, by factors of 0.65 to 1. FOLDER keeps the cities, their dense and sparse
clouds, and the results: a run that was stopped goes on. With one thread: OMP_NUM_THREADS=1.
"""

import argparse
import json
import pickle
import statistics
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from measure import setting

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from splat_cities import EXTENT, city, score_cloud
from splat_train import Inputs, prepare

from pcbench import Cloud
from pcbench.scenes.splits import split_for_selection
from reconstructors.sfm.sfm import ColmapSfm
from reconstructors.splat import extract
from reconstructors.splat.density import Classic, Density, NumberGrowth
from reconstructors.splat.exposure import Exposure
from reconstructors.splat.parsimony import Parsimonious
from reconstructors.splat.photographs import Photograph, Pyramid
from reconstructors.splat.recipes import choose_recipe
from reconstructors.splat.splat import initial_model
from reconstructors.splat.start import points_in_bounds, points_in_view
from reconstructors.splat.train import Training, evaluate

SCENES = "circles, seed 11;oblique, half texture;grid, hard;oblique, half texture; exposures"
MIN_GAIN, MIN_CHANNEL_GAIN = 0.7, 0.93  # of `exposures`
COLUMNS = ("CPU s", "Gaussians", "PSNR", "fitted", "SSIM", "surface", "F-score")
DECIMALS = (1, 0, 2, 2, 4, 3, 3)


class Growing(Density[Training]):
    """Growth to a number of Gaussians in the first half of the steps."""

    needs_screen_gradients = True

    def __init__(self, target: int, steps: int) -> None:
        self._growth = NumberGrowth(target, steps // 10, steps // 2, rounds=8)

    def control(self, training: Training) -> None:
        self._growth.control(training)


class Options(NamedTuple):
    """Settings that all variants share."""

    steps: int
    gaussians: int
    seed: int


class Case(NamedTuple):
    """A scene with its sparse points."""

    inputs: Inputs
    sparse: Cloud


def start(case: Case, options: Options, density: Density[Training], shown: list[Pyramid], source: str) -> Training:
    """Return a training at its start from points of `sfm` or `mvs`, with depth supervision from `mvs`, or at random."""
    inputs = case.inputs
    count = density.start_gaussians if isinstance(density, Parsimonious) else options.gaussians
    if source in ("random", "cameras") and isinstance(density, Classic | Growing):
        count //= 4
    cloud = inputs.dense.cloud if source == "mvs" else case.sparse
    if source == "random":
        cloud = Cloud(points_in_bounds(cloud.points, count, options.seed))
    elif source == "cameras":
        cloud = Cloud(points_in_view(list(inputs.cameras.values()), count, options.seed))
    recipe = choose_recipe("classic" if isinstance(density, Classic) else "fixed", supervised=source == "mvs")
    return Training(
        initial_model(cloud, inputs.frame, count, options.seed),
        shown,
        replace(recipe.schedule, steps=options.steps, sh_degree=2, seed=options.seed, plateau=None),
        density,
        inputs.supervision if source == "mvs" else None,
    )


def classic(case: Case, options: Options, source: str) -> Training:
    """Return a training with the rules of Kerbl et al."""
    density = Classic(refine_start=100, refine_interval=50, max_gaussians=options.gaussians)
    return start(case, options, density, case.inputs.shown, source)


def growing(case: Case, options: Options, source: str) -> Training:
    """Return a training that grows to the maximum by halving Gaussians."""
    return start(case, options, Growing(options.gaussians, options.steps), case.inputs.shown, source)


def fixed(case: Case, options: Options, source: str) -> Training:
    """Return a training with a fixed number of Gaussians."""
    return start(case, options, Density(), case.inputs.shown, source)


def exposed(case: Case, options: Options, source: str) -> Training:
    """Return a training that grows and fits the exposures."""
    training = growing(case, options, source)
    training.exposure = Exposure(case.inputs.split.train)
    return training


def parsimonious(case: Case, options: Options, source: str) -> Training:
    """Return a training that chooses the number of Gaussians."""
    inputs = case.inputs
    pyramids = {pyramid[0].name: pyramid for pyramid in inputs.shown}
    split = split_for_selection([*pyramids], {name: inputs.cameras[name].position for name in pyramids})
    blocks = [[pyramids[name] for name in block] for block in split.blocks]
    density = Parsimonious(blocks, options.gaussians // 4, options.gaussians)
    return start(case, options, density, [pyramids[name] for name in split.train], source)


METHODS: Mapping[str, Callable[[Case, Options, str], Training]] = {
    method.__name__: method for method in (classic, growing, exposed, fixed, parsimonious)
}


def prepare_case(folder: Path, scene: str, images: int, size: str) -> Case:
    """Return a scene, synthesized and reconstructed unless the folder has it."""
    case, _, change = scene.partition("; ")
    label = case.replace(", ", "_").replace(" ", "_")
    prepared = folder / f"{label}_{images}_{size}.pickle"
    if not prepared.exists():
        scored_city = city(folder / label, case, images, size)
        work = folder / f"{label}.work"
        (work / "sparse").mkdir(parents=True, exist_ok=True)
        inputs = prepare(scored_city, work, torch.device("cpu"))
        sparse = ColmapSfm(poses="given").reconstruct(scored_city.scene, work / "sparse").cloud
        prepared.write_bytes(pickle.dumps((inputs, sparse)))
    inputs, sparse = pickle.loads(prepared.read_bytes())
    if change == "exposures":
        rng = np.random.default_rng(5)
        gains = {
            name: torch.from_numpy(rng.uniform(MIN_GAIN, 1) * rng.uniform(MIN_CHANNEL_GAIN, 1, 3)).float()
            for name in inputs.cameras
        }
        inputs = inputs._replace(
            shown=[[darken(p, gains[p.name]) for p in pyramid] for pyramid in inputs.shown],
            held_out=[darken(p, gains[p.name]) for p in inputs.held_out],
        )
    return Case(inputs, sparse)


def darken(photograph: Photograph, gain: torch.Tensor) -> Photograph:
    """Return a photograph times a gain per channel (3,)."""
    return photograph._replace(color=(photograph.color * gain).round().to(torch.uint8))


def measure(case: Case, variant: str, options: Options) -> dict[str, object]:
    """Train a variant, `METHOD from START`, and return its figures."""
    method, source = variant.split(" from ")
    training = METHODS[method](case, options, source)
    begin = time.process_time()
    training.run(options.steps)
    seconds, inputs, model = time.process_time() - begin, case.inputs, training.model
    scores, fitted = (evaluate(model, inputs.held_out, fit_exposure=fit) for fit in (False, True))
    cloud = score_cloud(inputs.city.truth, extract.surface(model, inputs.frame, inputs.cameras).points)
    psnr, fitted_psnr = (statistics.fmean(s.psnr for s in each) for each in (scores, fitted))
    ssim = statistics.fmean(s.ssim for s in scores)
    figures = (seconds, len(model), psnr, fitted_psnr, ssim, cloud.accuracy, cloud.fscore_seen)
    curve = getattr(training.density, "curve", None)
    return {"figures": figures, "decision": "" if curve is None else curve.sentence}


def line(rows: list[dict[str, object]]) -> str:
    """Return the means of the seeds, with half the ranges if there are several."""
    cells = []
    for values, decimals in zip(zip(*(row["figures"] for row in rows), strict=True), DECIMALS, strict=True):
        spread = f" ±{(max(values) - min(values)) / 2:.{decimals}f}" if len(rows) > 1 else ""
        cells.append(f"{statistics.fmean(values):,.{decimals}f}{spread}")
    return "".join(f"{cell:>16}" for cell in cells)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", default=SCENES, help="cases of splat_cities separated by semicolons; see above")
    parser.add_argument(
        "--variants", default="classic from sfm,growing from sfm,parsimonious from sfm,fixed from mvs", help="by commas"
    )
    parser.add_argument("--images", type=int, default=40)
    parser.add_argument("--size", default="320x180")
    parser.add_argument("--steps", type=int, default=800)
    parser.add_argument("--gaussians", type=int, default=20_000)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--folder", type=Path, required=True, help="folder that keeps cities and results")
    options = parser.parse_args()
    options.folder.mkdir(exist_ok=True)
    results = options.folder / "results.jsonl"
    rows = [json.loads(text) for text in results.read_text().splitlines()] if results.exists() else []
    print(f"{setting()}; {options.steps} steps, at most {options.gaussians:,} Gaussians, {options.seeds} seeds")
    print(f"{options.images} images of {options.size}, cities of {EXTENT} m, 8 blocks of 2 held out")
    for scene in options.scenes.replace("; exposures", "+exposures").split(";"):
        print(f"\n{scene.replace('+', '; ')}\n{'':28}{''.join(f'{name:>16}' for name in COLUMNS)}")
        case = None
        for variant in options.variants.split(","):
            same = []
            for seed in range(options.seeds):
                key = [scene, variant, seed, options.steps, options.gaussians, options.images, options.size]
                row = next((row for row in rows if row["key"] == key), None)
                if row is None:
                    case = case or prepare_case(options.folder, scene.replace("+", "; "), options.images, options.size)
                    run = Options(options.steps, options.gaussians, seed)
                    row = {"key": key, **measure(case, variant, run)}
                    with results.open("a") as file:
                        file.write(json.dumps(row) + "\n")
                same.append(row)
            print(f"{variant:28}{line(same)}", flush=True)
            for row in same:
                if row["decision"]:
                    print(f"  {row['decision']}")


if __name__ == "__main__":
    main()
