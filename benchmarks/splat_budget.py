"""How few Gaussians are enough? python benchmarks/splat_budget.py

For each city, the budgets that `density=parsimonious` tries, one per row: score of the held-out photographs that select
the budget (PSNR in dB, or with `--select surface` the percentage of correct depths), its loss against the best with the
95 % interval over their blocks, CPU time of a step, size of the model, and accuracy of its surface. Then the selected
budget, trained to the end, against the maximum number of Gaussians at equal steps: PSNR of 8 blocks of photographs that
neither was trained on, and the difference with its standard error over the blocks. With one
thread: OMP_NUM_THREADS=1.
"""

import argparse
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import torch
from measure import setting

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from splat_cities import CASES, EXTENT, CloudScore, city, score_cloud
from splat_train import Inputs, prepare

from pcbench.scenes.splits import split_for_selection
from reconstructors.splat import extract
from reconstructors.splat.curve import CRITERIA, Budget, CriterionName, Loss
from reconstructors.splat.density import Density
from reconstructors.splat.model import Gaussians
from reconstructors.splat.parsimony import Parsimonious, score_surface, score_views
from reconstructors.splat.photographs import Pyramid
from reconstructors.splat.splat import initial_model
from reconstructors.splat.train import Schedule, Training, evaluate

SH_DEGREE = 2


class SurfaceMeasuringDensity(Parsimonious):
    """Parsimonious densification that also measures the surface of each budget."""

    def __init__(
        self, inputs: Inputs, held_out_views: list[list[Pyramid]], max_gaussians: int, select: CriterionName
    ) -> None:
        score = score_views if select == "views" else score_surface(inputs.supervision.depths)
        super().__init__(held_out_views, max_gaussians // 4, max_gaussians, CRITERIA[select], score)
        self.inputs = inputs
        self.scores: list[CloudScore] = []
        self.measuring_s = 0.0  # CPU time

    def _evaluate(self, training: Training) -> Budget:
        budget = super()._evaluate(training)
        start = time.process_time()
        self.scores.append(score_model(self.inputs, training.model))
        self.measuring_s += time.process_time() - start
        return budget


def score_model(inputs: Inputs, model: Gaussians) -> CloudScore:
    """Score the surface of a model."""
    return score_cloud(inputs.city.truth, extract.surface(model, inputs.frame, inputs.cameras).points)


def train(
    inputs: Inputs, count: int, steps: int, density: Density[Training], training_pyramids: list[Pyramid]
) -> tuple[Training, float]:
    """Train a model; return the training and its CPU seconds."""
    schedule = Schedule(steps=steps, sh_degree=SH_DEGREE)
    training = Training(
        initial_model(inputs.dense.cloud, inputs.frame, count, 0),
        training_pyramids,
        schedule,
        density,
        inputs.supervision,
    )
    start = time.process_time()
    training.run(steps)
    return training, time.process_time() - start


def compare(inputs: Inputs, count: int, steps: int, select: CriterionName) -> None:
    """Compare the selected budget with the initial one and print both."""
    names = [pyramid[0].name for pyramid in inputs.shown]
    pyramid_by_name = dict(zip(names, inputs.shown, strict=True))
    selection_split = split_for_selection(names, {name: inputs.cameras[name].position for name in names})
    density = SurfaceMeasuringDensity(
        inputs, [[pyramid_by_name[name] for name in block] for block in selection_split.blocks], count, select
    )
    selected_training, seconds = train(
        inputs, density.start_gaussians, steps, density, [pyramid_by_name[name] for name in selection_split.train]
    )
    seconds -= density.measuring_s
    curve = density.curve
    assert curve is not None
    print(f"{'N':>9}{'degree':>8}{'score':>8}{'loss':>22}{'ms per step':>13}{'MB':>7}{'accuracy, m':>13}{'F-score':>9}")
    for budget, score in zip(curve.budgets, density.scores, strict=True):
        loss = Loss.of(budget, curve.best)
        interval = f"{loss.mean:.2f} ({loss.low:.2f}, {loss.high:.2f})"
        print(
            f"{budget.gaussians:9,}{budget.degree:8}{budget.means[0]:8.2f}{interval:>22}"
            f"{budget.step_ms:13.1f}{4e-6 * budget.numbers:7.1f}{score.accuracy:13.3f}{score.fscore_seen:9.3f}"
            f"{'  chosen' if budget is curve.selected else ''}"
        )
    print(curve.sentence)
    rows = [("chosen", selected_training, seconds), ("fixed", *train(inputs, count, steps, Density(), inputs.shown))]
    held_out = {photograph.name: photograph for photograph in inputs.held_out}
    blocks = [[held_out[name] for name in block] for block in inputs.split.blocks]
    psnr = [
        np.array([np.mean([score.psnr for score in evaluate(training.model, block)]) for block in blocks])
        for _, training, _ in rows
    ]
    for (name, training, seconds), scores in zip(rows, psnr, strict=True):
        model, score = training.model, score_model(inputs, training.model)
        print(
            f"{name:9}{len(model):9,} of degree {model.degree}: {scores.mean():.2f} dB held out, {seconds:.0f} CPU s,"
            f" surface {score.accuracy:.3f} m, F-score {score.fscore_seen:.3f}"
        )
    gain = psnr[0] - psnr[1]
    error = gain.std(ddof=1) / np.sqrt(len(gain))
    print(f"chosen - fixed: {gain.mean():+.2f} ± {error:.2f} dB over {len(gain)} blocks", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", default=";".join(CASES), help="cases of splat_cities, separated by semicolons")
    parser.add_argument("--images", type=int, default=64)
    parser.add_argument("--size", default="240x136")
    parser.add_argument("--gaussians", type=int, default=60_000)
    parser.add_argument("--steps", type=int, default=900)
    parser.add_argument("--select", default="views", choices=CRITERIA, help="what the budgets are compared by")
    parser.add_argument("--folder", type=Path, help="folder that keeps the cities; existing ones are used again")
    options = parser.parse_args()
    print(f"{setting()}; {options.gaussians:,} Gaussians, {options.steps:,} steps, degree {SH_DEGREE}")
    with tempfile.TemporaryDirectory() as temporary:
        for case in options.cases.split(";"):
            label = case.replace(", ", "_").replace(" ", "_")
            scored_city = city((options.folder or Path(temporary)) / label, case, options.images, options.size)
            work = Path(temporary) / f"{label}.work"
            work.mkdir()
            inputs = prepare(scored_city, work, torch.device("cpu"))
            print(f"\n{options.images} images of {options.size} of a city of {EXTENT} m ({case}); {inputs.split.words}")
            compare(inputs, options.gaussians, options.steps, options.select)


if __name__ == "__main__":
    main()
