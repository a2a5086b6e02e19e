"""Read and write the preview of a model that is being trained: how far it is, what it renders, and its points.

A reconstructor rewrites the folder while it trains (`write_preview`); `pcbench reconstruct` and `pcbench view` show it
(`read_preview`). It has `preview.json`, `rendering.png` beside `photograph.png`, and `points.ply`. Each file is
replaced as a whole, `preview.json` last.
"""

from __future__ import annotations

import io
import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.errors import InputError, describe_damage
from pcbench.extras import require
from pcbench.geometry.cloud import Cloud
from pcbench.io import write_cloud
from pcbench.regular_files import read_json
from pcbench.scratch import atomic_write

SCHEMA = "pcbench.preview/2"
DOCUMENT, POINTS, RENDERING, PHOTOGRAPH = "preview.json", "points.ply", "rendering.png", "photograph.png"
PREVIEW_FOLDER = "preview"  # name of the folder in a reconstructor's workspace


class Progress(NamedTuple):
    """State of a training after some of its steps.

    Attributes:
        done: steps that were run, also those of models that were given up.
        step: the step that the model is at.
        loss: mean loss of the training photographs.
        psnr: mean PSNR of the training photographs, in dB.
        held_out_psnr: mean PSNR of held-out photographs, in dB; None without any.
        gaussians: number of Gaussians.
    """

    done: int
    step: int
    loss: float
    psnr: float
    held_out_psnr: float | None
    gaussians: int


class SizeScore(NamedTuple):
    """Score of a model of one size on held-out photographs, which was compared with models of other sizes.

    Attributes:
        gaussians: number of Gaussians.
        degree: degree of their spherical harmonics.
        metric: name of the score, with its unit.
        score: its mean over the photographs.
        low, high: score of the best model plus the 95 % interval of the difference from it.
        chosen: whether training went on with this size.
    """

    gaussians: int
    degree: int
    metric: str
    score: float
    low: float
    high: float
    chosen: bool


@dataclass(frozen=True)
class Preview:
    """A training, from its start or its last preview.

    Attributes:
        key: identifies the training: a run that resumes it has the same key.
        steps: its number of steps.
        view: name of the rendered image.
        is_held_out: whether that image is not trained on.
        history: its states, the newest one last.
        sizes: scores of the models among which the number of Gaussians was chosen; none before, or without a choice.
        decision: the choice and its reasons, as a sentence.
    """

    key: str
    steps: int
    view: str
    is_held_out: bool
    history: tuple[Progress, ...]
    sizes: tuple[SizeScore, ...] = ()
    decision: str = ""

    @property
    def sentence(self) -> str:
        """The newest state, in words."""
        now = self.history[-1]
        held_out = "" if now.held_out_psnr is None else f", {now.held_out_psnr:.2f} dB of held-out ones"
        return (
            f"Step {now.step:,} of {self.steps:,}: PSNR {now.psnr:.2f} dB of training photographs{held_out}, loss"
            f" {now.loss:.4f}, {now.gaussians:,} Gaussians"
        )


def write_preview(
    folder: Path, preview: Preview, rendering: NDArray[np.uint8], photograph: NDArray[np.uint8], points: Cloud
) -> None:
    """Write the preview of a training, in place of an earlier one.

    Args:
        folder: the folder, created if it is missing.
        preview: the training.
        rendering: (H, W, 3) its rendered image.
        photograph: (H, W, 3) the photograph of the same view.
        points: points of the model, in the world.

    Raises:
        MissingExtra: Pillow is not installed.
        OSError: a file cannot be written.
    """
    folder.mkdir(exist_ok=True)
    write_cloud(folder / POINTS, points, on_warning=lambda _: None)
    for name, image in ((RENDERING, rendering), (PHOTOGRAPH, photograph)):
        packed = io.BytesIO()
        require("PIL.Image", "splat").fromarray(image).save(packed, format="PNG", compress_level=1)
        with atomic_write(folder / name) as file:
            file.write(packed.getvalue())
    rows = {name: [row._asdict() for row in getattr(preview, name)] for name in ("history", "sizes")}
    document = {"schema": SCHEMA, **asdict(preview), **rows}
    with atomic_write(folder / DOCUMENT) as file:
        file.write((json.dumps(document) + "\n").encode())


def read_preview(folder: Path) -> Preview:
    """Read the preview in a folder that `find_preview` returned.

    Raises:
        InputError: `preview.json` is malformed.
    """
    path = folder / DOCUMENT
    try:
        document = read_json(path)
        if document.pop("schema") != SCHEMA:
            raise InputError(f"expected the schema {SCHEMA}: train the model again")
        history: Any = document.pop("history")
        sizes: Any = document.pop("sizes")
        preview = Preview(
            **document,
            history=tuple(Progress(**row) for row in history),
            sizes=tuple(SizeScore(**row) for row in sizes),
        )
        if not preview.history:
            raise ValueError("no state")
        for row in preview.history:
            numbers = (preview.steps, *row._replace(held_out_psnr=row.held_out_psnr or 0.0))
            if not all(isinstance(number, int | float) for number in numbers):
                raise TypeError("no number")
        for size in preview.sizes:
            if not all(isinstance(number, int | float) for number in (*size[:2], *size[3:])):
                raise TypeError("no number")
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(f"{path}: expected a file written by pcbench: {describe_damage(error)}") from error
    return preview


def find_preview(folder: Path) -> Path | None:
    """Return the folder of the preview: this folder, or one inside it if it is a reconstructor's workspace."""
    candidates = (folder, folder / PREVIEW_FOLDER, folder / "plugin" / PREVIEW_FOLDER)
    return next((candidate for candidate in candidates if (candidate / DOCUMENT).is_file()), None)
