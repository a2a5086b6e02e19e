"""Densification: clone, split and prune Gaussians during training."""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Generic, NamedTuple, Protocol, TypeVar

import numpy as np

from reconstructors.splat.interface import Gradients
from reconstructors.splat.model import Gaussians
from reconstructors.splat.optimizer import Optimizer

if TYPE_CHECKING:
    from torch import Tensor


_HALF_OFFSET = 0.6  # of the centre of a half from that of the whole, in standard deviations
_MAX_HALF_OPACITY = 0.98


class ScreenGradients(NamedTuple):
    """Gradients of the loss with respect to the projected means since the last densification; tensors (N,).

    Attributes:
        gradient: sum over the views of the gradient's norm, in image coordinates from -1 to 1.
        views: number of views in which the Gaussian was drawn.
    """

    gradient: Tensor
    views: Tensor

    @classmethod
    def zeros(cls, model: Gaussians) -> ScreenGradients:
        """Return the sums before the first view."""
        return cls(*(model.logits.new_zeros(len(model)) for _ in cls._fields))

    def add(self, gradients: Gradients, width: int, height: int) -> None:
        """Add the gradients of one view of width x height pixels, in place."""
        ids = gradients.ids
        scaled = gradients.screen.clone()
        scaled[:, 0] *= width / 2  # multiplying by a tensor of both would synchronise with the device
        scaled[:, 1] *= height / 2
        self.gradient[ids] += scaled.norm(dim=1)
        self.views[ids] += 1


class Densifiable(Protocol):
    """The part of a training that densification reads and changes."""

    @property
    def step(self) -> int:
        """Number of steps done."""
        ...

    @property
    def steps(self) -> int:
        """Total number of steps."""
        ...

    @property
    def model(self) -> Gaussians:
        """The Gaussians."""
        ...

    @property
    def optimizer(self) -> Optimizer:
        """The optimizer with its moments."""
        ...

    @property
    def screen_gradients(self) -> ScreenGradients:
        """Gradients accumulated since the last densification."""
        ...

    def rng(self) -> np.random.Generator:
        """Return the generator of this step."""
        ...

    def keep(self, rows: Tensor) -> None:
        """Keep the Gaussians selected by indices or a mask."""
        ...

    def add(self, others: Gaussians) -> None:
        """Append Gaussians."""
        ...


TrainingT = TypeVar("TrainingT", contravariant=True)  # the type of training that a strategy works on


class Density(Generic[TrainingT]):
    """Densification strategy; the base class changes nothing."""

    needs_screen_gradients = False  # whether `Training` accumulates them

    def control(self, training: TrainingT) -> None:
        """Change the model through `keep` and `add` of the training; called after each step."""

    def is_settled(self, training: TrainingT) -> bool:
        """Return whether the strategy no longer changes the model."""
        return True

    def state(self) -> object:
        """Return its state for a checkpoint, in types that `torch.load` reads with `weights_only`."""

    def restore(self, training: TrainingT, state: Any) -> None:
        """Continue a training from what `state` returned."""


@dataclass(frozen=True)
class Classic(Density[Densifiable]):
    """The strategy of Kerbl et al. 2023: clone small Gaussians with a large screen gradient, split large ones.

    Their code also means to prune Gaussians that are large in an image, but resets these sizes before the test, so that
    it prunes none, as the authors confirmed. Neither does this strategy.

    Args:
        refine_start: step after which densification starts.
        refine_stop_share: share of the steps at which densification and opacity resets stop.
        refine_interval: steps between two densifications.
        grow_gradient: Gaussians with a larger mean gradient with respect to the projected mean are cloned or split; in
            image coordinates from -1 to 1.
        clone_scale: largest axis up to which a Gaussian is cloned and above which it is split, in units of the cameras'
            spread.
        shrink: divisor of the axes of a split Gaussian.
        prune_opacity: Gaussians with a lower opacity are pruned.
        prune_scale: Gaussians with a larger axis are pruned, after the first opacity reset.
        reset_interval: steps between two opacity resets; 0 for never.
        reset_opacity: maximum opacity after a reset.
        max_gaussians: maximum number of Gaussians.
    """

    needs_screen_gradients = True

    refine_start: int = 500
    refine_stop_share: float = 0.5
    refine_interval: int = 100
    grow_gradient: float = 2e-4
    clone_scale: float = 0.01
    shrink: float = 1.6
    prune_opacity: float = 5e-3
    prune_scale: float = 0.1
    reset_interval: int = 3000
    reset_opacity: float = 0.01
    max_gaussians: int = 1_000_000

    def control(self, training: Densifiable) -> None:
        """Densify, prune and reset opacities when they are due."""
        import torch

        step = training.step
        if self.is_settled(training):
            return
        if step > self.refine_start and step % self.refine_interval == 0:
            self._densify(training)
            model = training.model
            kept = model.opacities >= self.prune_opacity
            if self.reset_interval and step > self.reset_interval:
                kept &= model.scales.amax(dim=1) <= self.prune_scale
            if not kept.all():
                training.keep(kept)
        if self.reset_interval and step % self.reset_interval == 0:
            max_logit = float(np.log(self.reset_opacity / (1 - self.reset_opacity)))
            torch.clamp_(training.model.logits, max=max_logit)
            training.optimizer.forget("logits")

    def is_settled(self, training: Densifiable) -> bool:
        """Return whether densification has stopped."""
        return training.step >= self.refine_stop_share * training.steps

    def _densify(self, training: Densifiable) -> None:
        model, sums = training.model, training.screen_gradients
        gradients = sums.gradient / sums.views.clamp(min=1)
        growing = gradients > self.grow_gradient
        room = max(0, self.max_gaussians - len(model))
        if int(growing.sum()) > room:
            growing = _largest(gradients, room) & growing
        small = model.scales.amax(dim=1) <= self.clone_scale
        clones, splits = growing & small, growing & ~small
        added = model.select(clones).concatenate(split(model.select(splits), self.shrink, training.rng()))
        training.add(added)
        if splits.any():
            kept = ~splits.new_zeros(len(training.model))
            kept[: len(splits)] = ~splits
            training.keep(kept)


