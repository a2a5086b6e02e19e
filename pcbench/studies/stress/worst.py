"""Pictures of the worst silent failures: the candidate under the found and the true pose, over the reference."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pcbench.errors import InputError
from pcbench.geometry.arrays import FloatArray
from pcbench.report.figures import Figures
from pcbench.report.plot.panels import compose
from pcbench.report.plot.splats import splat
from pcbench.report.plot.views import AxisBox, Frame, Viewpoint
from pcbench.report.words import length
from pcbench.studies.stress.results import SilentFailure, StressStudy

_REFERENCE_COLOR, _FOUND_COLOR, _TRUE_COLOR = (125, 130, 138), (230, 120, 30), (60, 200, 140)
COLORS_NOTE = "grey: reference; orange: found pose; green: true pose"


def draw_worst(study: StressStudy, failure: SilentFailure, folder: Path, path: Path) -> None:
    """Draw a silent failure in three views.

    Args:
        study: the study.
        failure: the failure.
        folder: folder of the study, with the clouds of the failure.
        path: picture to write.

    Raises:
        InputError: the file of the clouds is damaged.
        MissingExtra: matplotlib is not installed.
        OSError: the file of the clouds cannot be read, or the picture cannot be written.
    """
    reference, found, true = read_clouds(folder / failure.file)
    look = Figures()
    frame = Frame.of(_box(reference, found, true), [reference, found, true])
    points = np.concatenate([reference, true, found]) - frame.box.center
    counts = (len(reference), len(true), len(found))
    colors = np.repeat(np.array([_REFERENCE_COLOR, _TRUE_COLOR, _FOUND_COLOR], np.uint8), counts, axis=0)
    ground = look.ground("dark")
    behind = np.array([int(ground[k : k + 2], 16) for k in (1, 3, 5)], dtype=np.uint8)

    def image(view: Viewpoint, window: FloatArray, pixels: tuple[int, int]) -> NDArray[np.uint8]:
        return splat(points, colors, view, window, pixels, behind)

    unit = next((scene.unit for scene in study.scenes if scene.name == failure.cell.scene), "m")
    compose(image, frame, f"{failure_title(study, failure)} ({COLORS_NOTE})", unit or "units", path, look)


def failure_title(study: StressStudy, failure: SilentFailure) -> str:
    """Return a failure in one line: method, perturbation, scene, seed and errors."""
    cell = failure.cell
    ladder = study.ladder(cell.ladder)
    unit = next((scene.unit for scene in study.scenes if scene.name == cell.scene), "m")
    level = ladder.level_text(cell.level) if ladder.is_list else f"{ladder.title} {ladder.level_text(cell.level)}"
    if cell.second is not None:
        level += f", {ladder.second_title} {cell.second:g} {ladder.second_unit}".rstrip()
    parts = [f"{cell.method}: {level}", f"{cell.scene}, seed {cell.seed}"]
    if cell.error_rms is not None and cell.angle_error_deg is not None:
        parts.append(f"{length(cell.error_rms, unit)} RMS and {cell.angle_error_deg:.2g} deg off, without a doubt")
    return "; ".join(parts)


def read_clouds(path: Path) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the reference, and the candidate under the found and the true pose.

    Raises:
        InputError: the file is damaged.
        OSError: the file cannot be read.
    """
    try:
        with np.load(path) as arrays:
            reference, found, true = (np.asarray(arrays[name], np.float64) for name in ("reference", "found", "true"))
    except (KeyError, ValueError, EOFError) as error:
        raise InputError(f"{path}: the file is damaged: {type(error).__name__}: {error}") from error
    return reference, found, true


def _box(reference: FloatArray, *others: FloatArray) -> AxisBox:
    """Return the box of the reference, enlarged for the candidate, at most to a quarter beyond each side."""
    return AxisBox.around(reference).widen(AxisBox.around(points) for points in others)
