"""Selection of the number of Gaussians by the one-standard-error rule on held-out photographs.

Ever smaller models are trained and evaluated; the smallest one that is as good as the best is kept. What is good is a
`Criterion`: held-out views that are close to the photographs, or a surface that is close to known depths.

The rule is that of Breiman et al. 1984, section 3.4.3, applied to differences instead of scores: all models are
evaluated on the same photographs, and a hard photograph is hard for all models. Consecutive photographs are
correlated and form a block, so the standard error is computed from the means of the blocks.
"""

from __future__ import annotations

import csv
import io
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

from pcbench.scratch import atomic_write
from reconstructors.splat.density import Density
from reconstructors.splat.train import Snapshot, evaluate

if TYPE_CHECKING:
    from torch import Tensor

    from reconstructors.splat.photographs import Photograph, Pyramid
    from reconstructors.splat.train import Training

# Shares of the steps: before the first trial, of each trial, and at which the selected model resumes training.
_WARMUP_SHARE, _TRIAL_SHARE, _RESTART_SHARE = 0.5, 0.08, 0.3
_BUDGET_DIVISOR = 2  # each trial has half of the Gaussians of the one before
_MIN_GAUSSIANS = 100  # minimum number of Gaussians of a trial
_MAX_REJECTED_BUDGETS = 2  # rejected budgets in a row after which no smaller one is tried
_COLUMNS = ("gaussians", "degree", "step_cpu_ms")
_PARAMETERS_WITHOUT_SH = 11  # parameters of a Gaussian without its spherical harmonics
_MAX_DEPTH_ERROR_PX = 2.0  # error of a correct depth, in pixel footprints

CriterionName = Literal["views", "surface"]
Score = Callable[["Training", "Sequence[Photograph]"], float]  # of a model on the photographs of a block


class Criterion(NamedTuple):
    """The kind of score by which models are compared; higher is better.

    Attributes:
        name: name of the score.
        unit: its unit, in texts.
        column: its name and unit, in files.
        tolerance: loss that is accepted even if it is significant.
    """

    name: str
    unit: str
    column: tuple[str, str]
    tolerance: float = 0.0

    def text(self, score: float) -> str:
        """Return a score with its name and unit."""
        return f"{self.name} {score:.2f} {self.unit}"


# The F-score of the surface at two pixel footprints falls by one to two times what the share of correct depths loses.
CRITERIA: Mapping[CriterionName, Criterion] = {
    "views": Criterion("PSNR", "dB", ("psnr", "db")),
    "surface": Criterion("correct depths", "%", ("correct_depths", "percent"), tolerance=2.0),
}


def score_views(training: Training, photographs: Sequence[Photograph]) -> float:
    """Return the mean PSNR of photographs in dB."""
    return float(np.mean(evaluate(training.model, photographs, training.background.color[0])))


def score_surface(depths: Mapping[str, Sequence[Tensor]]) -> Score:
    """Return the score of the criterion `surface`: the percentage of known depths that the median depth meets.

    A depth is correct if its error is at most two pixel footprints on the surface: the depth over the focal length.

    Args:
        depths: known depths by image name, as in `Supervision`; every photograph to be scored needs at least one.
    """

    def score(training: Training, photographs: Sequence[Photograph]) -> float:
        correct = counted = 0
        for photograph in photographs:
            target = depths[photograph.name][0]
            rendered = training.model.render_geometry(photograph.view).median_depth
            assert rendered is not None
            max_error = target * (_MAX_DEPTH_ERROR_PX / photograph.view.fx)
            correct += int(((rendered - target).abs() <= max_error)[target > 0].sum())
            counted += int((target > 0).sum())
        return 100 * correct / counted

    return score


class Budget(NamedTuple):
    """Size, quality and cost of a trained model.

    Attributes:
        gaussians: number of Gaussians.
        degree: degree of their spherical harmonics.
        scores: score of the photographs of each held-out block.
        step_ms: CPU time of a training step with it, in milliseconds.
    """

    gaussians: int
    degree: int
    scores: tuple[float, ...]
    step_ms: float

    @property
    def mean(self) -> float:
        """Mean score over the blocks."""
        return float(np.mean(self.scores))

    @property
    def numbers(self) -> int:
        """Number of parameters of the model."""
        return self.gaussians * (_PARAMETERS_WITHOUT_SH + 3 * (self.degree + 1) ** 2)


class ScoreLoss(NamedTuple):
    """Loss of score of a budget relative to another: mean over the blocks, and its standard error."""

    mean: float
    error: float

    @classmethod
    def of(cls, budget: Budget, best: Budget) -> ScoreLoss:
        """Return what `budget` loses relative to `best`."""
        losses = np.subtract(best.scores, budget.scores)
        return cls(float(losses.mean()), float(losses.std(ddof=1) / np.sqrt(len(losses))))

    def is_acceptable(self, tolerance: float) -> bool:
        """Return whether the loss is at most one standard error or at most a tolerance."""
        return self.mean <= max(self.error, tolerance)


