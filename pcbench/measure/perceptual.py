"""Perceptual image metrics, if their packages are installed: LPIPS and FLIP.

They are trained on or fitted to human judgements, so only the authors' own code defines them.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcbench.errors import MissingExtra, Notice
from pcbench.extras import import_problem, require
from pcbench.measure.images import ViewScores, psnr, ssim, unit_range

_WEIGHTS = "vgg16-397923af.pth"  # torchvision's file of VGG-16's weights, trained on ImageNet

Metric = Callable[[NDArray[Any], NDArray[Any], "NDArray[np.bool_] | None"], float]


@dataclass(frozen=True)
class Perceptual:
    """The available metrics, and notices about the missing ones.

    Attributes:
        lpips: Zhang et al. 2018, "The unreasonable effectiveness of deep features", from the package `lpips`, with VGG
            as papers on view synthesis report it, on values from -1 to 1 as the package expects.
        flip: Andersson et al. 2020, "FLIP: a difference evaluator for alternating images", from the package
            `flip-evaluator`, at its default of 67 pixels per degree.
        missing: a notice for each metric that is None.
    """

    lpips: Metric | None
    flip: Metric | None
    missing: tuple[Notice, ...] = ()

    @classmethod
    def find_available(cls) -> Perceptual:
        """Return the metrics that are available without a download; LPIPS needs the weights of its network."""
        lpips, without_lpips = _find_lpips()
        flip, without_flip = _find_flip()
        return cls(lpips, flip, tuple(notice for notice in (without_lpips, without_flip) if notice is not None))

    def scores(self, image: NDArray[Any], reference: NDArray[Any], mask: NDArray[np.bool_] | None = None) -> ViewScores:
        """Return all scores of a rendering against its photograph.

        For LPIPS and FLIP, masked pixels get the photograph's colours, and the mean is over the valid pixels.

        Args:
            image: (H, W, 3), uint8 or floating point from 0 to 1.
            reference: the same.
            mask: (H, W) valid pixels; None: all.

        Raises:
            InputError: the shapes differ or are invalid, or the values are neither uint8 nor floating point.
        """
        measured = psnr(image, reference, mask), ssim(image, reference, mask)
        a, b = unit_range(image), unit_range(reference)
        if mask is not None:
            a = np.where(mask[..., None], a, b)
        lpips, flip = (None if metric is None else metric(a, b, mask) for metric in (self.lpips, self.flip))
        return ViewScores(*measured, lpips, flip)


def _find_lpips() -> tuple[Metric | None, Notice | None]:
    def missing(why: str) -> tuple[None, Notice]:
        return None, Notice("no-lpips", f"LPIPS is not measured: {why}")

    if find_spec("lpips") is None or find_spec("torch") is None:  # torch takes seconds to load
        return missing("the package lpips is not installed (pip install lpips)")
    if why := import_problem("torch"):
        return missing(why)
    import torch

    weights = Path(torch.hub.get_dir()) / "checkpoints" / _WEIGHTS
    if not weights.is_file():
        return missing(
            f"{weights} is missing and is not downloaded automatically; get it from https://download.pytorch.org/models/"
        )
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # lpips calls torchvision with deprecated arguments
            lpips = require("lpips")
            network = lpips.LPIPS(net="vgg", verbose=False)
    except (MissingExtra, RuntimeError, OSError) as error:  # incompatible versions of torch and torchvision
        return missing(f"it does not load ({' '.join(str(error).split())})")

    def measure(image: NDArray[Any], reference: NDArray[Any], mask: NDArray[np.bool_] | None) -> float:
        tensors = (torch.from_numpy(2 * part.transpose(2, 0, 1)[None] - 1).float() for part in (image, reference))
        with torch.no_grad():
            whole = float(network(*tensors))
        # Masked pixels are equal and contribute zero: rescale the mean over all pixels to the unmasked ones.
        share = 1.0 if mask is None else float(mask.mean())
        return whole / share if share else float("nan")

    return measure, None


def _find_flip() -> tuple[Metric | None, Notice | None]:
    if why := import_problem("flip_evaluator"):
        return None, Notice("no-flip", f"FLIP is not measured: {why}")

    def measure(image: NDArray[Any], reference: NDArray[Any], mask: NDArray[np.bool_] | None) -> float:
        from flip_evaluator import evaluate

        parts = (np.ascontiguousarray(part, dtype=np.float32) for part in (reference, image))
        errors = np.asarray(evaluate(*parts, "LDR", applyMagma=False)[0], dtype=np.float64)
        errors = errors.reshape(image.shape[:2])
        counted = errors if mask is None else errors[mask]
        return float(counted.mean()) if counted.size else float("nan")

    return measure, None
