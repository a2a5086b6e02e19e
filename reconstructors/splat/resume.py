"""Training that goes on where it was killed, and says how far it is."""

from __future__ import annotations

import math
import time
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pcbench.io.files import atomic_write
from pcbench.plugins.progress import progress
from pcbench.progress import duration
from reconstructors.splat.model import Gaussians
from reconstructors.splat.train import Training

if TYPE_CHECKING:
    import torch

_SAVED_S = 30.0  # seconds between two checkpoints: what a kill loses at most
_SAID_S = 2.0  # seconds between two lines of progress


def trained(training: Training, checkpoint: Path, key: str) -> Gaussians:
    """The model after all steps that help. A run that was killed goes on from `checkpoint`, which is removed at last.

    Args:
        key: all that the model depends on; a checkpoint of another is not used.
    """
    if checkpoint.is_file() and not training.load(checkpoint, key):
        checkpoint.unlink()
    total, start, worked = training.schedule.steps, time.monotonic(), 0
    saved = said = start

    def each(now: Training) -> None:
        nonlocal saved, said, worked
        clock = time.monotonic()
        worked += 1  # the number of the step may go back
        if clock - said > _SAID_S:
            left = (clock - start) / worked * (total - now.step)
            seen = [value for value in map(float, now.psnr) if not math.isnan(value)]
            progress(
                f"training: step {now.step:,} of {total:,}, {np.mean(seen):.1f} dB, {len(now.model):,} Gaussians,"
                f" {duration(left)} left"
            )
            said = clock
        if clock - saved > _SAVED_S:
            now.save(checkpoint, key)
            saved = time.monotonic()

    training.run(total, each)
    if training.ended:
        progress(f"training ended at step {training.step:,} of {total:,}: the photographs get no better")
    checkpoint.unlink(missing_ok=True)
    return training.model


def save_model(path: Path, model: Gaussians) -> None:
    """Write the numbers of a model as they are trained."""
    import torch

    with atomic_write(path) as file:
        torch.save([getattr(model, field.name) for field in fields(model)], file)


def load_model(path: Path, device: torch.device | str = "cpu") -> Gaussians:
    """What `save_model` wrote, on a device; it may have been another."""
    import torch

    return Gaussians(*torch.load(path, map_location=device, weights_only=True))