def find_best(budgets: Sequence[Budget]) -> Budget:
    """Return the budget with the highest score."""
    return max(budgets, key=lambda budget: budget.mean)


def select_budget(budgets: Sequence[Budget], tolerance: float = 0.0) -> int:
    """Return the index of the smallest budget that is as good as the best; needs at least two blocks.

    Such a budget is within one standard error of the best, or within the tolerance.
    """
    best = find_best(budgets)
    good = [
        k for k, budget in enumerate(budgets) if budget is best or ScoreLoss.of(budget, best).is_acceptable(tolerance)
    ]
    return min(good, key=lambda k: budgets[k].numbers)


@dataclass(frozen=True)
class Curve:
    """The budgets in the order in which they were tried, and the criterion of their scores."""

    budgets: tuple[Budget, ...]
    criterion: Criterion = CRITERIA["views"]

    @property
    def selected(self) -> Budget:
        """The smallest budget that is as good as the best."""
        return self.budgets[select_budget(self.budgets, self.criterion.tolerance)]

    @property
    def best(self) -> Budget:
        """The budget with the highest score."""
        return find_best(self.budgets)

    @property
    def sentence(self) -> str:
        """The choice and its reason, as a sentence for the notes."""
        selected, best, most = self.selected, self.best, self.budgets[0].gaussians
        unit, score = self.criterion.unit, self.criterion.text(self.selected.mean)
        size = f"{selected.gaussians:,} Gaussians with spherical harmonics of degree {selected.degree}"
        words = f"{size} are enough: {score} on held-out photographs"
        if selected is best and selected.gaussians == most:
            smaller = [budget for budget in self.budgets if budget.gaussians < most]
            if not smaller:
                return f"{size}: {score} on held-out photographs; fewer were not tried"
            fewer = find_best(smaller)
            return (
                f"all {most:,} Gaussians are needed: {score} on held-out photographs,"
                f" {fewer.mean:.2f} {unit} with {fewer.gaussians:,}; more may be better still"
            )
        if selected is best:
            return f"{words}; the other models have less"
        loss = ScoreLoss.of(selected, best)
        return (
            f"{words}, {loss.mean:.2f} ± {loss.error:.2f} {unit} below the best of {len(self.budgets)} models"
            f" ({best.gaussians:,} of degree {best.degree})"
        )

    def write(self, path: Path) -> None:
        """Write a CSV file with one line per budget."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        name, unit = self.criterion.column
        blocks = [f"block_{k}_{unit}" for k in range(1, len(self.budgets[0].scores) + 1)]
        scores = [f"{name}_{unit}", f"loss_{unit}", f"loss_standard_error_{unit}"]
        writer.writerow([*_COLUMNS, "bytes", *scores, "chosen", *blocks])
        best, selected = self.best, self.selected
        for budget in self.budgets:
            loss = ScoreLoss.of(budget, best)
            counts = (budget.gaussians, budget.degree, f"{budget.step_ms:.2f}", 4 * budget.numbers)
            judged = (f"{value:.4f}" for value in (budget.mean, loss.mean, loss.error))
            writer.writerow([*counts, *judged, int(budget is selected), *map(repr, budget.scores)])
        with atomic_write(path) as file:
            file.write(text.getvalue().encode())

    @classmethod
    def read(cls, path: Path) -> Curve:
        """Return the curve that `write` wrote."""
        head, *rows = csv.reader(path.read_text(encoding="utf-8").splitlines())
        criterion = next(each for each in CRITERIA.values() if "_".join(each.column) in head)
        first = head.index("chosen") + 1
        numbers = [[*map(float, row)] for row in rows]
        return cls(tuple(Budget(int(n[0]), int(n[1]), tuple(n[first:]), n[2]) for n in numbers), criterion)


class _Trial(NamedTuple):
    budget: Budget
    start: Snapshot  # the model before the steps of the trial


class Parsimonious(Density["Training"]):
    """Halve the number of Gaussians, then lower the degree of the spherical harmonics, as long as quality allows.

    All Gaussians are trained for half of the steps. Then smaller models follow: the first keeps the half with the
    largest contributions to the photographs, the next half of these, and so on. After that the degree of the spherical
    harmonics is lowered by one, repeatedly. Each model is trained for the same number of further steps, at the same
    rates and with the same photographs, and evaluated on the held-out blocks. The smallest model that is as good as the
    best is then trained to the end on all photographs.

    Args:
        held_out_blocks: at least two blocks of photographs, which `Training` must not have at the start.
        criterion: the kind of score by which models are compared.
        score: returns the score of a model on the photographs of a block.
    """

    def __init__(
        self,
        held_out_blocks: Sequence[Sequence[Pyramid]],
        criterion: Criterion = CRITERIA["views"],
        score: Score = score_views,
    ) -> None:
        if len(held_out_blocks) < 2:
            raise ValueError(f"expected at least two blocks of held-out photographs, got {len(held_out_blocks)}")
        self._held_out_blocks = held_out_blocks
        self._criterion = criterion
        self._score = score
        self._trials: list[_Trial] = []
        self._trial_start: Snapshot | None = None  # at the start of the current trial
        self._reduce_sh_degree = False  # whether trials lower the degree instead of the number
        self._timer: tuple[int, float] | None = None  # step and CPU time at the start of the current trial
        self.curve: Curve | None = None

    def control(self, training: Training) -> None:
        """Start, evaluate and select trials when they are due."""
        steps = training.schedule.steps
        if self.curve is not None or training.step < max(1, round(_WARMUP_SHARE * steps)):
            return
        if self._trial_start is None:
            self._trial_start = training.snapshot()
        if self._timer is None:
            self._timer = training.step, time.process_time()
        due = self._trial_start.step + max(1, round(_TRIAL_SHARE * steps))
        if training.step < min(due, steps):
            return
        self._trials.append(_Trial(self._evaluate(training), self._trial_start))
        if due <= steps and self._start_next_trial(training):
            self._trial_start, self._timer = training.snapshot(), None
        else:
            self._choose(training)

    def is_settled(self, training: Training) -> bool:
        """Return whether a model has been selected."""
        return self.curve is not None

    def _evaluate(self, training: Training) -> Budget:
        model = training.model
        assert self._timer is not None
        first_step, start = self._timer
        step_ms = 1000 * (time.process_time() - start) / max(1, training.step - first_step)
        scores = tuple(self._score(training, [pyramid[0] for pyramid in block]) for block in self._held_out_blocks)
        return Budget(len(model), model.degree, scores, step_ms)

    def _select(self) -> int:
        """Return the index of the selected trial."""
        return select_budget([trial.budget for trial in self._trials], self._criterion.tolerance)

    def _start_next_trial(self, training: Training) -> bool:
        """Set up the next, smaller model; return False if there is none to try."""
        selected, last = self._select(), len(self._trials) - 1
        if not self._reduce_sh_degree:
            fewer = len(training.model) // _BUDGET_DIVISOR
            if fewer >= _MIN_GAUSSIANS and last - selected < _MAX_REJECTED_BUDGETS:
                training.return_to(self._trials[last].start)
                contributions = training.contributions()
                training.keep(contributions.argsort(descending=True, stable=True)[:fewer].sort().values)
                return True
            self._reduce_sh_degree = True
        elif selected < last:
            return False
        degree = self._trials[selected].budget.degree
        if degree == 0:
            return False
        training.return_to(self._trials[selected].start)
        training.limit_degree(degree - 1)
        return True

    def _choose(self, training: Training) -> None:
        self.curve = Curve(tuple(trial.budget for trial in self._trials), self._criterion)
        trial = self._trials[self._select()]
        training.return_to(trial.start)
        training.step = round(_RESTART_SHARE * training.schedule.steps)
        training.limit_degree(trial.budget.degree)
        training.train_on(self._all_photographs(training))
        self._trials.clear()
        self._trial_start = None

    def state(self) -> object:
        """Return the trials and the selection for a checkpoint."""
        trials = [(tuple(trial.budget), trial.start.to_tuple()) for trial in self._trials]
        start = None if self._trial_start is None else self._trial_start.to_tuple()
        curve = None if self.curve is None else [tuple(budget) for budget in self.curve.budgets]
        return {"plainer": self._reduce_sh_degree, "begun": start, "kept": trials, "curve": curve}

    def restore(self, training: Training, state: Any) -> None:
        """Continue from a checkpoint."""
        self._reduce_sh_degree, self._timer = state["plainer"], None
        self._trial_start = None if state["begun"] is None else Snapshot.from_tuple(state["begun"])
        self._trials = [_Trial(Budget(*budget), Snapshot.from_tuple(start)) for budget, start in state["kept"]]
        if self._reduce_sh_degree:
            training.limit_degree(training.model.degree)
        if state["curve"] is not None:
            self.curve = Curve(tuple(Budget(*budget) for budget in state["curve"]), self._criterion)
            training.train_on(self._all_photographs(training))

    def _all_photographs(self, training: Training) -> list[Pyramid]:
        return [*training.photographs, *(pyramid for block in self._held_out_blocks for pyramid in block)]
