"""The worst silent failures: their clouds, and pictures of the candidate under the pose that was found."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from pcbench.errors import InputError, describe_damage
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.transform import Similarity
from pcbench.report.colors import Range
from pcbench.report.figures import Figures, rgb
from pcbench.report.plot.panels import compose
from pcbench.report.plot.splats import splat
from pcbench.report.plot.views import AxisBox, Frame, Viewpoint
from pcbench.report.words import length
from pcbench.scratch import atomic_write
from pcbench.studies.stress.cells import RunPlan, build_pair
from pcbench.studies.stress.registration import REGISTRATION
from pcbench.studies.stress.results import SilentFailure, StressStudy
from pcbench.studies.stress.scenes import StressPair
from pcbench.studies.stress.subject import SILENT, RunResult

_WORST = 3  # number of silent failures to draw
_PICTURE_POINTS = 20_000  # of each cloud in a picture
_REFERENCE_COLOR = (88, 92, 100)
_ERROR_LABEL = "displacement from the true pose"


def save_worst(
    out: Path,
    study: StressStudy,
    runs: Sequence[RunPlan],
    results: Sequence[RunResult],
    pair: StressPair | None,
) -> tuple[SilentFailure, ...]:
    """Save the clouds of the silent failures with the largest errors: at first one of each ladder.

    Args:
        out: folder of the study, whose former ones are deleted.
        study: the study.
        runs: all runs of the study.
        results: their results.
        pair: given pair, or None for the built-in scenes.

    Raises:
        OSError: a file cannot be written.
    """
    registrations = [
        (run, result.pose) for run, result in zip(runs, results, strict=True) if run.subject == REGISTRATION.name
    ]
    silent = [
        (cell, run, pose)
        for cell, (run, pose) in zip(study.registrations, registrations, strict=True)
        if cell.outcome == SILENT and pose is not None
    ]
    silent.sort(key=lambda failure: -(failure[0].error or 0.0))
    largest = {cell.ladder: cell for cell, _, _ in reversed(silent)}
    silent.sort(key=lambda failure: failure[0] is not largest[failure[0].ladder])
    for former in out.glob("worst_*.npz"):
        former.unlink()
    failures = []
    for number, (cell, run, pose) in enumerate(silent[:_WORST], 1):
        perturbed = build_pair(run, pair)
        aligned = Similarity.from_matrix(pose).apply(perturbed.candidate)
        file = f"worst_{number}.npz"
        rng = np.random.default_rng(0)
        fixed, moving = (
            np.sort(rng.permutation(len(points))[:_PICTURE_POINTS]) for points in (perturbed.reference, aligned)
        )
        with atomic_write(out / file) as stream:
            np.savez_compressed(
                stream,
                reference=perturbed.reference[fixed],
                found=aligned[moving],
                true=perturbed.points[moving],
            )
        failures.append(SilentFailure(cell, file))
    return tuple(failures)


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
    reference, aligned, true = read_clouds(folder / failure.file)
    look = Figures()
    frame = Frame.of(_box(reference, aligned), [reference, aligned])
    errors = np.linalg.norm(aligned - true, axis=1)
    scale = Range(0.0, max(float(errors.max()), 1e-12), "grey: reference; coloured: candidate under the found pose")
    points = np.concatenate([reference, aligned]) - frame.box.center
    greys = np.broadcast_to(np.array(_REFERENCE_COLOR, np.uint8), reference.shape)
    colors = np.concatenate([greys, scale.colors(errors)])
    behind = rgb(look.ground("dark"))

    def image(view: Viewpoint, window: FloatArray, pixels: tuple[int, int]) -> NDArray[np.uint8]:
        return splat(points, colors, view, window, pixels, behind)

    unit = next((scene.unit for scene in study.scenes if scene.name == failure.cell.scene), "m") or "units"
    title = failure_title(study, failure)
    compose(image, frame, title, unit, path, look, scale=scale, label=f"{_ERROR_LABEL} [{unit}]")


def failure_title(study: StressStudy, failure: SilentFailure) -> str:
    """Return a failure in one line: method, perturbation, scene, seed and errors."""
    cell = failure.cell
    ladder = study.ladder(cell.ladder)
    unit = next((scene.unit for scene in study.scenes if scene.name == cell.scene), "m")
    level = ladder.level_text(cell.level) if ladder.is_list else f"{ladder.title} {ladder.level_text(cell.level)}"
    if cell.second is not None:
        level += f", {cell.second:g} {ladder.second_unit}".rstrip()
    parts = [f"{cell.method}: {level}", f"{cell.scene}, seed {cell.seed}"]
    if cell.error_rms is not None and cell.angle_error_deg is not None:
        parts.append(f"{length(cell.error_rms, unit)} RMS and {_angle(cell.angle_error_deg)} deg off, not doubted")
    return "; ".join(parts)


def _angle(angle_deg: float) -> str:
    return f"{angle_deg:.0f}" if angle_deg >= 10 else f"{angle_deg:.2g}"


def read_clouds(path: Path) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the reference, and the candidate under the found and the true pose.

    Raises:
        InputError: the file is damaged.
        OSError: the file cannot be read.
    """
    try:
        with np.load(path) as arrays:
            reference, aligned, true = (np.asarray(arrays[name], np.float64) for name in ("reference", "found", "true"))
    except (KeyError, ValueError, EOFError, BadZipFile) as error:
        raise InputError(f"{path}: the file is damaged: {describe_damage(error)}") from error
    if aligned.shape != true.shape:
        raise InputError(f"{path}: the file is damaged: {len(aligned)} found and {len(true)} true points")
    return reference, aligned, true


def _box(reference: FloatArray, aligned: FloatArray) -> AxisBox:
    """Return the box of the reference, enlarged for the candidate, at most by a quarter on each side."""
    return AxisBox.around(reference).widen([AxisBox.around(aligned)])
