"""Previews of a training, for those who watch it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pcbench.errors import InputError
from pcbench.scenes.previews import Preview, Progress, read_preview, write_preview
from reconstructors.splat import extract
from reconstructors.splat.model import LocalFrame
from reconstructors.splat.parsimony import Parsimonious
from reconstructors.splat.photographs import Photograph
from reconstructors.splat.train import Training, evaluate, render

if TYPE_CHECKING:
    from torch import Tensor

_MAX_SCORED = 8  # held-out photographs whose PSNR is computed
_MAX_POINTS = 200_000
_MIN_OPACITY = 0.1  # of the Gaussians whose means are shown; nearly transparent ones may lie anywhere


class PreviewWriter:
    """Writes the state of a training to a folder, each time that it is called.

    Args:
        folder: folder of the preview.
        key: identifies the training, see `Preview`.
        frame: frame of the model.
        photographs: training photographs; one of them is shown if none is held out.
        held_out: held-out photographs.
    """

    def __init__(
        self,
        folder: Path,
        key: str,
        frame: LocalFrame,
        photographs: Sequence[Photograph],
        held_out: Sequence[Photograph],
    ) -> None:
        self._folder, self._key, self._frame = folder, key, frame
        self._shown, self._is_held_out = (held_out or photographs)[0], bool(held_out)
        self._scored = held_out[:: math.ceil(len(held_out) / _MAX_SCORED)] if held_out else []
        self._history = self._earlier_history()
        self._done = self._history[-1].done if self._history else None

    def __call__(self, training: Training, steps_run: int) -> None:
        """Write the preview of a training at its current step, after a number of steps of this run."""
        if self._done is None:
            self._done = training.step - steps_run  # of a checkpoint without preview
        if math.isnan(training.mean_psnr):  # it was just given other photographs
            return
        model, background = training.model, training.background.color[0]
        scores = evaluate(model, self._scored, background, fit_exposure=training.exposure is not None)
        held_out = float(np.mean([score.psnr for score in scores])) if scores else None
        state = Progress(
            self._done + steps_run, training.step, training.mean_loss, training.mean_psnr, held_out, len(model)
        )
        self._history.append(state)
        try:
            points = extract.means(model, self._frame, min_opacity=_MIN_OPACITY)
        except InputError:  # all are nearly transparent
            points = extract.means(model, self._frame)
        points = points.select(np.arange(0, len(points), math.ceil(len(points) / _MAX_POINTS)))
        curve = training.density.curve if isinstance(training.density, Parsimonious) else None
        write_preview(
            self._folder,
            Preview(
                self._key,
                training.steps,
                self._shown.name,
                self._is_held_out,
                tuple(self._history),
                () if curve is None else tuple(curve.size_scores),
                "" if curve is None else curve.sentence,
            ),
            _to_bytes(render(model, self._shown.view, background)),
            _to_bytes(self._shown.over(background)),
            points,
        )

    def _earlier_history(self) -> list[Progress]:
        """Return the states of a run that this one resumes."""
        try:
            earlier = read_preview(self._folder)
        except (InputError, OSError):
            return []
        return list(earlier.history) if earlier.key == self._key else []


def _to_bytes(image: Tensor) -> NDArray[np.uint8]:
    """Return an image (H, W, 3) from 0 to 1 in levels of 255."""
    levels: NDArray[np.uint8] = (255 * image.clamp(0, 1)).round().byte().cpu().numpy()
    return levels
