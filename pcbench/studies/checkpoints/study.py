"""Test a cloud by check points, and write the results."""

from __future__ import annotations

import io
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from pcbench.errors import InputError
from pcbench.geometry.units import unit_or_given
from pcbench.io.check_points import CheckPoints, read_check_points
from pcbench.io.contents import digest
from pcbench.io.las_records import parse_filters
from pcbench.io.source import Source
from pcbench.measure.checkpoints import CheckPointSettings, assess
from pcbench.measure.checkpoints.reading import CloudAround, read_around
from pcbench.measure.checkpoints.statement import statements
from pcbench.report.checkpoints import accuracy_sentences, method_sentence, point_csv
from pcbench.report.document import provenance
from pcbench.report.figures import Figures, record_figures
from pcbench.report.html import InputRow
from pcbench.report.plot import Drawn
from pcbench.scratch import atomic_write
from pcbench.studies.checkpoints.charts import draw_charts
from pcbench.studies.checkpoints.page import article
from pcbench.studies.checkpoints.results import CSV, KIND, PLAN, CheckPointStudy, plan_extent, plan_heights
from pcbench.studies.frame.folder import check_folder, study_folder
from pcbench.studies.frame.publish import StudyOutcome, draw_here, publish


def run_checkpoints(
    cloud: Path,
    points_file: Path,
    settings: CheckPointSettings,
    out: Path | None = None,
    *,
    figures: Figures | None = None,
    step: Callable[[str], None] = lambda _: None,
) -> StudyOutcome[CheckPointStudy]:
    """Test a cloud by check points.

    Args:
        cloud: path of the cloud; it is read piece by piece.
        points_file: file of the check points.
        settings: the settings.
        out: folder for the results; None: nothing is written.
        figures: appearance of the pictures; None: none are drawn.
        step: called with a short text before each step that takes time.

    Raises:
        InputError: an input is not usable, the cloud covers no check point, or `out` holds something else.
        OSError: a file cannot be read or written.
    """
    check_points = read_check_points(points_file)
    source = Source.open(cloud, parse_filters(settings.classes, settings.returns))
    for path in (*source.files, points_file):
        if out is not None and path.resolve().is_relative_to(out.resolve()):
            raise InputError(f"{path}: the results replace files in {out}: choose another --out")
    if out is not None:
        check_folder(out, KIND)
    around = read_around(source, check_points.points[:, :2], step=step)
    step("measuring the errors")
    study = _study(source, check_points, around, settings)
    if out is None:
        return StudyOutcome(study)
    with study_folder(out, KIND, settings):
        with atomic_write(out / PLAN) as file:
            file.write(_plan_bytes(around))
        if figures is not None:
            record_figures(out / "settings.json", figures)

        def draw() -> Drawn:
            step("drawing charts")
            return draw_here(lambda: draw_charts(out, figures or Figures()))

        step("computing digests")
        inputs = [
            InputRow("cloud", str(cloud), source.digest()),
            InputRow("check points", str(points_file), digest(points_file)),
        ]
        texts = {CSV: point_csv(study.accuracy)}
        drawing = None if figures is None else draw
        return publish(out, KIND, study, texts, drawing, partial(article, study), study.provenance, inputs)


def _study(
    source: Source, check_points: CheckPoints, around: CloudAround, settings: CheckPointSettings
) -> CheckPointStudy:
    unit = unit_or_given(around.unit, settings.unit, str(source.path))
    accuracy = assess(check_points, around.neighbors[0], settings, unit)
    if not accuracy.covered and accuracy.horizontal is None:
        reasons = f"{check_points.names[0]}: {accuracy.points[0].reason}"
        raise InputError(
            f"{check_points.path}: expected check points on the cloud {source.path}, got none of {len(check_points)}:"
            f" {accuracy.hint or f'{reasons}: check the file, --classes and --returns'}"
        )
    return CheckPointStudy(
        cloud=str(source.path),
        check_points=str(check_points.path),
        count=around.count,
        crs=around.crs,
        settings=settings,
        accuracy=accuracy,
        sentences=(*accuracy_sentences(accuracy, source.path.name), method_sentence(accuracy)),
        statements=tuple(statements(accuracy, settings)),
        notes=tuple(_assumptions(check_points, around, settings)),
        warnings=(*around.warnings, *_doubts(around, settings)),
        extent=plan_extent(around.sample),
        provenance=provenance(None),
    )


def _assumptions(check_points: CheckPoints, around: CloudAround, settings: CheckPointSettings) -> list[str]:
    """Return what was assumed, in sentences."""
    texts = list(check_points.notes)
    texts.append(f"{check_points.path.name} names no coordinate system: it is taken to be that of the cloud.")
    if around.unit is None and settings.unit is not None:
        texts.append(f"The cloud states no unit: {settings.unit} as given.")
    return texts


def _doubts(around: CloudAround, settings: CheckPointSettings) -> list[str]:
    if not around.mixes_ground or settings.classes is not None:
        return []
    return [
        "the cloud has points that are classified as ground beside others, and all were used: --classes 2 tests the"
        " bare ground"
    ]


def _plan_bytes(around: CloudAround) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, plan_heights(around.sample).astype(np.float32))
    return buffer.getvalue()
