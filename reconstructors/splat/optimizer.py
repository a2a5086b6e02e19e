"""Adam over the numbers of a model, of which each step moves those that were seen."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING

from reconstructors.splat.interface import Adam, Pulled
from reconstructors.splat.model import Gaussians

if TYPE_CHECKING:
    from torch import Tensor


@dataclass(frozen=True)
class Rates:
    """Learning rates a step. Those of means fall exponentially from the first to the last.

    The defaults are three times those of Kerbl et al. 2023, whose means are in units of the cameras' spread: theirs are
    for 30,000 steps, of which a CPU has the time for a tenth.
    """

    means: float = 4.8e-4
    means_last: float = 4.8e-6
    quats: float = 3e-3
    log_scales: float = 1.5e-2
    logits: float = 0.15
    sh_dc: float = 7.5e-3
    sh_rest: float = 3.75e-4

    def means_at(self, share: float) -> float:
        """Where `share` (0 to 1) of the steps is done."""
        ratio = self.means_last / self.means
        return float(self.means * ratio ** min(share, 1.0))


# The figures of Gao et al.; what they leave out is as Kerbl et al. have it.
GAO2025_RATES = Rates(3.2e-5, 3.2e-7, 1e-3, 2e-3, 0.05, 2.5e-3, 1.25e-4)


class Optimizer:
    """The moments of Adam of each number of a model, and what changes when the model does."""

    def __init__(self, model: Gaussians, step: Adam, first: Gaussians | None = None, second: Gaussians | None = None):
        self._adam = step
        self.first = first or _zeros(model)
        self.second = second or _zeros(model)

    def step(self, model: Gaussians, pulled: Pulled, rates: Rates, share: float, count: int) -> None:
        """Move the model, in place, against the derivatives by means, quaternions, scales, opacities and harmonics.

        Args:
            share: of the steps that are done, 0 to 1.
            count: of steps, this one included.
        """
        ids = pulled.ids
        opacities, scales = model.logits[ids].sigmoid(), model.log_scales[ids].exp()
        bands = model.sh.shape[1]
        by = {
            "means": pulled.means,
            "quats": pulled.quats,
            "log_scales": pulled.scales * scales,
            "logits": (pulled.opacities * opacities * (1 - opacities))[:, None],
            "sh": pulled.sh.reshape(len(ids), 3 * bands),
        }
        sh_rates = model.sh.new_full((3 * bands,), rates.sh_rest)
        sh_rates[:3] = rates.sh_dc
        learning: dict[str, float | Tensor] = {
            "means": rates.means_at(share),
            "quats": rates.quats,
            "log_scales": rates.log_scales,
            "logits": rates.logits,
            "sh": sh_rates,
        }
        for name, gradient in by.items():
            parameters, first, second = (
                getattr(part, name).view(len(model), gradient.shape[1]) for part in (model, self.first, self.second)
            )
            self._adam(parameters, first, second, gradient, ids, learning[name], count)

    def select(self, rows: Tensor) -> None:
        """Keep the moments of some Gaussians."""
        self.first, self.second = self.first.select(rows), self.second.select(rows)

    def extend(self, others: Gaussians) -> None:
        """Begin with Gaussians that are new."""
        self.first, self.second = self.first.joined(_zeros(others)), self.second.joined(_zeros(others))

    def forget(self, name: str) -> None:
        """Begin anew with one kind of number."""
        getattr(self.first, name).zero_()
        getattr(self.second, name).zero_()

    def raise_degree(self) -> None:
        """The model has harmonics of one degree more."""
        self.first, self.second = more_harmonics(self.first), more_harmonics(self.second)

    def lower_degree(self, degree: int) -> None:
        """The model has harmonics of this degree, which is less."""
        self.first, self.second = fewer_harmonics(self.first, degree), fewer_harmonics(self.second, degree)


def more_harmonics(model: Gaussians) -> Gaussians:
    """The same with harmonics of one degree more, which are 0."""
    bands = (model.degree + 2) ** 2
    grown = model.sh.new_zeros((len(model), bands, 3))
    grown[:, : model.sh.shape[1]] = model.sh
    return replace(model, sh=grown)


def fewer_harmonics(model: Gaussians, degree: int) -> Gaussians:
    """The same with harmonics of this degree, which is less."""
    return replace(model, sh=model.sh[:, : (degree + 1) ** 2].contiguous())


def _zeros(model: Gaussians) -> Gaussians:
    import torch

    return Gaussians(*(torch.zeros_like(getattr(model, field.name)) for field in fields(model)))
