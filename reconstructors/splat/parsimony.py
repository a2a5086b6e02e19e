"""How many Gaussians a scene needs: ever smaller models of one run, judged by photographs that none of them was
trained on, of which the smallest is taken that is as good as the best.

The rule of one standard error is that of Breiman et al. 1984, section 3.4.3, with differences instead of scores: all
models are judged by the same photographs, and a hard one is hard for all. Photographs that were taken one after the
other go together (a block), so the standard error is that of the blocks' means.
"""

from __future__ import annotations

import csv
import io
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from pcbench.io.files import atomic_write
from reconstructors.splat.density import Density
from reconstructors.splat.train import Snapshot, evaluate

if TYPE_CHECKING:
    from reconstructors.splat.photographs import Pyramid
    from reconstructors.splat.train import Training

# Shares of the steps: before budgets are tried, with each of them, and at which the chosen one begins again.
_BEFORE, _EACH, _AGAIN = 0.5, 0.08, 0.3
_HALF = 2  # what a budget is divided by
_FEWEST = 100  # Gaussians of a budget
_REFUSED = 2  # budgets in a row that are too small: no smaller one is tried
_COLUMNS = ("gaussians", "degree", "step_cpu_ms")
_OTHER_NUMBERS = 11  # of a Gaussian, without its harmonics


class Budget(NamedTuple):
    """A model and how good it is.

    Attributes:
        gaussians: how many.
        degree: of their spherical harmonics.
        psnr: dB, of each block of photographs that were held out: means over its photographs.
        step_ms: CPU time of a training step with it, milliseconds.
    """

    gaussians: int
    degree: int
    psnr: tuple[float, ...]
    step_ms: float

    @property
    def mean(self) -> float:
        """PSNR, dB."""
        return float(np.mean(self.psnr))

    @property
    def numbers(self) -> int:
        """That the model consists of."""
        return self.gaussians * (_OTHER_NUMBERS + 3 * (self.degree + 1) ** 2)


class Loss(NamedTuple):
    """What a budget loses against another: mean over the blocks, dB, and its standard error."""

    mean: float
    error: float

    @classmethod
    def of(cls, budget: Budget, best: Budget) -> Loss:
        losses = np.subtract(best.psnr, budget.psnr)
        return cls(float(losses.mean()), float(losses.std(ddof=1) / np.sqrt(len(losses))))

    @property
    def is_none(self) -> bool:
        """Whether it is within a standard error."""
        return self.mean <= self.error


def highest(budgets: Sequence[Budget]) -> Budget:
    """That of the highest PSNR."""
    return max(budgets, key=lambda budget: budget.mean)


def chosen(budgets: Sequence[Budget]) -> int:
    """The number of the smallest budget that is within one standard error of the best; of two blocks at least."""
    best = highest(budgets)
    good = [k for k, budget in enumerate(budgets) if budget is best or Loss.of(budget, best).is_none]
    return min(good, key=lambda k: budgets[k].numbers)


