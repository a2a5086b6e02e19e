"""Adam over the parameters of a model; each step updates the Gaussians that were drawn, or all."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING

from reconstructors.splat.interface import Adam, Gradients
from reconstructors.splat.model import Gaussians

if TYPE_CHECKING:
    from torch import Tensor


@dataclass(frozen=True)
class LearningRates:
    """Learning rates per step. The rate of the means decays exponentially from `means` to `means_final`.

    The defaults are three times those of Kerbl et al. 2023, for means in units of the cameras' spread: theirs are for
    30,000 steps, and a CPU has time for a tenth of them. With `update_all`, Gaussians that were not drawn move on by
    their moments, as in their code; without, they stay, which is faster.
    """

    means: float = 4.8e-4
    means_final: float = 4.8e-6
    quats: float = 3e-3
    log_scales: float = 1.5e-2
    logits: float = 0.15
    sh_dc: float = 7.5e-3
    sh_rest: float = 3.75e-4
    update_all: bool = False

    def means_at(self, share: float) -> float:
        """Return the rate of the means after a share (0 to 1) of the steps."""
        ratio = self.means_final / self.means
        return float(self.means * ratio ** min(share, 1.0))


class Optimizer:
    """Adam's moments of each parameter of a model, which follow the changes of the model."""

    def __init__(self, model: Gaussians, step: Adam, first: Gaussians | None = None, second: Gaussians | None = None):
        self._adam = step
        self.first = first or _zeros(model)
        self.second = second or _zeros(model)

    def step(self, model: Gaussians, gradients: Gradients, rates: LearningRates, share: float, count: int) -> None:
        """Update the model, in place.

        Args:
            model: the Gaussians.
            gradients: gradients of the loss with respect to them.
            rates: learning rates, and whether Gaussians that were not drawn move on by their moments.
            share: share of the steps that are done, 0 to 1.
            count: number of steps, this one included.
        """
        import torch

        ids = gradients.ids
        updated = torch.arange(len(model), dtype=ids.dtype, device=ids.device) if rates.update_all else ids
        opacities, scales = model.logits[ids].sigmoid(), model.log_scales[ids].exp()
        bands = model.sh.shape[1]
        parameter_gradients = {
            "means": gradients.means,
            "quats": gradients.quats,
            "log_scales": gradients.scales * scales,
            "logits": (gradients.opacities * opacities * (1 - opacities))[:, None],
            "sh": gradients.sh.reshape(len(ids), 3 * bands),
        }
        sh_rates = model.sh.new_full((3 * bands,), rates.sh_rest)
        sh_rates[:3] = rates.sh_dc
        parameter_rates: dict[str, float | Tensor] = {
            "means": rates.means_at(share),
            "quats": rates.quats,
            "log_scales": rates.log_scales,
            "logits": rates.logits,
            "sh": sh_rates,
        }
        for name, gradient in parameter_gradients.items():
            if rates.update_all:
                gradient = gradient.new_zeros((len(model), gradient.shape[1])).index_copy(0, ids, gradient)
            parameters, first, second = (
                getattr(part, name).view(len(model), gradient.shape[1]) for part in (model, self.first, self.second)
            )
            self._adam(parameters, first, second, gradient, updated, parameter_rates[name], count)

    def select(self, rows: Tensor) -> None:
        """Keep the moments of the Gaussians selected by indices or a mask."""
        self.first, self.second = self.first.select(rows), self.second.select(rows)

    def extend(self, others: Gaussians) -> None:
        """Append zero moments for new Gaussians."""
        self.first, self.second = self.first.concatenate(_zeros(others)), self.second.concatenate(_zeros(others))

    def forget(self, name: str) -> None:
        """Reset the moments of one kind of parameter to zero."""
        getattr(self.first, name).zero_()
        getattr(self.second, name).zero_()

    def raise_degree(self) -> None:
        """Append zero moments after the degree of the model's spherical harmonics was raised by one."""
        self.first, self.second = raise_sh_degree(self.first), raise_sh_degree(self.second)

    def lower_degree(self, degree: int) -> None:
        """Drop the moments above a degree to which the model's spherical harmonics were lowered."""
        self.first, self.second = lower_sh_degree(self.first, degree), lower_sh_degree(self.second, degree)


def raise_sh_degree(model: Gaussians) -> Gaussians:
    """Return the model with spherical harmonics of one degree more, whose coefficients are 0."""
    bands = (model.degree + 2) ** 2
    grown = model.sh.new_zeros((len(model), bands, 3))
    grown[:, : model.sh.shape[1]] = model.sh
    return replace(model, sh=grown)


def lower_sh_degree(model: Gaussians, degree: int) -> Gaussians:
    """Return the model with spherical harmonics of a lower degree."""
    return replace(model, sh=model.sh[:, : (degree + 1) ** 2].contiguous())


def _zeros(model: Gaussians) -> Gaussians:
    import torch

    return Gaussians(*(torch.zeros_like(getattr(model, field.name)) for field in fields(model)))
