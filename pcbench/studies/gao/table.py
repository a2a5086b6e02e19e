"""The tables of the experiment: the paper's measures in both directions, time and memory, and everything as CSV."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from pcbench.deformation import Deformation
from pcbench.measure.presets import Gao2025
from pcbench.report.markup import csv_text as csv_of
from pcbench.report.words import UNKNOWN, length
from pcbench.studies.frame.tables import mebibytes
from pcbench.studies.gao.results import (
    CameraErrors,
    CloudResult,
    GaoStudy,
    InjectedDeformation,
    ReferenceEvaluation,
    SceneResult,
    references,
)
from pcbench.studies.views.scores import ViewStudy
from pcbench.studies.views.table import table as views_table

_MEASURES = ("D1 c→r", "D1 r→c", "D2", "D2 mesh", "Hausdorff", "Chamfer")
LEGEND = (
    "D1 and Chamfer: mean squares [{unit}²], c→r as in the paper, r→c in the opposite direction; D2: to tangent planes;"
    " D2 mesh: to the reference's Poisson mesh; Hausdorff: symmetric, unsquared [{unit}]; bend RMS: deformation beyond"
    " affine [{unit}] with 95 % interval"
)

INJECTED = (
    "A deformation that grows with distance and height, with this RMS length [{unit}], is added to one cloud or to mvs."
    " Verdicts are against mvs, with the RMS along the normals where a deformation is found"
)


def console_tables(study: GaoStudy, views: ViewStudy | None) -> Iterator[list[list[str]]]:
    """Yield the printed tables: measures, time and memory, known deformations, and scores of novel views."""
    yield list(measures_table(study))
    yield list(cost_table(study))
    if any(scene.injected for scene in study.scenes):
        yield list(injection_table(study))
    if views is not None:
        yield views_table(views)


def measures_table(study: GaoStudy) -> Iterator[list[str]]:
    """Yield the paper's measures, one row per cloud and reference, a header first."""
    yield (head := ["", "against", "points", "cropped", *_MEASURES, "verdict", "bend RMS"])
    for scene in study.scenes:
        yield from _scene_row(scene, study, len(head))
        for reference in references(scene):
            for cloud in scene.clouds:
                if (evaluation := _find_evaluation(cloud, reference)) is not None:
                    yield [cloud.name, reference, f"{cloud.points or 0:,}", *_measure_cells(evaluation)]
        for cloud in scene.clouds:
            if cloud.failure:
                yield [cloud.name, "failed", *[""] * (len(_MEASURES) + 2), "", ""]


def cost_table(study: GaoStudy) -> Iterator[list[str]]:
    """Yield time and memory of each cloud, a header first."""
    yield (head := ["", "points", "seconds", "memory", "images"])
    for scene in study.scenes:
        yield from _scene_row(scene, study, len(head))
        for cloud in scene.clouds:
            images = str(scene.images)
            if scene.cameras is not None:
                images = f"{scene.cameras.solved}/{images}"
            elif len(scene.positions) < scene.images:  # solved cameras without given ones to compare with
                images = f"{len(scene.positions)}/{images}"
            points = f"{cloud.points:,}" if cloud.points is not None else "failed"
            memory = UNKNOWN if cloud.memory_bytes is None else f"{mebibytes(cloud.memory_bytes)} MiB"
            yield [cloud.name, points, seconds_text(cloud), memory, images]


def injection_table(study: GaoStudy) -> Iterator[list[str]]:
    """Yield the verdicts on clouds with a deformation of known size, a header first."""
    names = list(dict.fromkeys(name for scene in study.scenes for each in scene.injected for name in each.verdicts))
    yield (head := ["deformed", "RMS", *names, "attributed to"])
    for scene in study.scenes:
        if scene.injected:
            yield from _scene_row(scene, study, len(head))
        for each in scene.injected:
            cells = [_injected_cell(each, name) for name in names]
            yield [each.cloud, format_number(each.rms), *cells, each.attributed or UNKNOWN]


def _injected_cell(each: InjectedDeformation, name: str) -> str:
    size = each.sizes.get(name)
    label = each.verdicts.get(name, UNKNOWN)
    return label if size is None else f"{label} {format_number(size)}"


def seconds_text(cloud: CloudResult) -> str:
    """Return the seconds of a cloud's process: `+` adds to those of the training before it, `≥` marks a resumed one."""
    if cloud.seconds is None:
        return UNKNOWN
    return ("≥ " if cloud.resumed else "+ " if cloud.extra else "") + f"{cloud.seconds:.0f}"


def failures(study: GaoStudy) -> Iterator[str]:
    """Yield one line per failure."""
    for scene in study.scenes:
        for cloud in scene.clouds:
            title = _title(scene, cloud, study)
            if cloud.failure:
                yield f"{title} failed: {cloud.failure}"
            for evaluation in cloud.against:
                if evaluation.failure:
                    yield f"{title} could not be measured against {evaluation.reference}: {evaluation.failure}"


def verdicts(study: GaoStudy) -> Iterator[str]:
    """Yield one sentence per verdict."""
    for scene in study.scenes:
        for reference in references(scene):
            for cloud in scene.clouds:
                evaluation = cloud.evaluation(reference)
                if evaluation is not None and evaluation.deformation is not None:
                    name = f"{_title(scene, cloud, study)}, against {reference}"
                    yield evaluation.deformation.sentence(name, scene.unit or "")