@dataclass(frozen=True)
class Curve:
    """The budgets that were tried, in their order."""

    budgets: tuple[Budget, ...]

    @property
    def chosen(self) -> Budget:
        """The smallest that is as good as the best."""
        return self.budgets[chosen(self.budgets)]

    @property
    def best(self) -> Budget:
        """That of the highest PSNR."""
        return highest(self.budgets)

    @property
    def sentence(self) -> str:
        """What was chosen, and why."""
        taken, best, most = self.chosen, self.best, self.budgets[0].gaussians
        words = f"{taken.gaussians:,} Gaussians of degree {taken.degree} are enough: {taken.mean:.2f} dB"
        if taken is best and taken.gaussians == most:
            smaller = [budget for budget in self.budgets if budget.gaussians < most]
            if not smaller:
                return (
                    f"{taken.gaussians:,} Gaussians of degree {taken.degree} have {taken.mean:.2f} dB of photographs"
                    " that were not trained on; so few are not halved"
                )
            fewer = highest(smaller)
            return (
                f"all {most:,} Gaussians are needed: {taken.mean:.2f} dB of photographs that were not trained on,"
                f" {fewer.gaussians:,} have {fewer.mean:.2f} dB; more may be better still"
            )
        if taken is best:
            return f"{words} of photographs that were not trained on, more have less"
        loss = Loss.of(taken, best)
        return (
            f"{words} of photographs that were not trained on, {loss.mean:.2f} ± {loss.error:.2f} dB less than the best"
            f" of {len(self.budgets)} budgets ({best.gaussians:,} of degree {best.degree})"
        )

    def write(self, path: Path) -> None:
        """As CSV, a line a budget."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        blocks = [f"block_{k}_db" for k in range(1, len(self.budgets[0].psnr) + 1)]
        writer.writerow([*_COLUMNS, "bytes", "psnr_db", "loss_db", "loss_standard_error_db", "chosen", *blocks])
        best, taken = self.best, self.chosen
        for budget in self.budgets:
            loss = Loss.of(budget, best)
            counts = (budget.gaussians, budget.degree, f"{budget.step_ms:.2f}", 4 * budget.numbers)
            judged = (f"{value:.4f}" for value in (budget.mean, loss.mean, loss.error))
            writer.writerow([*counts, *judged, int(budget is taken), *map(repr, budget.psnr)])
        with atomic_write(path) as file:
            file.write(text.getvalue().encode())

    @classmethod
    def read(cls, path: Path) -> Curve:
        """What `write` wrote."""
        head, *rows = csv.reader(path.read_text(encoding="utf-8").splitlines())
        first = head.index("block_1_db")
        numbers = [[*map(float, row)] for row in rows]
        return cls(tuple(Budget(int(n[0]), int(n[1]), tuple(n[first:]), n[2]) for n in numbers))


class _Kept(NamedTuple):
    budget: Budget
    begun: Snapshot  # before the steps after which it was judged


class Parsimonious(Density["Training"]):
    """Trains all Gaussians for half of the steps. From that model others are made that are smaller: half of the
    Gaussians stay, of which the photographs show most, then half of these, and so on; then a degree of the harmonics is
    taken away, and another. Each is trained for as many steps more, at the same rates and with the same photographs,
    and judged. The smallest that is as good as the best is trained again, with all photographs.

    Args:
        judges: photographs by block, two blocks at least. `Training` begins without them.
    """

    def __init__(self, judges: Sequence[Sequence[Pyramid]]) -> None:
        if len(judges) < 2:
            raise ValueError(f"expected at least two blocks of photographs to judge by, got {len(judges)}")
        self._judges = judges
        self._kept: list[_Kept] = []
        self._begun: Snapshot | None = None  # of the model that is trained to be judged
        self._plainer = False  # whether it is the harmonics' turn
        self._clock: tuple[int, float] | None = None
        self.curve: Curve | None = None

    def control(self, training: Training) -> None:
        steps = training.schedule.steps
        if self.curve is not None or training.step < max(1, round(_BEFORE * steps)):
            return
        if self._begun is None:
            self._begun = training.snapshot()
        if self._clock is None:
            self._clock = training.step, time.process_time()
        due = self._begun.step + max(1, round(_EACH * steps))
        if training.step < min(due, steps):
            return
        self._kept.append(_Kept(self._judged(training), self._begun))
        if due <= steps and self._made_smaller(training):
            self._begun, self._clock = training.snapshot(), None
        else:
            self._choose(training)

    def settled(self, training: Training) -> bool:
        return self.curve is not None

    def _judged(self, training: Training) -> Budget:
        model = training.model
        assert self._clock is not None
        since, start = self._clock
        step_ms = 1000 * (time.process_time() - start) / max(1, training.step - since)
        psnr = tuple(float(np.mean(evaluate(model, [pyramid[0] for pyramid in block]))) for block in self._judges)
        return Budget(len(model), model.degree, psnr, step_ms)

    def _made_smaller(self, training: Training) -> bool:
        """Make the next model from those that were judged; False where there is none to try any more."""
        taken, last = chosen([kept.budget for kept in self._kept]), len(self._kept) - 1
        if not self._plainer:
            fewer = len(training.model) // _HALF
            if fewer >= _FEWEST and last - taken < _REFUSED:
                training.return_to(self._kept[last].begun)
                shown = training.shown()
                training.keep(shown.argsort(descending=True, stable=True)[:fewer].sort().values)
                return True
            self._plainer = True
        elif taken < last:
            return False
        degree = self._kept[taken].budget.degree
        if degree == 0:
            return False
        training.return_to(self._kept[taken].begun)
        training.limit_degree(degree - 1)
        return True

    def _choose(self, training: Training) -> None:
        self.curve = Curve(tuple(kept.budget for kept in self._kept))
        kept = self._kept[chosen(self.curve.budgets)]
        training.return_to(kept.begun)
        training.step = round(_AGAIN * training.schedule.steps)
        training.limit_degree(kept.budget.degree)
        training.train_on(self._all(training))
        self._kept.clear()
        self._begun = None

    def state(self) -> object:
        kept = [(tuple(k.budget), k.begun.plain()) for k in self._kept]
        begun = None if self._begun is None else self._begun.plain()
        curve = None if self.curve is None else [tuple(budget) for budget in self.curve.budgets]
        return {"plainer": self._plainer, "begun": begun, "kept": kept, "curve": curve}

    def restore(self, training: Training, state: Any) -> None:
        self._plainer, self._clock = state["plainer"], None
        self._begun = None if state["begun"] is None else Snapshot.of(state["begun"])
        self._kept = [_Kept(Budget(*budget), Snapshot.of(plain)) for budget, plain in state["kept"]]
        if self._plainer:
            training.limit_degree(training.model.degree)
        if state["curve"] is not None:
            self.curve = Curve(tuple(Budget(*budget) for budget in state["curve"]))
            training.train_on(self._all(training))

    def _all(self, training: Training) -> list[Pyramid]:
        return [*training.photographs, *(pyramid for block in self._judges for pyramid in block)]
