"""The color behind the Gaussians: fixed, or learned together with them.

If the color differs from that of the sky or of a studio's backdrop, training explains the difference by Gaussians
just before the cameras, which hide the scene from new views. If photographs show surfaces everywhere, black is better:
a learned color approaches theirs, and then they need not become opaque.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pcbench.geometry.arrays import FloatArray
from reconstructors.splat.interface import Adam
from reconstructors.splat.photographs import Photograph

if TYPE_CHECKING:
    import torch
    from torch import Tensor

BackgroundChoice = Literal["auto", "black", "white", "learned"]
"""`auto` learns the color if photographs show a background, and is black otherwise; see `Background.choose`."""

_LEARNING_RATE = 0.02  # per step of Adam, for colors from 0 to 1
_COLORS = {"black": 0.0, "white": 1.0}
# Photographs show a background if pixels of one color are this share of the border of the median photograph. It is
# 0.31 to 0.61 in scenes with sky or a white backdrop, 0.11 to 0.17 in four others.
_MIN_BORDER_SHARE = 0.25
_BIN_LEVELS, _MAX_DIFFERENCE = 16, 12  # levels of 255: bins of the most frequent color, and differences from it


class Background:
    """The color behind the Gaussians during training.

    Attributes:
        color: (1, 3) from 0 to 1.
        is_learned: whether opaque photographs change the color.
        is_random: whether photographs with an alpha channel are trained over a random color in each step. Only a model
            that is transparent in the same places fits all of these colors.
    """

    def __init__(
        self,
        color: ArrayLike = (0.0, 0.0, 0.0),
        device: torch.device | str = "cpu",
        *,
        is_learned: bool = False,
        is_random: bool = False,
    ):
        import torch

        self.color = torch.tensor(np.reshape(color, (1, 3)), dtype=torch.float32, device=device)
        self.is_learned, self.is_random = is_learned, is_random
        self._first, self._second = torch.zeros_like(self.color), torch.zeros_like(self.color)

    @classmethod
    def choose(cls, choice: BackgroundChoice, photographs: Iterable[Photograph]) -> Background:
        """Return the background for photographs, on their device.

        `auto` learns the color if one color dominates the border of the opaque photographs, and is black otherwise. If
        all photographs have an alpha channel, it is white, as in published scores of such scenes.
        """
        photographs = list(photographs)
        device = photographs[0].color.device
        if choice in _COLORS:
            return cls([_COLORS[choice]] * 3, device)
        opaque = [photograph for photograph in photographs if photograph.alpha is None]
        if not opaque:
            return cls([_COLORS["white"]] * 3, device, is_random=True)
        color, share = dominant_border_color(opaque)
        if choice == "auto" and share < _MIN_BORDER_SHARE:
            return cls(device=device, is_random=True)
        return cls(color, device, is_learned=True, is_random=True)

    def behind(self, photograph: Photograph, rng: np.random.Generator) -> Tensor:
        """Return the color (3,) behind a photograph in a step of training."""
        if photograph.alpha is None or not self.is_random:
            return self.color[0]
        return self.color.new_tensor(rng.random(3))

    def learn(self, photograph: Photograph, gradient: Tensor, transmittance: Tensor, adam: Adam, step: int) -> None:
        """Improve the color.

        Args:
            photograph: the photograph of the step.
            gradient: (H, W, 3) gradient of the loss with respect to the rendered color.
            transmittance: (H, W) rendered transmittance.
            adam: step of the optimizer.
            step: number of steps, this one included.
        """
        if not self.is_learned or photograph.alpha is not None:
            return
        rows = (gradient * transmittance[..., None]).double().sum(dim=(0, 1), keepdim=True)[0].to(gradient.dtype)
        first_row = rows.new_zeros(1).long()
        adam(self.color, self._first, self._second, rows, first_row, _LEARNING_RATE, step)
        self.color.clamp_(0, 1)

    def state(self) -> tuple[Tensor, ...]:
        """Return the color and its moments for a checkpoint."""
        return self.color, self._first, self._second

    def restore(self, state: tuple[Tensor, ...]) -> None:
        """Continue from a checkpoint."""
        self.color, self._first, self._second = state


def dominant_border_color(photographs: Iterable[Photograph]) -> tuple[FloatArray, float]:
    """Return the color (3,) from 0 to 1 that is most frequent at the borders, and its share of the border pixels.

    Both are medians over the photographs. Masked pixels do not count; if all are masked, the color is black and the
    share 0.
    """
    colors = []
    for photograph in photographs:
        pixels = _border(photograph.color.cpu().numpy())
        if photograph.valid is not None:
            pixels = pixels[_border(photograph.valid.cpu().numpy())]
        if len(pixels):
            _, rows, counts = np.unique(pixels // _BIN_LEVELS, axis=0, return_inverse=True, return_counts=True)
            color = pixels[rows.reshape(-1) == counts.argmax()].mean(axis=0)
            share = (np.abs(pixels - color) <= _MAX_DIFFERENCE).all(axis=1).mean()
            colors.append([*color / 255, share])
    *color, share = np.median(colors, axis=0) if colors else np.zeros(4)
    return np.array(color), float(share)


def _border(image: NDArray[Any]) -> NDArray[Any]:
    """Return the pixels of an image along its border."""
    return np.concatenate([image[0], image[-1], image[:, 0], image[:, -1]])
