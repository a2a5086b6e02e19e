"""Training of Gaussians by time and by their number: python benchmarks/splat_train.py

Each row has a number of Gaussians and of steps, initialised from the `mvs` cloud of a synthetic city: CPU seconds of
training (wall time on a GPU), PSNR of the training images and of 8 blocks of held-out images, and the surface against
the exact truth: mean distance from its points (accuracy) and from what at least three cameras see to it (complete), in
metres, and F-score over that part at two pixel footprints. `--gsplat` also trains with gsplat's rasterizer (on a GPU,
if it is installed). With one thread: OMP_NUM_THREADS=1.
"""

import argparse
import importlib.util
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import torch
from measure import setting

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from splat_cities import CASES, EXTENT, City, city, score_cloud
from splat_contestants import RasterizerByAutograd, draw_by_gsplat
from torch import Tensor

from pcbench.geometry.cameras import Camera
from pcbench.plugins import Reconstruction
from pcbench.scenes.splits import Split, hold_out
from reconstructors.mvs.mvs import MAPS
from reconstructors.mvs.views import pinhole, view_stage
from reconstructors.splat import extract
from reconstructors.splat.density import Density
from reconstructors.splat.interface import GaussianTensors
from reconstructors.splat.model import LocalFrame
from reconstructors.splat.photographs import Photograph, Pyramid, read_photographs
from reconstructors.splat.recipes import choose_recipe
from reconstructors.splat.splat import INITIAL_MVS, initial_model
from reconstructors.splat.supervision import Supervision, read_supervision
from reconstructors.splat.train import Training, evaluate
from reconstructors.splat.view import View


class Inputs(NamedTuple):
    """Inputs that all runs share."""

    city: City
    cameras: dict[str, Camera]
    dense: Reconstruction
    frame: LocalFrame
    split: Split
    shown: list[Pyramid]
    held_out: list[Photograph]
    supervision: Supervision


class Contestant(NamedTuple):
    """How to train: with depth supervision or not, and with which rasterizer (None for our own)."""

    name: str
    supervised: bool
    draw: Callable[[GaussianTensors, View], Tensor] | None = None


class Run(NamedTuple):
    """Results of one training."""

    seconds: float
    trained_on: float
    held_out: float
    accuracy: float
    seen: float
    fscore_seen: float


def prepare(scored_city: City, work: Path, device: torch.device) -> Inputs:
    """Reconstruct the dense cloud and read the photographs."""
    scene = scored_city.scene
    dense = INITIAL_MVS.reconstruct(scene, work)
    cameras = {name: pinhole(camera, 1.0) for name, camera in dense.cameras.items()}
    frame = LocalFrame.of(list(cameras.values()))
    split = hold_out(list(cameras), "blocks", {name: camera.position for name, camera in cameras.items()})
    folders = {name: view_stage(scene, dense.cameras[name], camera, work) for name, camera in cameras.items()}
    pyramids = read_photographs(folders, cameras, frame, 3, device)
    training_pyramids = [pyramid for pyramid in pyramids if pyramid[0].name in split.train]
    held_out = [pyramid[0] for pyramid in pyramids if pyramid[0].name in split.test]
    supervision = read_supervision(work / MAPS, training_pyramids, frame.unit)
    return Inputs(scored_city, cameras, dense, frame, split, training_pyramids, held_out, supervision)


def train(inputs: Inputs, contestant: Contestant, count: int, steps: int, seed: int, device: torch.device) -> Run:
    """Train a model with the rates that `splat` uses, and score it."""
    supervised = contestant.supervised
    training = Training(
        initial_model(inputs.dense.cloud, inputs.frame, count, seed).to(device),
        inputs.shown,
        replace(choose_recipe("fixed", supervised=supervised).schedule, steps=steps, sh_degree=2, seed=seed),
        Density(),
        inputs.supervision if supervised else None,
    )
    if contestant.draw is not None:
        training._rasterizer = RasterizerByAutograd(contestant.draw)
    clock = time.process_time if device.type == "cpu" else time.perf_counter
    start = clock()
    training.run(steps)
    float(training.model.means.sum())  # synchronises with the GPU
    seconds = clock() - start
    score = score_cloud(inputs.city.truth, extract.surface(training.model, inputs.frame, inputs.cameras).points)
    return Run(
        seconds,
        statistics.fmean(map(float, training.psnr)),
        statistics.fmean(score.psnr for score in evaluate(training.model, inputs.held_out)),
        score.accuracy,
        score.seen,
        score.fscore_seen,
    )


def summary(runs: list[Run]) -> str:
    """Return medians and half of the range over the seeds, as text."""
    cells = []
    for values, digits in zip(zip(*runs, strict=True), (0, 2, 2, 3, 3, 3), strict=True):
        half_range = (max(values) - min(values)) / 2
        cells.append(f"{statistics.median(values):8.{digits}f} ± {half_range:<5.{digits}f}")
    return "".join(cells)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--case", default=next(iter(CASES)), choices=CASES)
    parser.add_argument("--images", type=int, default=64)
    parser.add_argument("--size", default="240x136")
    parser.add_argument("--counts", default="5000,15000,45000", help="numbers of Gaussians, with the most steps")
    parser.add_argument("--steps", default="300,600,1200", help="numbers of steps, with the middle count")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    parser.add_argument(
        "--gsplat", action="store_true", help="also train with gsplat's rasterizer, without supervision"
    )
    parser.add_argument("--folder", type=Path, help="folder that keeps the city; existing files are used again")
    options = parser.parse_args()
    contestants = [Contestant("pcbench", True)]
    if options.gsplat:
        if not importlib.util.find_spec("gsplat") or options.device == "cpu":
            parser.error("--gsplat takes a GPU (--device cuda) and the package gsplat")
        contestants += [Contestant("unsupervised", False), Contestant("gsplat", False, draw_by_gsplat)]
    counts, steps = ([int(word) for word in words.split(",")] for words in (options.counts, options.steps))
    middle_count, max_steps = counts[len(counts) // 2], steps[-1]
    budgets = sorted({(middle_count, step_count) for step_count in steps} | {(count, max_steps) for count in counts})
    print(f"{setting()}; {options.device}")
    with tempfile.TemporaryDirectory() as temporary:
        folder = (options.folder or Path(temporary)) / options.case.replace(", ", "_").replace(" ", "_")
        scored_city = city(folder, options.case, options.images, options.size)
        work = Path(temporary) / "work"
        work.mkdir()
        device = torch.device(options.device)
        inputs = prepare(scored_city, work, device)
        print(
            f"{options.images} images of {options.size} of a city of {EXTENT} m ({options.case}), held out:"
            f" {inputs.split.words}; {options.seeds} seeds: median ± half the range"
        )
        clock = "CPU s" if options.device == "cpu" else "wall s"
        names = (clock, "PSNR", "held out", "accuracy", "complete", "F-score")
        print(f"{'':13}{'N':>6}{'steps':>6}" + "".join(f"{name:>9}{'':7}" for name in names))
        for contestant in contestants:
            for count, step_count in budgets:
                runs = [train(inputs, contestant, count, step_count, seed, device) for seed in range(options.seeds)]
                print(f"{contestant.name:13}{count:6}{step_count:6}{summary(runs)}", flush=True)


if __name__ == "__main__":
    main()
