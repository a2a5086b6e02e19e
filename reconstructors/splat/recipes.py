"""Recipes: the settings of a training that are not given, by default ours, and those of Gao et al. 2025."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

from pcbench.geometry.cameras import Camera
from reconstructors.splat.density import Classic
from reconstructors.splat.optimizer import LearningRates
from reconstructors.splat.train import Schedule

DensityName = Literal["parsimonious", "fixed", "classic", "gao2025"]


@dataclass(frozen=True)
class Recipe:
    """Defaults of a density setting.

    Attributes:
        steps: number of training steps.
        gaussians: maximum number of Gaussians.
        sh_degree: degree of the spherical harmonics.
        image_side: maximum length of a photograph's longer side, in pixels; None: a share of the photograph's.
        image_share: share of a photograph's sides if `image_side` is None.
        schedule: what changes during training; its steps, degree and seed are replaced.
        densification: rules that add and prune Gaussians; None for none.
    """

    steps: int = 3000
    gaussians: int = 50_000
    sh_degree: int = 2
    image_side: int | None = 640
    image_share: float = 1.0
    schedule: Schedule = field(default_factory=Schedule)
    densification: Classic | None = None

    def side(self, camera: Camera) -> int:
        """Return the maximum length of the longer side of a camera's photograph, in pixels."""
        longer = max(camera.intrinsics.width, camera.intrinsics.height)
        return self.image_side or max(1, round(self.image_share * longer))


# Where depths hold the Gaussians on the surface, means learn at four times and scales at twice the rate, so that short
# trainings suffice. Without depths Gaussians leave the surface, and with `classic` the views get worse.
SUPERVISED_RATES = LearningRates(means=1.92e-3, means_final=1.92e-5, log_scales=3e-2)

_OURS = Recipe()
# Settings that Gao et al. give, and those of Kerbl et al.'s code for all others. docs/paper.md has a table of both.
_GAO2025 = Recipe(
    steps=50_000,
    gaussians=2_000_000,
    sh_degree=3,
    image_side=None,
    image_share=1 / 4,
    schedule=Schedule(
        degree_interval=1000,
        downscale_shares=(0.0, 0.0),
        min_alpha=1 / 255,
        plateau=None,
        rates=LearningRates(3.2e-5, 3.2e-7, 1e-3, 2e-3, 0.05, 2.5e-3, 1.25e-4, update_all=True),
    ),
    densification=Classic(refine_start=1000),
)
RECIPES: dict[DensityName, Recipe] = {
    "parsimonious": replace(_OURS, gaussians=100_000),
    "fixed": _OURS,
    "classic": replace(_OURS, densification=Classic()),
    "gao2025": _GAO2025,
}


def choose_recipe(density: DensityName, *, supervised: bool) -> Recipe:
    """Return the recipe of a density setting, with the learning rates of the training.

    Args:
        density: density setting.
        supervised: whether depths supervise the training, which then learns faster if it does not densify.
    """
    recipe = RECIPES[density]
    if not supervised or recipe.densification is not None:
        return recipe
    return replace(recipe, schedule=replace(recipe.schedule, rates=SUPERVISED_RATES))
