"""Density control: where Gaussians are added and taken away during training."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Generic, NamedTuple, Protocol, TypeVar

import numpy as np

from reconstructors.splat.interface import Pulled
from reconstructors.splat.model import Gaussians
from reconstructors.splat.optimizer import Optimizer

if TYPE_CHECKING:
    from torch import Tensor


class ScreenGradients(NamedTuple):
    """Gradients of the loss with respect to projected means since the density was last controlled; tensors (N,).

    Attributes:
        gradient: sum over the views of the gradient's length, in units in which the image is 2 wide and 2 high.
        views: number of views that drew the Gaussian.
    """

    gradient: Tensor
    views: Tensor

    @classmethod
    def zeros(cls, model: Gaussians) -> ScreenGradients:
        return cls(*(model.logits.new_zeros(len(model)) for _ in cls._fields))

    def add(self, pulled: Pulled, width: int, height: int) -> None:
        """Add the gradients of one view, in place."""
        ids = pulled.ids
        moved = pulled.screen.clone()
        moved[:, 0] *= width / 2  # a tensor of both numbers would have to be brought to the device, and waited for
        moved[:, 1] *= height / 2
        self.gradient[ids] += moved.norm(dim=1)
        self.views[ids] += 1


class Densifiable(Protocol):
    """The part of a training that densification reads and changes."""

    @property
    def step(self) -> int:
        """Number of steps done."""
        ...

    @property
    def steps(self) -> int:
        """Number of steps in all."""
        ...

    @property
    def model(self) -> Gaussians: ...
    @property
    def optimizer(self) -> Optimizer: ...
    @property
    def seen(self) -> ScreenGradients: ...

    def rng(self) -> np.random.Generator:
        """Return the random numbers of this step."""
        ...

    def keep(self, rows: Tensor) -> None:
        """Keep some Gaussians, by number or by truth."""
        ...

    def add(self, others: Gaussians) -> None:
        """Add Gaussians."""
        ...


Trained = TypeVar("Trained", contravariant=True)  # the training that a density is given


class Density(Generic[Trained]):
    """Densification strategy; the base class changes nothing."""

    def control(self, training: Trained) -> None:
        """Change the model through `keep` and `add` of the training; called after every step."""

    def settled(self, training: Trained) -> bool:
        """Whether it changes the model no more."""
        return True

    def state(self) -> object:
        """What it has to remember beside the model, as `torch.load` reads it with `weights_only`."""

    def restore(self, training: Trained, state: Any) -> None:
        """Go on with a training and what `state` gave."""


@dataclass(frozen=True)
class Classic(Density[Densifiable]):
    """The rules of Kerbl et al. 2023: what is pulled across the image hard is cloned if it is small, else split.

    Args:
        first, last: steps between which Gaussians are added, last as a share of all steps.
        every: steps between two times.
        gradient: mean over the views of the derivative by the projected mean, in units in which the image is 2 wide
            and high, above which a Gaussian is cloned or split.
        small: the largest axis up to which it is cloned, in units of the cameras' spread.
        shrink: what the axes of a split one are divided by.
        faint: opacity under which a Gaussian is taken away.
        large: axis over which it is, once opacities were reset.
        reset: steps between two times at which opacities are held at `reset_opacity`; 0 for never.
        most: Gaussians.
    """

    first: int = 500
    last: float = 0.5
    every: int = 100
    gradient: float = 2e-4
    small: float = 0.01
    shrink: float = 1.6
    faint: float = 5e-3
    large: float = 0.1
    reset: int = 3000
    reset_opacity: float = 0.01
    most: int = 1_000_000

    def control(self, training: Densifiable) -> None:
        import torch

        step = training.step
        if step > self.last * training.steps:
            return
        if step >= self.first and step % self.every == 0:
            self._densify(training)
            model = training.model
            kept = model.opacities >= self.faint
            if self.reset and step > self.reset:
                kept &= model.scales.amax(dim=1) <= self.large
            if not kept.all():
                training.keep(kept)
        if self.reset and step % self.reset == 0:
            held = float(np.log(self.reset_opacity / (1 - self.reset_opacity)))
            torch.clamp_(training.model.logits, max=held)
            training.optimizer.forget("logits")

    def settled(self, training: Densifiable) -> bool:
        return training.step > self.last * training.steps

    def _densify(self, training: Densifiable) -> None:
        model, seen = training.model, training.seen
        pulled = seen.gradient / seen.views.clamp(min=1)
        wanted = pulled > self.gradient
        room = max(0, self.most - len(model))
        if int(wanted.sum()) > room:
            wanted = _strongest(pulled, room) & wanted
        small = model.scales.amax(dim=1) <= self.small
        clones, splits = wanted & small, wanted & ~small
        added = model.select(clones).joined(split(model.select(splits), self.shrink, training.rng()))
        training.add(added)
        if splits.any():
            kept = ~splits.new_zeros(len(training.model))
            kept[: len(splits)] = ~splits
            training.keep(kept)


# The figures of Gao et al.; what they leave out is as Kerbl et al. have it.
GAO2025 = Classic(first=1000)


def split(model: Gaussians, shrink: float, rng: np.random.Generator) -> Gaussians:
    """Two for each, at places drawn from it, with axes divided by `shrink`."""
    import torch

    from reconstructors.splat.rotations import rotated

    drawn = torch.from_numpy(rng.standard_normal((2, len(model), 3)).astype(np.float32)).to(model.means.device)
    halves = [
        replace(
            model,
            means=model.means + rotated(model.quats, noise * model.scales),
            log_scales=model.log_scales - float(np.log(shrink)),
        )
        for noise in drawn
    ]
    return halves[0].joined(halves[1])


def _strongest(values: Tensor, count: int) -> Tensor:
    """Truth (N,) of the `count` largest."""
    import torch

    chosen = torch.zeros_like(values, dtype=torch.bool)
    chosen[torch.argsort(values, descending=True, stable=True)[:count]] = True
    return chosen