@dataclass(frozen=True)
class NumberGrowth:
    """Growth to a number of Gaussians, at equal intervals and by equal factors.

    In each round, those with the largest mean screen gradients are halved, as many as are needed; a round at most
    doubles the number. Transparent ones are pruned before. It has no state besides the number of Gaussians.

    Args:
        target: number of Gaussians after the last round.
        first_step: step from which gradients are collected for the first round.
        last_step: step of the last round.
        rounds: number of rounds.
        prune_opacity: Gaussians with a lower opacity are pruned.
    """

    target: int
    first_step: int
    last_step: int
    rounds: int
    prune_opacity: float = 5e-3

    def control(self, training: Densifiable) -> None:
        """Add Gaussians when a round is due; called after each step."""
        import torch

        ends = [self.first_step + (self.last_step - self.first_step) * k // self.rounds for k in range(self.rounds + 1)]
        if training.step not in ends[1:] or len(training.model) >= self.target:
            return
        rounds_left = self.rounds + 2 - bisect_right(ends, training.step)  # this one included
        count = round(len(training.model) * (self.target / len(training.model)) ** (1 / rounds_left))
        sums = training.screen_gradients
        kept = training.model.opacities >= self.prune_opacity
        gradients = (sums.gradient / sums.views.clamp(min=1))[kept]
        if not kept.all():
            training.keep(kept)
        growing = _largest(gradients, count - len(gradients)) & (gradients > 0)
        training.add(halve(training.model.select(growing)))
        training.keep(torch.cat([~growing, growing.new_ones(2 * int(growing.sum()))]))


def halve(model: Gaussians) -> Gaussians:
    """Return two Gaussians for each, side by side along its longest axis, which together look nearly the same.

    Together they have the covariance of the Gaussian, and its opacity at the centre, if that is at most 0.93.
    """
    import torch

    from reconstructors.splat.rotations import rotate

    axis = torch.nn.functional.one_hot(model.scales.argmax(dim=1), 3).to(model.means)
    offset = rotate(model.quats, _HALF_OFFSET * axis * model.scales)
    variance = 1 - _HALF_OFFSET**2  # of a half along the axis, relative to that of the whole
    falloff = float(np.exp(-(_HALF_OFFSET**2) / (2 * variance)))  # of a half at the centre of the whole
    opacities = ((1 - (1 - model.opacities).sqrt()) / falloff).clamp(max=_MAX_HALF_OPACITY)
    halves = [
        replace(
            model,
            means=model.means + sign * offset,
            log_scales=model.log_scales + axis * float(np.log(variance) / 2),
            logits=torch.logit(opacities),
        )
        for sign in (1, -1)
    ]
    return halves[0].concatenate(halves[1])


def split(model: Gaussians, shrink: float, rng: np.random.Generator) -> Gaussians:
    """Return two Gaussians for each, at positions sampled from it, with axes divided by `shrink`."""
    import torch

    from reconstructors.splat.rotations import rotate

    samples = torch.from_numpy(rng.standard_normal((2, len(model), 3)).astype(np.float32)).to(model.means.device)
    halves = [
        replace(
            model,
            means=model.means + rotate(model.quats, noise * model.scales),
            log_scales=model.log_scales - float(np.log(shrink)),
        )
        for noise in samples
    ]
    return halves[0].concatenate(halves[1])


def _largest(values: Tensor, count: int) -> Tensor:
    """Mask (N,) of the `count` largest values."""
    import torch

    chosen = torch.zeros_like(values, dtype=torch.bool)
    chosen[torch.argsort(values, descending=True, stable=True)[:count]] = True
    return chosen
