"""The number of Gaussians that a scene needs: the smallest that no other beats in held-out error by more than noise."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from reconstructors.splat.curve import CRITERIA, Budget, Criterion, Curve, select_budget
from reconstructors.splat.density import Density, NumberGrowth
from reconstructors.splat.train import Snapshot, evaluate

if TYPE_CHECKING:
    from torch import Tensor

    from reconstructors.splat.photographs import Photograph, Pyramid
    from reconstructors.splat.train import Training

# Shares of the steps: before the first trial, of each trial, and at which the selected model resumes training.
_WARMUP_SHARE, _TRIAL_SHARE, _RESTART_SHARE = 0.5, 0.08, 0.3
_WARMUP_GROWTH, _FINAL_GROWTH = (0.1, 0.4), (0.3, 0.5)  # shares of the steps between which the number grows
_ROUNDS = 10  # in which the number grows before and after the trials
_BUDGET_RATIO = 2  # between the numbers of Gaussians of two trials
_MIN_GAUSSIANS = 100  # minimum number of Gaussians of a trial
_MAX_REJECTED_BUDGETS = 2  # rejected budgets in a row after which no smaller one is tried
_MAX_DEPTH_ERROR_PX = 2.0  # error of a correct depth, in pixel footprints

Score = Callable[["Training", "Sequence[Photograph]"], tuple[float, ...]]  # of a model on the photographs of a block


def score_views(training: Training, photographs: Sequence[Photograph]) -> tuple[float, ...]:
    """Return the mean PSNR of photographs in dB, and their mean SSIM."""
    scores = evaluate(training.model, photographs, training.background.color[0])
    return float(np.mean([score.psnr for score in scores])), float(np.mean([score.ssim for score in scores]))


def score_surface(depths: Mapping[str, Sequence[Tensor]]) -> Score:
    """Return the score of the criterion `surface`: the percentage of known depths that the median depth meets.

    A depth is correct if its error is at most two pixel footprints on the surface: the depth over the focal length.

    Args:
        depths: known depths by image name, as in `Supervision`; every photograph to be scored needs at least one.
    """

    def score(training: Training, photographs: Sequence[Photograph]) -> tuple[float, ...]:
        correct = counted = 0
        for photograph in photographs:
            target = depths[photograph.name][0]
            rendered = training.model.render_geometry(photograph.view).median_depth
            assert rendered is not None
            max_error = target * (_MAX_DEPTH_ERROR_PX / photograph.view.fx)
            correct += int(((rendered - target).abs() <= max_error)[target > 0].sum())
            counted += int((target > 0).sum())
        return (100 * correct / counted,)

    return score


class _Trial(NamedTuple):
    budget: Budget
    start: Snapshot  # the model before the steps of the trial
    target: int  # the number of Gaussians to which the trial grows


class Parsimonious(Density["Training"]):
    """Double or halve the number of Gaussians, then lower the degree of the spherical harmonics, by held-out quality.

    For half of the steps, training grows to `start_gaussians`, if it has fewer. Then follow trials of other sizes, from
    the same state and with the same number of further steps, rates and photographs. The first has the same number. The
    next ones have two, four, ... times as many, up to `max_gaussians`, as long as each is better on the held-out blocks
    by more than noise. If twice as many are not, trials follow that keep the half with the largest contributions to
    the photographs, the half of these, and so on. At last the degree of the spherical harmonics is lowered by one,
    repeatedly. The smallest model that no other beats by more than noise is then trained to the end on all photographs.

    Args:
        held_out_blocks: at least two blocks of photographs, which `Training` must not have at the start.
        start_gaussians: number of Gaussians of the first trial.
        max_gaussians: maximum number of Gaussians.
        criterion: the scores by which models are compared.
        score: returns these scores of a model on the photographs of a block.
    """

    needs_screen_gradients = True

    def __init__(
        self,
        held_out_blocks: Sequence[Sequence[Pyramid]],
        start_gaussians: int,
        max_gaussians: int,
        criterion: Criterion = CRITERIA["views"],
        score: Score = score_views,
    ) -> None:
        if len(held_out_blocks) < 2:
            raise ValueError(f"expected at least two blocks of held-out photographs, got {len(held_out_blocks)}")
        self._held_out_blocks = held_out_blocks
        self.start_gaussians = start_gaussians
        self._max_gaussians = max_gaussians
        self._criterion = criterion
        self._score = score
        self._trials: list[_Trial] = []
        self._trial_start: Snapshot | None = None  # at the start of the current trial
        self._target = start_gaussians  # number of Gaussians to which the training grows now
        self._degree_limit: int | None = None  # of the spherical harmonics, once it is below that of the schedule
        self._timer: tuple[int, float] | None = None  # step and CPU time at the start of the current trial
        self.curve: Curve | None = None

    def control(self, training: Training) -> None:
        """Grow, and start, evaluate and select trials, when they are due."""
        steps = training.schedule.steps
        self._growth(steps).control(training)
        if self.curve is not None or training.step < max(1, round(_WARMUP_SHARE * steps)):
            return
        if self._trial_start is None:
            self._trial_start, self._target = training.snapshot(), len(training.model)
        if self._timer is None:
            self._timer = training.step, time.process_time()
        due = self._trial_start.step + max(1, round(_TRIAL_SHARE * steps))
        if training.step < min(due, steps):
            return
        self._trials.append(_Trial(self._evaluate(training), self._trial_start, self._target))
        if due <= steps and self._start_next_trial(training):
            self._timer = None
        else:
            self._choose(training)

    def is_settled(self, training: Training) -> bool:
        """Return whether a model has been selected and has all of its Gaussians."""
        return self.curve is not None and training.step >= _FINAL_GROWTH[1] * training.schedule.steps

    def _growth(self, steps: int) -> NumberGrowth:
        """Return the growth of the current part of the training: the warm-up, a trial, or the rest."""
        if (start := self._trial_start) is not None:
            rounds = 1 + math.ceil(math.log2(max(1.0, self._target / len(start.model))))
            return NumberGrowth(self._target, start.step, start.step + max(1, round(_TRIAL_SHARE * steps)) // 2, rounds)
        first, last = _WARMUP_GROWTH if self.curve is None else _FINAL_GROWTH
        return NumberGrowth(self._target, round(first * steps), round(last * steps), _ROUNDS)

    def _evaluate(self, training: Training) -> Budget:
        model = training.model
        assert self._timer is not None
        first_step, start = self._timer
        step_ms = 1000 * (time.process_time() - start) / max(1, training.step - first_step)
        scores = [self._score(training, [pyramid[0] for pyramid in block]) for block in self._held_out_blocks]
        return Budget(len(model), model.degree, tuple(zip(*scores, strict=True)), step_ms)

    def _select(self) -> int:
        """Return the index of the selected trial."""
        return select_budget([trial.budget for trial in self._trials], self._criterion)

    def _start_next_trial(self, training: Training) -> bool:
        """Set up the next model; return False if there is none to try."""
        trials, chosen = self._trials, self._trials[self._select()]
        first, last = trials[0], trials[-1]
        lowers_degree = last.budget.degree < first.budget.degree
        if lowers_degree and chosen is not last:
            return False
        grows = all(trial.target >= first.target for trial in trials) and not lowers_degree
        more = min(_BUDGET_RATIO * last.target, self._max_gaussians)
        if grows and chosen is last and more > last.target:
            self._begin(training, first.start, more)
            return True
        smallest = min(trials, key=lambda trial: trial.target)
        fewer = smallest.target // _BUDGET_RATIO
        rejected = sum(trial.target < chosen.target for trial in trials)
        shrinks = chosen.target <= first.target and not lowers_degree
        if shrinks and fewer >= _MIN_GAUSSIANS and rejected < _MAX_REJECTED_BUDGETS:
            training.return_to(smallest.start)
            contributions = training.contributions()
            training.keep(contributions.argsort(descending=True, stable=True)[:fewer].sort().values)
            self._begin(training, training.snapshot(), fewer)
            return True
        if chosen.budget.degree == 0:
            return False
        training.return_to(chosen.start)
        self._limit_degree(training, chosen.budget.degree - 1)
        self._begin(training, training.snapshot(), chosen.target)
        return True

    def _begin(self, training: Training, start: Snapshot, target: int) -> None:
        """Begin a trial that grows to a number of Gaussians."""
        training.return_to(start)
        self._trial_start, self._target = start, target

    def _limit_degree(self, training: Training, degree: int) -> None:
        self._degree_limit = degree
        training.limit_degree(degree)

    def _choose(self, training: Training) -> None:
        self.curve = Curve(tuple(trial.budget for trial in self._trials), self._criterion)
        trial = self._trials[self._select()]
        training.return_to(trial.start)
        training.step = round(_RESTART_SHARE * training.schedule.steps)
        self._limit_degree(training, trial.budget.degree)
        training.train_on(self._all_photographs(training))
        self._trials.clear()
        self._trial_start, self._target = None, trial.target

    def state(self) -> object:
        """Return the trials and the selection for a checkpoint."""
        trials = [(tuple(trial.budget), trial.start.to_tuple(), trial.target) for trial in self._trials]
        start = None if self._trial_start is None else self._trial_start.to_tuple()
        curve = None if self.curve is None else [tuple(budget) for budget in self.curve.budgets]
        return {
            "begun": start,
            "target": self._target,
            "degree": self._degree_limit,
            "kept": trials,
            "curve": curve,
        }

    def restore(self, training: Training, state: Any) -> None:
        """Continue from a checkpoint."""
        self._target, self._timer = state["target"], None
        self._trial_start = None if state["begun"] is None else Snapshot.from_tuple(state["begun"])
        self._trials = [
            _Trial(Budget(*budget), Snapshot.from_tuple(start), target) for budget, start, target in state["kept"]
        ]
        if (limit := state["degree"]) is not None:
            self._limit_degree(training, limit)
        if state["curve"] is not None:
            self.curve = Curve(tuple(Budget(*budget) for budget in state["curve"]), self._criterion)
            training.train_on(self._all_photographs(training))

    def _all_photographs(self, training: Training) -> list[Pyramid]:
        return [*training.photographs, *(pyramid for block in self._held_out_blocks for pyramid in block)]
