"""Training: Gaussians that look like the photographs (Kerbl et al. 2023)."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from pcbench.errors import ReconstructionError
from pcbench.io.files import atomic_write
from reconstructors.splat.devices import kernels_of
from reconstructors.splat.model import Gaussians
from reconstructors.splat.optimizer import Optimizer, Rates, more_harmonics
from reconstructors.splat.photographs import Photograph, Pyramid
from reconstructors.splat.supervision import Pull, Supervision

if TYPE_CHECKING:
    from torch import Tensor

    from reconstructors.splat.density import Density
    from reconstructors.splat.interface import Pulled
    from reconstructors.splat.view import View


_CHECKED = 100  # steps between two looks at whether all numbers are finite


@dataclass(frozen=True)
class Schedule:
    """What happens when.

    Args:
        steps: photographs looked at, one after the other, in an order drawn anew for each round.
        sh_degree: of the spherical harmonics at the end; one more after each tenth of the steps.
        ssim_weight: of 1 - SSIM in the loss; the rest is for the absolute difference.
        halved: shares of the steps up to which photographs are a quarter and a half as wide.
        seed: of all that is drawn at random.
    """

    steps: int = 3000
    sh_degree: int = 3
    ssim_weight: float = 0.2
    halved: tuple[float, float] = (0.15, 0.4)
    seed: int = 0
    rates: Rates = field(default_factory=Rates)

    def level(self, step: int) -> int:
        """How often the photographs are halved at a step."""
        share = step / self.steps
        return 2 if share < self.halved[0] else 1 if share < self.halved[1] else 0

    def degree(self, step: int) -> int:
        """Of the spherical harmonics at a step."""
        return min(self.sh_degree, 10 * step // self.steps)


class Seen(NamedTuple):
    """What was seen of each Gaussian since the density was last controlled; tensors (N,).

    Attributes:
        gradient: sum over the views of the length of the derivative by the projected mean, in units in which the image
            is 2 wide and 2 high.
        views: that drew it.
    """

    gradient: Tensor
    views: Tensor

    @classmethod
    def nothing(cls, model: Gaussians) -> Seen:
        return cls(*(model.logits.new_zeros(len(model)) for _ in cls._fields))

    def add(self, pulled: Pulled, width: int, height: int) -> None:
        """Add what one view saw, in place."""
        ids = pulled.ids
        scale = pulled.screen.new_tensor([width / 2, height / 2])
        self.gradient[ids] += (pulled.screen * scale).norm(dim=1)
        self.views[ids] += 1


class Training:
    """A model on its way. The same photographs and settings give the same model, bit for bit, on the CPU.

    Attributes:
        model: what is trained.
        step: how many steps are done.
        seen: for density control.
        psnr: of each photograph when it was last looked at, dB.
    """

    def __init__(
        self,
        model: Gaussians,
        photographs: Sequence[Pyramid],
        schedule: Schedule,
        density: Density,
        supervision: Supervision | None = None,
    ):
        self.model = model
        self.photographs = photographs
        self.schedule = schedule
        self.density = density
        self.supervision = supervision
        self.step = 0
        self.psnr = [math.nan] * len(photographs)
        self.seen = Seen.nothing(model)
        self._kernels = kernels_of(model.means.device)
        self._rasterizer = self._kernels.Rasterizer()
        self.optimizer = Optimizer(model, self._kernels.adam)

    def run(self, until: int, each: Callable[[Training], None] | None = None) -> None:
        """Train up to a step, calling `each` after every one.

        Raises:
            ReconstructionError: numbers of the model are no longer finite, or no Gaussian is left.
        """
        while self.step < until:
            self._one_step()
            self.density.control(self)
            if self.step % _CHECKED == 0 or self.step == until:
                self._check()
            if each is not None:
                each(self)

    def _check(self) -> None:
        if not len(self.model):
            raise ReconstructionError(
                f"no Gaussian is left at step {self.step}: all became transparent; are the cameras right?"
            )
        # The rasterizer skips what is not a number, so the images would not tell.
        finite = [part.reshape(len(part), -1).isfinite().all(dim=1) for part in _tensors(self.model)]
        lost = sum(int((~rows).sum()) for rows in finite)
        if lost:
            raise ReconstructionError(
                f"training diverged: at step {self.step} numbers of {lost} Gaussians are not finite; are the cameras"
                " right?"
            )

    def rng(self) -> np.random.Generator:
        """For what is drawn at this step: a run that goes on draws what an unbroken one does."""
        return np.random.default_rng([self.schedule.seed, 1, self.step])

    def keep(self, rows: Tensor) -> None:
        """Keep some Gaussians (by number or truth), begin to count anew."""
        self.model = self.model.select(rows)
        self.optimizer.select(rows)
        self.seen = Seen.nothing(self.model)

    def add(self, others: Gaussians) -> None:
        """Add Gaussians, begin to count anew."""
        self.model = self.model.joined(others)
        self.optimizer.extend(others)
        self.seen = Seen.nothing(self.model)

    def _photograph(self) -> tuple[int, Photograph]:
        count = len(self.photographs)
        order = np.random.default_rng([self.schedule.seed, 0, self.step // count]).permutation(count)
        which = int(order[self.step % count])
        pyramid = self.photographs[which]
        return which, pyramid[min(self.schedule.level(self.step), len(pyramid) - 1)]

    def _one_step(self) -> None:
        import torch

        schedule = self.schedule
        if self.model.degree < schedule.degree(self.step):
            self.model = more_harmonics(self.model)
            self.optimizer.raise_degree()
        which, photograph = self._photograph()
        model = self.model
        drawn = self._rasterizer.forward(
            model.means,
            model.quats,
            model.scales,
            model.opacities,
            model.sh,
            photograph.view,
            torch.zeros(3),
            geometry=self.supervision is not None,
        )
        target = photograph.target()
        shown = drawn.color if photograph.valid is None else drawn.color * photograph.valid[..., None]
        loss = self._kernels.image_loss(shown, target, schedule.ssim_weight)
        gradient = loss.gradient if photograph.valid is None else loss.gradient * photograph.valid[..., None]
        difference = shown - target
        more = self.supervision.pull(photograph, drawn) if self.supervision else Pull()
        pulled = self._rasterizer.backward(gradient, more.transmittance, more.depth, None, None)
        self.step += 1
        self.optimizer.step(model, pulled, schedule.rates, self.step / schedule.steps, self.step)
        self.seen.add(pulled, photograph.view.width, photograph.view.height)
        self.psnr[which] = _psnr(float((difference**2).mean()))

    def save(self, path: Path, key: str) -> None:
        """Write all that a run with the same `key` needs to go on."""
        import torch

        held = {
            "key": key,
            "step": self.step,
            "psnr": self.psnr,
            "seen": tuple(self.seen),
            "parts": [_tensors(part) for part in (self.model, self.optimizer.first, self.optimizer.second)],
        }
        with atomic_write(path) as file:
            torch.save(held, file)

    def load(self, path: Path, key: str) -> bool:
        """Go on from what `save` wrote; False where that was for another key."""
        import torch

        held: dict[str, Any] = torch.load(path, weights_only=True)
        if held["key"] != key:
            return False
        self.step, self.psnr, self.seen = held["step"], held["psnr"], Seen(*held["seen"])
        self.model, first, second = (Gaussians(*part) for part in held["parts"])
        self.optimizer = Optimizer(self.model, self._kernels.adam, first, second)
        return True


def render(model: Gaussians, view: View) -> Tensor:
    """The image (H, W, 3) of a view, 0 to 1."""
    import torch

    rasterizer = kernels_of(model.means.device).Rasterizer()
    numbers = (model.means, model.quats, model.scales, model.opacities, model.sh)
    return rasterizer.forward(*numbers, view, torch.zeros(3), geometry=False).color.clamp(0, 1)


def evaluate(model: Gaussians, photographs: Sequence[Photograph]) -> list[float]:
    """PSNR of each photograph (dB), over what its mask shows."""
    scores = []
    for photograph in photographs:
        square = (render(model, photograph.view) - photograph.color.float() / 255) ** 2
        shown = square if photograph.valid is None else square[photograph.valid]
        scores.append(_psnr(float(shown.double().mean())))
    return scores


def _psnr(mean_square: float) -> float:
    return -10 * math.log10(max(mean_square, 1e-10))


def _tensors(part: Gaussians) -> tuple[Tensor, ...]:
    return tuple(getattr(part, f.name) for f in fields(part))
