"""Training of Gaussians on photographs (Kerbl et al. 2023)."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from pcbench.errors import ReconstructionError
from pcbench.scratch import atomic_write
from reconstructors.splat.background import Background
from reconstructors.splat.density import Density, ScreenGradients
from reconstructors.splat.devices import kernels_of
from reconstructors.splat.exposure import Exposure, least_squares_gain
from reconstructors.splat.model import SH_DC, Gaussians
from reconstructors.splat.optimizer import LearningRates, Optimizer, lower_sh_degree, raise_sh_degree
from reconstructors.splat.photographs import Photograph, Pyramid
from reconstructors.splat.supervision import DepthGradients, Supervision

if TYPE_CHECKING:
    from torch import Tensor

    from reconstructors.splat.interface import RasterOutput
    from reconstructors.splat.view import View


_MAX_CONTRIBUTION_VIEWS = 100  # views used to estimate each Gaussian's contribution
_FINITE_CHECK_INTERVAL = 100  # steps between two checks that all parameters are finite
_MORTON_SORT_INTERVAL = 2000  # steps between two sorts into Morton order, on devices that are faster with it


@dataclass(frozen=True)
class Schedule:
    """Number of steps, and what changes during training.

    Args:
        steps: number of steps; each uses one photograph, in an order shuffled anew for each round.
        sh_degree: final degree of the spherical harmonics.
        degree_interval: steps after which the degree grows by one from 0; None: it is 0 for three tenths of the steps,
            and grows by one at each tenth from there on.
        ssim_weight: weight of 1 - SSIM in the loss; the rest is the weight of the absolute difference.
        downscale_shares: shares of the steps up to which the photographs are a quarter and half as wide.
        min_alpha: minimum alpha at a pixel up to `exact_share` of the steps: lower ones are skipped, which is faster.
        exact_share: share of the steps from which all alphas count that count in a rendering.
        seed: seed of all random numbers.
        plateau: dB; training converges if the mean PSNR of the photographs has gained less than this over one tenth or
            two tenths of the steps, once the number of Gaussians is final; None: all steps are done.
        rates: learning rates.
    """

    steps: int = 3000
    sh_degree: int = 3
    degree_interval: int | None = None
    ssim_weight: float = 0.2
    downscale_shares: tuple[float, float] = (0.15, 0.4)
    min_alpha: float = 1 / 128
    exact_share: float = 0.8
    seed: int = 0
    plateau: float | None = 0.01
    rates: LearningRates = field(default_factory=LearningRates)

    def level(self, step: int) -> int:
        """Return the pyramid level of the photographs at a step: 0 is full size, each level halves the width."""
        share = step / self.steps
        return 2 if share < self.downscale_shares[0] else 1 if share < self.downscale_shares[1] else 0

    def degree(self, step: int) -> int:
        """Return the degree of the spherical harmonics at a step."""
        grown = max(0, 10 * step // self.steps - 2) if self.degree_interval is None else step // self.degree_interval
        return min(self.sh_degree, grown)

    def rendered(self, view: View, step: int) -> View:
        """Return a view with the minimum alpha of a step."""
        return view if step >= self.exact_share * self.steps else replace(view, min_alpha=self.min_alpha)


class Snapshot(NamedTuple):
    """A model after a step with Adam's moments; training does not change it."""

    step: int
    model: Gaussians
    first: Gaussians
    second: Gaussians

    def to_tuple(self) -> tuple[Any, ...]:
        """Return tuples of tensors for a checkpoint."""
        return (self.step, *(_tensors(part) for part in self[1:]))

    @classmethod
    def from_tuple(cls, values: tuple[Any, ...]) -> Snapshot:
        """Return the snapshot that `to_tuple` converted."""
        step, *parts = values
        return cls(step, *(Gaussians(*part) for part in parts))


