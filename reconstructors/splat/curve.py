"""Scores of models of several sizes on held-out photographs, and the choice of the smallest that suffices."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from pcbench.scenes.previews import SizeScore
from pcbench.scratch import atomic_write

CriterionName = Literal["views", "surface"]

_COLUMNS = ("gaussians", "degree", "step_cpu_ms", "bytes")
_PARAMETERS_WITHOUT_SH = 11  # parameters of a Gaussian without its spherical harmonics
_CONFIDENCE = 0.95


class Metric(NamedTuple):
    """A score of a model on held-out photographs; higher is better.

    Attributes:
        name: name of the score.
        unit: its unit, in texts.
        column: its name and unit, in files.
        decimals: decimals in texts.
        tolerance: loss that is accepted even if it is larger than its noise.
    """

    name: str
    unit: str
    column: str
    decimals: int
    tolerance: float = 0.0

    def text(self, score: float) -> str:
        """Return a score with its name and unit."""
        return f"{self.name} {self.amount(score)}"

    def amount(self, score: float) -> str:
        """Return a score or a difference of two with the unit."""
        return f"{score:.{self.decimals}f} {self.unit}".rstrip()


Criterion = tuple[Metric, ...]  # a model must not be worse by any of these scores

# The F-score of the surface at two pixel footprints falls by one to two times what the share of correct depths loses.
CRITERIA: Mapping[CriterionName, Criterion] = {
    "views": (Metric("PSNR", "dB", "psnr_db", 2), Metric("SSIM", "", "ssim", 4)),
    "surface": (Metric("correct depths", "%", "correct_depths_percent", 2, tolerance=2.0),),
}


class Budget(NamedTuple):
    """Size, quality and cost of a trained model.

    Attributes:
        gaussians: number of Gaussians.
        degree: degree of their spherical harmonics.
        scores: for each metric of the criterion, the scores of the held-out blocks of photographs.
        step_ms: CPU time of a training step with it, in milliseconds.
    """

    gaussians: int
    degree: int
    scores: tuple[tuple[float, ...], ...]
    step_ms: float

    @property
    def means(self) -> tuple[float, ...]:
        """Mean over the blocks of each metric."""
        return tuple(float(np.mean(blocks)) for blocks in self.scores)

    @property
    def numbers(self) -> int:
        """Number of parameters of the model."""
        return self.gaussians * (_PARAMETERS_WITHOUT_SH + 3 * (self.degree + 1) ** 2)


class Loss(NamedTuple):
    """Loss of a budget in a metric relative to another: mean over the blocks, and its 95 % interval.

    The interval is that of Student's t for the paired differences of the blocks, which need not be equally hard.
    """

    mean: float
    low: float
    high: float

    @classmethod
    def of(cls, budget: Budget, other: Budget, metric: int = 0) -> Loss:
        """Return what `budget` loses relative to another; needs at least two blocks."""
        from scipy.special import stdtrit

        losses = np.subtract(other.scores[metric], budget.scores[metric])
        mean, count = float(losses.mean()), len(losses)
        reach = float(stdtrit(count - 1, (1 + _CONFIDENCE) / 2) * losses.std(ddof=1) / np.sqrt(count))
        return cls(mean, mean - reach, mean + reach)

    def is_acceptable(self, tolerance: float) -> bool:
        """Return whether the loss is not larger than its noise, or than a tolerance."""
        return self.low <= 0 or self.mean <= tolerance


def find_best(budgets: Sequence[Budget]) -> Budget:
    """Return the budget with the highest mean of the first metric."""
    return max(budgets, key=lambda budget: budget.means[0])


def select_budget(budgets: Sequence[Budget], criterion: Criterion) -> int:
    """Return the index of the smallest budget that no other beats by more than noise, in any metric.

    If each is beaten by another one, this is the budget with the highest mean of the first metric.
    """

    def suffices(budget: Budget) -> bool:
        return all(
            Loss.of(budget, other, k).is_acceptable(metric.tolerance)
            for other in budgets
            if other is not budget
            for k, metric in enumerate(criterion)
        )

    unbeaten = [k for k, budget in enumerate(budgets) if suffices(budget)]
    return min(unbeaten or [budgets.index(find_best(budgets))], key=lambda k: budgets[k].numbers)


@dataclass(frozen=True)
class Curve:
    """The budgets in the order in which they were tried, and the criterion of their scores."""

    budgets: tuple[Budget, ...]
    criterion: Criterion = CRITERIA["views"]

    @property
    def selected(self) -> Budget:
        """The smallest budget that no other beats by more than noise."""
        return self.budgets[select_budget(self.budgets, self.criterion)]

    @property
    def best(self) -> Budget:
        """The budget with the highest score."""
        return find_best(self.budgets)

    @property
    def sentence(self) -> str:
        """The choice, and what more and fewer Gaussians would change, as a sentence for the notes."""
        selected = self.selected
        scores = " and ".join(m.text(mean) for m, mean in zip(self.criterion, selected.means, strict=True))
        return (
            f"{selected.gaussians:,} Gaussians with spherical harmonics of degree {selected.degree}: {scores} on"
            f" {len(selected.scores[0])} held-out blocks of photographs; {'; '.join(self._reasons())} (95 % intervals)"
        )

    def _reasons(self) -> Iterator[str]:
        """Yield why neither more nor fewer Gaussians were chosen, with 95 % intervals."""
        selected = self.selected
        same = next(budget for budget in self.budgets if budget.gaussians == selected.gaussians)  # of the first degree
        more = [budget for budget in self.budgets if budget.gaussians > same.gaussians]
        fewer = [budget for budget in self.budgets if budget.gaussians < same.gaussians]
        if more:
            nearest = min(more, key=lambda budget: budget.gaussians)
            yield f"{nearest.gaussians:,} gain {self._differences(same, nearest)}"
        else:
            yield "more were not allowed and may be better"
        if fewer:
            nearest = max(fewer, key=lambda budget: budget.gaussians)
            yield f"{nearest.gaussians:,} lose {self._differences(nearest, same)}"
        else:
            yield "fewer were not tried"

    def _differences(self, smaller: Budget, larger: Budget) -> str:
        """Return what a smaller budget loses in each metric, with 95 % intervals."""
        words = []
        for k, metric in enumerate(self.criterion):
            loss, decimals = Loss.of(smaller, larger, k), metric.decimals
            interval = f"{loss.low:.{decimals}f} to {loss.high:.{decimals}f}"
            name = "" if metric.unit else f"{metric.name} "
            words.append(f"{name}{metric.amount(loss.mean)} ({interval})")
        return " and ".join(words)

    @property
    def size_scores(self) -> Iterator[SizeScore]:
        """Scores of all budgets, for the page of the training."""
        best, selected = self.best, self.selected
        for k, metric in enumerate(self.criterion):
            name = f"{metric.name}, {metric.unit}" if metric.unit else metric.name
            for budget in self.budgets:
                loss, top = Loss.of(budget, best, k), best.means[k]
                interval = (top - loss.high, top - loss.low)
                size = (budget.gaussians, budget.degree)
                yield SizeScore(*size, name, budget.means[k], *interval, budget is selected)

    def write(self, path: Path) -> None:
        """Write a CSV file with one line per budget."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        columns = [metric.column for metric in self.criterion]
        count = len(self.budgets[0].scores[0])
        means = [f"{column}{part}" for column in columns for part in ("", "_loss", "_loss_low", "_loss_high")]
        blocks = [f"{column}_block_{k}" for column in columns for k in range(1, count + 1)]
        writer.writerow([*_COLUMNS, *means, "chosen", *blocks])
        best, selected = self.best, self.selected
        for budget in self.budgets:
            counts = (budget.gaussians, budget.degree, f"{budget.step_ms:.2f}", 4 * budget.numbers)
            losses = [Loss.of(budget, best, k) for k in range(len(columns))]
            values = [f"{v:.6f}" for mean, loss in zip(budget.means, losses, strict=True) for v in (mean, *loss)]
            scores = [repr(score) for blocks in budget.scores for score in blocks]
            writer.writerow([*counts, *values, int(budget is selected), *scores])
        with atomic_write(path) as file:
            file.write(text.getvalue().encode())

    @classmethod
    def read(cls, path: Path) -> Curve:
        """Return the curve that `write` wrote."""
        head, *rows = csv.reader(path.read_text(encoding="utf-8").splitlines())
        criterion = next(each for each in CRITERIA.values() if each[0].column in head)
        first = head.index("chosen") + 1
        budgets = []
        for row in rows:
            scores = np.array(row[first:], dtype=np.float64).reshape(len(criterion), -1)
            budgets.append(Budget(int(row[0]), int(row[1]), tuple(map(tuple, scores.tolist())), float(row[2])))
        return cls(tuple(budgets), criterion)
