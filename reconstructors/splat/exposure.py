"""Brightness of the training photographs relative to the model: one gain for each, solved while training.

Cameras choose the exposure of each photograph. Without gains, training explains the differences by colors that depend
on the direction and by Gaussians that only some photographs see. Martin-Brualla et al. 2021 (NeRF in the Wild) learn a
vector for each photograph; one number is enough for its exposure.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pcbench.scratch import atomic_write
from reconstructors.splat.photographs import Photograph

if TYPE_CHECKING:
    import torch
    from torch import Tensor

    from reconstructors.splat.interface import RasterOutput

_MAX_GAIN = 4.0  # the minimum is its inverse
_MAX_MIXTURE = 0.1  # share of the background at pixels of a surface that count, or of a surface at those of background
_MIN_BRIGHTNESS = 0.05  # of rendered pixels that count, from 0 to 1


class Exposure:
    """Gains of photographs: brightness of each relative to its rendering. Their geometric mean is 1.

    Args:
        names: names of all photographs that training uses.
        device: device of the photographs.
    """

    def __init__(self, names: Iterable[str], device: torch.device | str = "cpu"):
        import torch

        self._rows = {name: row for row, name in enumerate(names)}
        self._gains = torch.ones(len(self._rows), dtype=torch.float64, device=device)

    def update(self, photograph: Photograph, rendering: RasterOutput, background: Tensor) -> Tensor:
        """Solve and return the gain of a photograph.

        Args:
            photograph: the photograph.
            rendering: its current rendering.
            background: (3,) color behind the Gaussians; the gain of transparent photographs does not depend on it.
        """
        rendered = rendering.color
        if photograph.alpha is not None:
            rendered = rendered - rendering.transmittance[..., None] * background
        transmittance = rendering.transmittance
        is_reliable = (transmittance < _MAX_MIXTURE) | (transmittance > 1 - _MAX_MIXTURE)
        if photograph.valid is not None:
            is_reliable &= photograph.valid
        row = self._rows[photograph.name]
        self._gains[row] = median_gain(photograph.color.float() / 255, rendered, is_reliable)
        self._gains /= self._gains.log().mean().exp()
        return self._gains[row].to(rendered.dtype)

    @property
    def gains(self) -> dict[str, float]:
        """The gains by name."""
        return dict(zip(self._rows, self._gains.tolist(), strict=True))

    def state(self) -> Tensor:
        """Return the gains for a checkpoint."""
        return self._gains

    def restore(self, state: Tensor) -> None:
        """Continue from a checkpoint."""
        self._gains = state


def median_gain(target: Tensor, rendered: Tensor, is_reliable: Tensor) -> Tensor:
    """Return the median ratio of the brightness of an image (H, W, 3) and its rendering, over the reliable pixels.

    Very dark pixels and three of four others are left out. The ratio is 1 if no pixel is left, and limited to 1/4 to 4.
    """
    bright, base = target[::2, ::2].mean(dim=2), rendered[::2, ::2].mean(dim=2)
    counts = is_reliable[::2, ::2] & (base > _MIN_BRIGHTNESS)
    ratio = (bright / base).where(counts, bright.new_tensor(np.nan)).nanmedian()
    return ratio.nan_to_num(1.0).clamp(1 / _MAX_GAIN, _MAX_GAIN)


def least_squares_gain(target: Tensor, rendered: Tensor, valid: Tensor | None) -> Tensor:
    """Return the factor from a rendering to an image (H, W, 3) with the highest PSNR over the valid pixels (H, W)."""
    if valid is not None:
        rendered = rendered * valid[..., None]
    return (rendered * target).double().mean() / (rendered**2).double().mean().clamp(min=1e-6)


def write_gains(path: Path, gains: Mapping[str, float]) -> None:
    """Write a CSV file with the name and the gain of each photograph."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerows([("image", "gain"), *((name, f"{gain:.6f}") for name, gain in gains.items())])
    with atomic_write(path) as file:
        file.write(text.getvalue().encode())


def read_gains(path: Path) -> dict[str, float]:
    """Return the gains that `write_gains` wrote."""
    _, *rows = csv.reader(path.read_text(encoding="utf-8").splitlines())
    return {name: float(gain) for name, gain in rows}
