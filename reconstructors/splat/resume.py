"""Training with checkpoints and progress messages, and files of trained models."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, Self, TypeVar

from pcbench.io.contents import digest
from pcbench.plugins.progress import progress
from pcbench.progress import duration
from pcbench.scratch import atomic_write
from reconstructors.splat.model import Gaussians

if TYPE_CHECKING:
    import torch

_CHECKPOINT_INTERVAL_S = 30.0  # seconds between two checkpoints: the most work that a kill loses
_PROGRESS_INTERVAL_S = 2.0  # seconds between two progress messages
_FIRST_PREVIEW_S, _PREVIEW_INTERVAL_S = 2.0, 10.0  # seconds until the first preview, and at least between two
_MAX_PREVIEW_SHARE = 0.03  # of the time that previews take


Model_co = TypeVar("Model_co", covariant=True)


class Resumable(Protocol[Model_co]):
    """A training of a model that writes and reads checkpoints."""

    step: int
    converged: bool

    @property
    def model(self) -> Model_co:
        """The model in its current state."""
        ...

    @property
    def steps(self) -> int:
        """Number of steps until the end."""
        ...

    def status(self) -> str:
        """Return quality and size of the model for a progress message."""
        ...

    def run(self, until: int, on_step: Callable[[Self], None] | None = None) -> None:
        """Train up to a step or until convergence, calling `on_step` after each step."""
        ...

    def save(self, path: Path, key: str) -> None:
        """Write a checkpoint, which `load` continues only with the same `key`."""
        ...

    def load(self, path: Path, key: str) -> bool:
        """Continue from a checkpoint; return False if it has another key."""
        ...


def run_with_checkpoints(
    training: Resumable[Model_co], checkpoint: Path, key: str, show: Callable[[Any, int], None] | None = None
) -> Model_co:
    """Train to the end and return the model; resume from `checkpoint` if it exists, and remove it afterwards.

    Args:
        training: the training at its start.
        checkpoint: file of the checkpoints.
        key: everything that the model depends on; a checkpoint with another key, or a damaged one, is not used.
        show: called with the training and the number of steps that this run has done, from time to time and at the end.
    """
    if not (_is_intact(checkpoint) and training.load(checkpoint, key)):
        _remove(checkpoint)
    total, start, steps_run = training.steps, time.monotonic(), 0
    last_checkpoint = last_message = start
    next_preview = start + _FIRST_PREVIEW_S

    def on_step(training: Resumable[Model_co]) -> None:
        nonlocal last_checkpoint, last_message, next_preview, steps_run
        now = time.monotonic()
        steps_run += 1  # not the difference of steps, which may go back
        if now - last_message > _PROGRESS_INTERVAL_S:
            seconds_left = (now - start) / steps_run * (total - training.step)
            progress(
                f"training: step {training.step:,} of {total:,}, {training.status()}, {duration(seconds_left)} left"
            )
            last_message = now
        if now - last_checkpoint > _CHECKPOINT_INTERVAL_S:
            save_checkpoint(training, checkpoint, key)
            last_checkpoint = time.monotonic()
        if show is not None and now > next_preview:
            begin = time.monotonic()
            show(training, steps_run)
            end = time.monotonic()
            next_preview = end + max(_PREVIEW_INTERVAL_S, (end - begin) / _MAX_PREVIEW_SHARE)

    training.run(total, on_step)
    if show is not None:
        show(training, steps_run)
    if training.converged:
        progress(f"training converged at step {training.step:,} of {total:,}: the photographs no longer improve")
    _remove(checkpoint)
    return training.model


def save_checkpoint(training: Resumable[Any], checkpoint: Path, key: str) -> None:
    """Write a checkpoint, and its digest beside it."""
    training.save(checkpoint, key)
    with atomic_write(_digest_file(checkpoint)) as file:
        file.write(digest(checkpoint).encode())


def _is_intact(checkpoint: Path) -> bool:
    """Return whether there is a checkpoint with the content that was written."""
    try:
        return _digest_file(checkpoint).read_text(encoding="ascii") == digest(checkpoint)
    except (OSError, ValueError):
        return False


def _digest_file(checkpoint: Path) -> Path:
    return checkpoint.with_name(f"{checkpoint.name}.sha256")


def _remove(checkpoint: Path) -> None:
    for file in (_digest_file(checkpoint), checkpoint):
        file.unlink(missing_ok=True)


def save_model(path: Path, model: Gaussians) -> None:
    """Write the parameters of a model as they are trained, in its local frame."""
    import torch

    with atomic_write(path) as file:
        torch.save([getattr(model, field.name) for field in fields(model)], file)


def load_model(path: Path, device: torch.device | str = "cpu") -> Gaussians:
    """Return the model that `save_model` wrote, on a device; it may have been saved from another one."""
    import torch

    return Gaussians(*torch.load(path, map_location=device, weights_only=True))
