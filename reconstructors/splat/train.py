"""Training: Gaussians that look like the photographs (Kerbl et al. 2023)."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from pcbench.errors import ReconstructionError
from pcbench.io.files import atomic_write
from reconstructors.splat.density import Density, ScreenGradients
from reconstructors.splat.devices import kernels_of
from reconstructors.splat.model import Gaussians
from reconstructors.splat.optimizer import Optimizer, Rates, fewer_harmonics, more_harmonics
from reconstructors.splat.photographs import Photograph, Pyramid
from reconstructors.splat.supervision import Pull, Supervision

if TYPE_CHECKING:
    from torch import Tensor

    from reconstructors.splat.interface import Drawn
    from reconstructors.splat.view import View


_SHOWING = 100  # photographs that tell how much of them a Gaussian is, at most
_CHECKED = 100  # steps between two looks at whether all numbers are finite
_ARRANGED = 2000  # steps between two times at which neighbours are put together, where that is faster


@dataclass(frozen=True)
class Schedule:
    """What happens when.

    Args:
        steps: photographs looked at, one after the other, in an order drawn anew for each round.
        sh_degree: of the spherical harmonics at the end; one more after each tenth of the steps.
        ssim_weight: of 1 - SSIM in the loss; the rest is for the absolute difference.
        halved: shares of the steps up to which photographs are a quarter and a half as wide.
        seed: of all that is drawn at random.
        plateau: dB; training ends where the photographs are, on average, not so much better than they were a tenth and
            two tenths of the steps before, once the number of Gaussians is settled.
    """

    steps: int = 3000
    sh_degree: int = 3
    ssim_weight: float = 0.2
    halved: tuple[float, float] = (0.15, 0.4)
    seed: int = 0
    plateau: float = 0.01
    rates: Rates = field(default_factory=Rates)

    def level(self, step: int) -> int:
        """How often the photographs are halved at a step."""
        share = step / self.steps
        return 2 if share < self.halved[0] else 1 if share < self.halved[1] else 0

    def degree(self, step: int) -> int:
        """Of the spherical harmonics at a step."""
        return min(self.sh_degree, 10 * step // self.steps)


class Snapshot(NamedTuple):
    """A model after a step, and the moments of its numbers; nothing changes it."""

    step: int
    model: Gaussians
    first: Gaussians
    second: Gaussians

    def plain(self) -> tuple[Any, ...]:
        """For a checkpoint."""
        return (self.step, *(_tensors(part) for part in self[1:]))

    @classmethod
    def of(cls, plain: tuple[Any, ...]) -> Snapshot:
        """What `plain` gave."""
        step, *parts = plain
        return cls(step, *(Gaussians(*part) for part in parts))


class Training:
    """A model on its way, on the device that the model and the photographs are on. The same of both and of settings
    give the same model, bit for bit, on the CPU at any number of threads. A step waits for a CUDA device once, where
    the rasterizer asks it how much there is to draw.

    Attributes:
        model: what is trained.
        step: how many steps are done.
        seen: for density control.
        psnr: of each photograph when it was last looked at, dB; whoever reads a tensor waits for the device.
        ended: whether the photographs get no better.
    """

    def __init__(
        self,
        model: Gaussians,
        photographs: Sequence[Pyramid],
        schedule: Schedule,
        density: Density[Training],
        supervision: Supervision | None = None,
    ):
        self.model = model
        self.photographs = photographs
        self.schedule = schedule
        self.density = density
        self.supervision = supervision
        self.step = 0
        self.psnr: list[float | Tensor] = [math.nan] * len(photographs)
        self.ended = False
        self._means: list[float] = []  # PSNR after each tenth of the steps
        self.seen = ScreenGradients.zeros(model)
        self._kernels = kernels_of(model.means.device)
        self._rasterizer = self._kernels.Rasterizer()
        self.optimizer = Optimizer(model, self._kernels.adam)

    @property
    def steps(self) -> int:
        """Number of steps of the schedule."""
        return self.schedule.steps

    def run(self, until: int, each: Callable[[Training], None] | None = None) -> None:
        """Train up to a step, or to where the photographs get no better, calling `each` after every step.

        Raises:
            ReconstructionError: numbers of the model are no longer finite, or no Gaussian is left.
        """
        while self.step < until and not self.ended:
            self._one_step()
            self.density.control(self)
            self._look_back()
            if self.step % _CHECKED == 0 or self.step == until or self.ended:
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

    def _look_back(self) -> None:
        count, steps = len(self.photographs), self.schedule.steps
        if self.step % max(count, steps // 10) or not self.density.settled(self):
            return
        whole = self.step >= count and self.schedule.level(self.step - count) == 0  # all were seen in full size
        if whole:
            self._means.append(sum(map(float, self.psnr)) / count)
        before = self._means[-3:-1]
        self.ended = len(before) == 2 and self._means[-1] - min(before) < self.schedule.plateau

    def rng(self) -> np.random.Generator:
        """For what is drawn at this step: a run that goes on draws what an unbroken one does."""
        return np.random.default_rng([self.schedule.seed, 1, self.step])

    def keep(self, rows: Tensor) -> None:
        """Keep some Gaussians (by number or truth), begin to count anew."""
        self.model = self.model.select(rows)
        self.optimizer.select(rows)
        self.seen = ScreenGradients.zeros(self.model)

    def arrange(self, order: Tensor) -> None:
        """Bring the Gaussians, and all that is known of them, into an order."""
        self.model = self.model.select(order)
        self.optimizer.select(order)
        self.seen = ScreenGradients(*(part[order] for part in self.seen))

    def add(self, others: Gaussians) -> None:
        """Add Gaussians, begin to count anew."""
        self.model = self.model.joined(others)
        self.optimizer.extend(others)
        self.seen = ScreenGradients.zeros(self.model)

    def snapshot(self) -> Snapshot:
        """The model as it is now, for `return_to`."""
        parts = (self.model, self.optimizer.first, self.optimizer.second)
        return Snapshot(self.step, *(Gaussians(*(t.clone() for t in _tensors(part))) for part in parts))

    def return_to(self, snapshot: Snapshot) -> None:
        """Go on from what was, which is not changed by that."""
        self.step = snapshot.step
        self.model, first, second = (Gaussians(*(t.clone() for t in _tensors(part))) for part in snapshot[1:])
        self.optimizer = Optimizer(self.model, self._kernels.adam, first, second)
        self.seen = ScreenGradients.zeros(self.model)

    def limit_degree(self, degree: int) -> None:
        """Go on with spherical harmonics of at most this degree."""
        self.schedule = replace(self.schedule, sh_degree=degree)
        if self.model.degree > degree:
            self.model = fewer_harmonics(self.model, degree)
            self.optimizer.lower_degree(degree)

    def train_on(self, photographs: Sequence[Pyramid]) -> None:
        """Go on with these photographs."""
        self.photographs = photographs
        self.psnr = [math.nan] * len(photographs)
        self._means = []

    def shown(self) -> Tensor:
        """(N,) how much of the photographs each Gaussian is: the sum of its weights over all pixels, of at most a
        hundred of them."""
        shown = self.model.logits.new_zeros(len(self.model))
        for pyramid in self.photographs[:: math.ceil(len(self.photographs) / _SHOWING)]:
            photograph = pyramid[min(self.schedule.level(self.step), len(pyramid) - 1)]
            drawn = self._drawn(photograph.view)
            pulled = self._rasterizer.backward(drawn.color.new_zeros(drawn.color.shape), None, None, None, None)
            shown[pulled.ids] += pulled.weight
        return shown

    def _drawn(self, view: View, *, geometry: bool = False) -> Drawn:
        background = self.model.means.new_zeros(3)
        return self._rasterizer.forward(self.model.drawn_from, view, background, geometry=geometry)

    def _photograph(self) -> tuple[int, Photograph]:
        count = len(self.photographs)
        order = np.random.default_rng([self.schedule.seed, 0, self.step // count]).permutation(count)
        which = int(order[self.step % count])
        pyramid = self.photographs[which]
        return which, pyramid[min(self.schedule.level(self.step), len(pyramid) - 1)]

    def _one_step(self) -> None:
        schedule, order = self.schedule, self._kernels.morton_order
        if order is not None and self.step % _ARRANGED == 0:
            self.arrange(order(self.model.means))
        if self.model.degree < schedule.degree(self.step):
            self.model = more_harmonics(self.model)
            self.optimizer.raise_degree()
        which, photograph = self._photograph()
        model = self.model
        drawn = self._drawn(photograph.view, geometry=self.supervision is not None)
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
        self.psnr[which] = _psnr((difference**2).mean())

    def save(self, path: Path, key: str) -> None:
        """Write all that a run with the same `key` needs to go on."""
        import torch

        held = {
            "key": key,
            "step": self.step,
            "density": self.density.state(),
            "psnr": self.psnr,
            "means": self._means,
            "ended": self.ended,
            "seen": tuple(self.seen),
            "parts": [_tensors(part) for part in (self.model, self.optimizer.first, self.optimizer.second)],
        }
        with atomic_write(path) as file:
            torch.save(held, file)

    def load(self, path: Path, key: str) -> bool:
        """Go on from what `save` wrote, on whatever device; False where that was for another key."""
        import torch

        held: dict[str, Any] = torch.load(path, map_location=self.model.means.device, weights_only=True)
        if held["key"] != key:
            return False
        self.step, self.seen = held["step"], ScreenGradients(*held["seen"])
        self.model, first, second = (Gaussians(*part) for part in held["parts"])
        self.optimizer = Optimizer(self.model, self._kernels.adam, first, second)
        self.density.restore(self, held["density"])
        self.psnr, self._means, self.ended = held["psnr"], held["means"], held["ended"]
        return True


def render(model: Gaussians, view: View) -> Tensor:
    """The image (H, W, 3) of a view, 0 to 1."""
    rasterizer = kernels_of(model.means.device).Rasterizer()
    background = model.means.new_zeros(3)
    return rasterizer.forward(model.drawn_from, view, background, geometry=False, gradient=False).color.clamp(0, 1)


def evaluate(model: Gaussians, photographs: Sequence[Photograph]) -> list[float]:
    """PSNR of each photograph (dB), over what its mask shows."""
    scores = []
    for photograph in photographs:
        square = (render(model, photograph.view) - photograph.color.float() / 255) ** 2
        shown = square if photograph.valid is None else square[photograph.valid]
        scores.append(float(_psnr(shown.double().mean())))
    return scores


def _psnr(mean_square: Tensor) -> Tensor:
    return -10 * mean_square.clamp(min=1e-10).log10()


def _tensors(part: Gaussians) -> tuple[Tensor, ...]:
    return tuple(getattr(part, f.name) for f in fields(part))