def csv_text(study: GaoStudy) -> str:
    """Return CSV with one line per cloud and reference; a failed cloud has one line."""
    fields = list(Gao2025.__annotations__)
    bend = ("verdict", "model", "bend_rms", "bend_low", "bend_high", "detectable")
    head = ["scene", "cloud", "points", "seconds", "resumed", "beside_others", "memory_bytes"]
    head += ["reference", "points_in_region"]
    rows = []
    for scene in study.scenes:
        for cloud in scene.clouds:
            first = [scene.name, cloud.name, cloud.points, cloud.seconds, cloud.resumed, cloud.beside_others]
            first.append(cloud.memory_bytes)
            for evaluation in cloud.against or (ReferenceEvaluation("", failure=cloud.failure),):
                values = [
                    None if evaluation.measures is None else getattr(evaluation.measures, field) for field in fields
                ]
                rest = [evaluation.floor, *_bend_values(evaluation.deformation), evaluation.failure or cloud.failure]
                rows.append([*first, evaluation.reference, evaluation.points, *values, *rest])
    return csv_of([*head, *fields, "d1_floor", *bend, "failure"], rows)


def _camera_errors(errors: CameraErrors, scene: SceneResult) -> str:
    """Return the errors of solved cameras, and the deformation that they cause, as text."""
    # Without a truth, the scene's cameras may be as wrong as the solved ones.
    what = "position errors of solved cameras" if scene.has_truth else "distances of solved cameras from the scene's"
    text = (
        f"{what}: {length(errors.median, scene.unit)} (median),"
        f" {length(errors.largest, scene.unit)} (largest); focal length {errors.focal_ratio:.4f} times the scene's"
    )
    cameras = "the cameras"
    if errors.astray:
        cameras = "the other cameras"
        text += f"; {errors.astray} of {errors.solved} {'is an outlier' if errors.astray == 1 else 'are outliers'}"
    if (surface := errors.surface) is not None:
        text += (
            f"; alone, {cameras} deform the surface of all clouds by {length(surface.moved, scene.unit)} RMS beyond a"
            f" rigid motion, and by {length(surface.bent, scene.unit)} RMS beyond an affine one"
        )
    return text


def _find_evaluation(cloud: CloudResult, reference: str) -> ReferenceEvaluation | None:
    return next((evaluation for evaluation in cloud.against if evaluation.reference == reference), None)


def _scene_row(scene: SceneResult, study: GaoStudy, columns: int) -> Iterator[list[str]]:
    """Yield a row with the name of the scene, if there are several scenes."""
    if len(study.scenes) > 1:
        yield [scene.name, *[""] * (columns - 1)]


def _title(scene: SceneResult, cloud: CloudResult, study: GaoStudy) -> str:
    return f"{scene.name} {cloud.name}" if len(study.scenes) > 1 else cloud.name


def _measure_cells(evaluation: ReferenceEvaluation) -> list[str]:
    if evaluation.measures is None:
        return ["failed", *[""] * len(_MEASURES), "", ""]
    m, bend = evaluation.measures, evaluation.deformation
    values = (m.d1_mse, evaluation.r2c_mse, m.d2_mse, m.d2_poisson_mse, m.hausdorff, m.chamfer)
    size = UNKNOWN if bend is None or bend.amplitude is None else _size_text(bend)
    return [f"{evaluation.points or 0:,}", *map(format_number, values), UNKNOWN if bend is None else bend.label, size]


def format_number(value: float | None) -> str:
    """Format a number with three digits, without an exponent if that is as short."""
    if value is None:
        return UNKNOWN
    return f"{value:.3g}" if not 0 < abs(value) < 1e-3 else f"{value:.1e}".replace("e-0", "e-")


def _size_text(bend: Deformation) -> str:
    assert bend.amplitude is not None
    low, high = bend.amplitude.ci
    return f"{bend.amplitude.rms:.2g} [{low:.2g}, {high:.2g}]"


def _bend_values(bend: Deformation | None) -> Sequence[object]:
    if bend is None:
        return (None,) * 6
    size = (None,) * 3 if bend.amplitude is None else (bend.amplitude.rms, *bend.amplitude.ci)
    return bend.label, bend.model, *size, bend.size_limit


def notes(study: GaoStudy) -> Iterator[str]:
    """Yield what was measured of each scene, notes of the reconstructors and doubts about registrations."""
    results = [
        evaluation.deformation for scene in study.scenes for cloud in scene.clouds for evaluation in cloud.against
    ]
    if any(result is not None and result.conditional_verdict is not None for result in results):
        yield "(?): verdict that holds if the pose is right; the registration is doubtful"
    for scene in study.scenes:
        yield f"{scene.name} ({Path(scene.path).name}): measured in {scene.region}"
        if scene.cameras is not None:
            yield f"{scene.name}: {_camera_errors(scene.cameras, scene)}"
        for cloud in scene.clouds:
            doubts = [
                f"against {evaluation.reference}: {text}" for evaluation in cloud.against for text in evaluation.doubts
            ]
            yield from (f"{scene.name} {cloud.name}: {note}" for note in (*cloud.notes, *doubts))
