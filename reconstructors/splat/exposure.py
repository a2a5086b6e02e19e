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

from pcbench.io.files import atomic_write
from reconstructors.splat.photographs import Photograph

if TYPE_CHECKING:
    import torch
    from torch import Tensor

    from reconstructors.splat.interface import RasterOutput

_MAX_GAIN = 4.0  # and least: its inverse


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
        row = self._rows[photograph.name]
        self._gains[row] = best_gain(photograph.color.float() / 255, rendered, photograph.valid)
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


def best_gain(target: Tensor, rendered: Tensor, valid: Tensor | None) -> Tensor:
    """Return the least-squares factor from a rendering to an image (H, W, 3), over the valid pixels (H, W)."""
    target, rendered = target.double(), rendered.double()
    if valid is not None:
        rendered = rendered * valid[..., None]
    # First over the pixels of each channel: such sums have the same bits with any number of threads.
    products, squares = ((rendered * image).sum(dim=(0, 1)).sum() for image in (target, rendered))
    return (products / squares.clamp(min=1e-6)).clamp(1 / _MAX_GAIN, _MAX_GAIN)


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