class Training:
    """The state of a training, on the device of the model and the photographs.

    The same model, photographs and settings give the same result bit for bit, on the CPU with any number of threads.
    Each step synchronises with a CUDA device once, when the rasterizer reads how many instances to draw.

    Attributes:
        model: the Gaussians.
        step: number of steps done.
        screen_gradients: gradients accumulated for densification; zero if the strategy does not need them.
        psnr: PSNR of each photograph when it was last used, in dB; reading an entry synchronises with the GPU.
        losses: loss of each photograph when this run last used it, without that of the depths; likewise.
        converged: whether the photographs no longer improve.
    """

    def __init__(
        self,
        model: Gaussians,
        photographs: Sequence[Pyramid],
        schedule: Schedule,
        density: Density[Training],
        supervision: Supervision | None = None,
        background: Background | None = None,
        exposure: Exposure | None = None,
    ):
        self.model = model
        self.photographs = photographs
        self.schedule = schedule
        self.density = density
        self.supervision = supervision
        self.background = background or Background(device=model.means.device)
        self.exposure = exposure
        self.step = 0
        self.psnr: list[float | Tensor] = [math.nan] * len(photographs)
        self.losses = self.psnr.copy()
        self.converged = False
        self._mean_psnr: list[float] = []  # dB, after each tenth of the steps
        self.screen_gradients = ScreenGradients.zeros(model)
        self._kernels = kernels_of(model.means.device)
        self._rasterizer = self._kernels.Rasterizer()
        self.optimizer = Optimizer(model, self._kernels.adam)

    @property
    def steps(self) -> int:
        """Number of steps of the schedule."""
        return self.schedule.steps

    def status(self) -> str:
        """Return mean PSNR and number of Gaussians for a progress message."""
        return f"PSNR {self.mean_psnr:.1f} dB, {len(self.model):,} Gaussians"

    @property
    def mean_psnr(self) -> float:
        """Mean PSNR of the photographs that were used, in dB."""
        return _mean_of_known(self.psnr)

    @property
    def mean_loss(self) -> float:
        """Mean loss of the photographs that this run has used, without that of the depths."""
        return _mean_of_known(self.losses)

    def run(self, until: int, on_step: Callable[[Training], None] | None = None) -> None:
        """Train up to a step or until convergence, calling `on_step` after each step.

        Raises:
            ReconstructionError: a parameter of the model is not finite, or no Gaussian is left.
        """
        while self.step < until and not self.converged:
            self._train_step()
            self.density.control(self)
            self._check_convergence()
            if self.step % _FINITE_CHECK_INTERVAL == 0 or self.step == until or self.converged:
                self._check_model()
            if on_step is not None:
                on_step(self)

    def _check_model(self) -> None:
        if not len(self.model):
            raise ReconstructionError(
                f"no Gaussian is left at step {self.step}: all became transparent; check the cameras"
            )
        # The rasterizer skips Gaussians that are not finite, so the images do not show them.
        finite = [part.reshape(len(part), -1).isfinite().all(dim=1) for part in _tensors(self.model)]
        lost = sum(int((~rows).sum()) for rows in finite)
        if lost:
            raise ReconstructionError(
                f"training diverged: parameters of {lost} of {len(self.model)} Gaussians are not finite at step"
                f" {self.step}; check the cameras"
            )

    def _check_convergence(self) -> None:
        count, steps, plateau = len(self.photographs), self.schedule.steps, self.schedule.plateau
        if plateau is None or self.step % max(count, steps // 10) or not self.density.is_settled(self):
            return
        full_size = self.step >= count and self.schedule.level(self.step - count) == 0  # for the whole last round
        if full_size:
            self._mean_psnr.append(sum(map(float, self.psnr)) / count)
        earlier = self._mean_psnr[-3:-1]
        self.converged = len(earlier) == 2 and self._mean_psnr[-1] - min(earlier) < plateau

    def rng(self) -> np.random.Generator:
        """Return the generator of this step: a resumed run gets the same random numbers as an uninterrupted one."""
        return np.random.default_rng([self.schedule.seed, 1, self.step])

    def keep(self, rows: Tensor) -> None:
        """Keep the Gaussians selected by indices or a mask, and reset the screen gradients."""
        self.model = self.model.select(rows)
        self.optimizer.select(rows)
        self.screen_gradients = ScreenGradients.zeros(self.model)

    def reorder(self, order: Tensor) -> None:
        """Reorder the Gaussians with their moments and screen gradients."""
        self.model = self.model.select(order)
        self.optimizer.select(order)
        self.screen_gradients = ScreenGradients(*(part[order] for part in self.screen_gradients))

    def add(self, others: Gaussians) -> None:
        """Append Gaussians, and reset the screen gradients."""
        self.model = self.model.concatenate(others)
        self.optimizer.extend(others)
        self.screen_gradients = ScreenGradients.zeros(self.model)

    def snapshot(self) -> Snapshot:
        """Return a copy of the current state for `return_to`."""
        parts = (self.model, self.optimizer.first, self.optimizer.second)
        return Snapshot(self.step, *(Gaussians(*(t.clone() for t in _tensors(part))) for part in parts))

    def return_to(self, snapshot: Snapshot) -> None:
        """Continue from a snapshot, which stays unchanged."""
        self.step = snapshot.step
        self.model, first, second = (Gaussians(*(t.clone() for t in _tensors(part))) for part in snapshot[1:])
        self.optimizer = Optimizer(self.model, self._kernels.adam, first, second)
        self.screen_gradients = ScreenGradients.zeros(self.model)

    def limit_degree(self, degree: int) -> None:
        """Limit the spherical harmonics to a degree from now on."""
        self.schedule = replace(self.schedule, sh_degree=degree)
        if self.model.degree > degree:
            self.model = lower_sh_degree(self.model, degree)
            self.optimizer.lower_degree(degree)

    def train_on(self, photographs: Sequence[Pyramid]) -> None:
        """Train on these photographs from now on."""
        self.photographs = photographs
        self.psnr = [math.nan] * len(photographs)
        self.losses = self.psnr.copy()
        self._mean_psnr = []

    def contributions(self) -> Tensor:
        """Contribution (N,) of each Gaussian: its blending weights summed over the pixels of up to 100 photographs."""
        import torch

        # The gradient of a pixel with respect to the coefficient of degree 0 is the blending weight times SH_DC.
        model = self.model
        tensors = model.tensors._replace(sh=torch.zeros_like(model.sh[:, :1]))
        contributions = model.logits.new_zeros(len(model))
        for pyramid in self.photographs[:: math.ceil(len(self.photographs) / _MAX_CONTRIBUTION_VIEWS)]:
            photograph = pyramid[min(self.schedule.level(self.step), len(pyramid) - 1)]
            rendering = self._rasterizer.forward(tensors, photograph.view, model.means.new_zeros(3), geometry=False)
            ones = torch.ones_like(rendering.color)
            gradients = self._rasterizer.backward(ones, None, None, None)
            contributions[gradients.ids] += gradients.sh[:, 0, 0]
        return contributions / SH_DC

    def _render(self, view: View, background: Tensor, *, geometry: bool = False) -> RasterOutput:
        return self._rasterizer.forward(self.model.tensors, view, background, geometry=geometry, normals=False)

    def _next_photograph(self) -> tuple[int, Photograph]:
        count = len(self.photographs)
        order = np.random.default_rng([self.schedule.seed, 0, self.step // count]).permutation(count)
        index = int(order[self.step % count])
        pyramid = self.photographs[index]
        return index, pyramid[min(self.schedule.level(self.step), len(pyramid) - 1)]

    def _train_step(self) -> None:
        import torch

        schedule, order = self.schedule, self._kernels.morton_order
        if order is not None and self.step % _MORTON_SORT_INTERVAL == 0:
            self.reorder(order(self.model.means))
        if self.model.degree < schedule.degree(self.step):
            self.model = raise_sh_degree(self.model)
            self.optimizer.raise_degree()
        index, photograph = self._next_photograph()
        model = self.model
        background = self.background.behind(photograph, self.rng())
        view = schedule.rendered(photograph.view, self.step)
        rendering = self._render(view, background, geometry=self.supervision is not None)
        gain = 1.0 if self.exposure is None else self.exposure.update(photograph, rendering, background)
        target = photograph.target(gain * background)
        weight = gain if photograph.valid is None else gain * photograph.valid[..., None]
        image = rendering.color * weight
        loss = self._kernels.image_loss(image, target, schedule.ssim_weight)
        gradient = loss.gradient * weight
        depth_gradients = self.supervision.gradients(photograph, rendering) if self.supervision else DepthGradients()
        gradients = self._rasterizer.backward(gradient, depth_gradients.transmittance, depth_gradients.depth, None)
        self.step += 1
        self.background.learn(photograph, gradient, rendering.transmittance, self._kernels.adam, self.step)
        self.optimizer.step(model, gradients, schedule.rates, self.step / schedule.steps, self.step)
        if self.density.needs_screen_gradients:
            self.screen_gradients.add(gradients, photograph.view.width, photograph.view.height)
        self.psnr[index] = _psnr(torch.nn.functional.mse_loss(image, target))
        self.losses[index] = (1 - schedule.ssim_weight) * loss.l1 + schedule.ssim_weight * (1 - loss.ssim)

    def save(self, path: Path, key: str) -> None:
        """Write a checkpoint, which `load` continues only with the same `key`."""
        import torch

        state = {
            "key": key,
            "step": self.step,
            "density": self.density.state(),
            "psnr": self.psnr,
            "means": self._mean_psnr,
            "ended": self.converged,
            "seen": tuple(self.screen_gradients),
            "background": self.background.state(),
            "exposure": None if self.exposure is None else self.exposure.state(),
            "parts": [_tensors(part) for part in (self.model, self.optimizer.first, self.optimizer.second)],
        }
        with atomic_write(path) as file:
            torch.save(state, file)

    def load(self, path: Path, key: str) -> bool:
        """Continue from a checkpoint on this training's device; return False if it has another key."""
        import torch

        state: dict[str, Any] = torch.load(path, map_location=self.model.means.device, weights_only=True)
        if state["key"] != key:
            return False
        self.step, self.screen_gradients = state["step"], ScreenGradients(*state["seen"])
        self.model, first, second = (Gaussians(*part) for part in state["parts"])
        self.optimizer = Optimizer(self.model, self._kernels.adam, first, second)
        self.density.restore(self, state["density"])
        self.background.restore(state["background"])
        if self.exposure is not None:
            self.exposure.restore(state["exposure"])
        self.psnr, self._mean_psnr, self.converged = state["psnr"], state["means"], state["ended"]
        return True


def render(model: Gaussians, view: View, background: Tensor | None = None) -> Tensor:
    """Return the rendered image (H, W, 3) of a view over a color (3,), by default black, clamped to 0 to 1."""
    rasterizer = kernels_of(model.means.device).Rasterizer()
    background = model.means.new_zeros(3) if background is None else background
    return rasterizer.forward(model.tensors, view, background, geometry=False, gradient=False).color.clamp(0, 1)


class ImageScore(NamedTuple):
    """Likeness of a rendering and its photograph, over the valid pixels.

    Attributes:
        psnr: dB.
        ssim: structural similarity (Wang et al. 2004); pixels that are not valid are black in both images.
    """

    psnr: float
    ssim: float


def evaluate(
    model: Gaussians,
    photographs: Sequence[Photograph],
    background: Tensor | None = None,
    *,
    fit_exposure: bool = False,
) -> list[ImageScore]:
    """Return the score of each photograph.

    Args:
        model: the Gaussians.
        photographs: the photographs.
        background: (3,) color behind the Gaussians, by default black.
        fit_exposure: whether to multiply each rendering by the gain that fits its photograph best.
    """
    background = model.means.new_zeros(3) if background is None else background
    scores = []
    for photograph in photographs:
        rendering, target = render(model, photograph.view, background), photograph.over(background)
        if fit_exposure:
            rendering = (rendering * least_squares_gain(target, rendering, photograph.valid)).clamp(0, 1)
        if photograph.valid is not None:
            rendering, target = (image * photograph.valid[..., None] for image in (rendering, target))
        square = (rendering - target) ** 2
        valid = square if photograph.valid is None else square[photograph.valid]
        ssim = kernels_of(model.means.device).image_loss(rendering.contiguous(), target.contiguous(), 1.0).ssim
        scores.append(ImageScore(float(_psnr(valid.double().mean())), float(ssim)))
    return scores


def _mean_of_known(values: Sequence[float | Tensor]) -> float:
    numbers = [value for value in map(float, values) if not math.isnan(value)]
    return float(np.mean(numbers)) if numbers else math.nan


def _psnr(mean_square: Tensor) -> Tensor:
    return -10 * mean_square.clamp(min=1e-10).log10()


def _tensors(part: Gaussians) -> tuple[Tensor, ...]:
    return tuple(getattr(part, f.name) for f in fields(part))
