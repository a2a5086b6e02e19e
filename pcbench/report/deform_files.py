"""Test one file for deformation against another, and write the report folder; for `pcbench deform`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from pcbench.deformation import Deformation, deform
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.crs import check_lengths
from pcbench.geometry.mesh_samples import sample_candidate
from pcbench.geometry.voxels import robust_extent, voxel_downsample_to
from pcbench.io.files import file_in_setting
from pcbench.io.source import Source
from pcbench.progress import ProgressPlan
from pcbench.registration import Registration
from pcbench.report.figures import Figures, record_figures
from pcbench.report.folder import report_folder, write_deformation
from pcbench.report.plot import draw_if_possible, drawing_seconds

_MAX_ALIGNED_POINTS = 300_000  # in aligned.ply, the background of the pictures


@dataclass(frozen=True, eq=False)
class DeformationOutcome:
    """A registration, a verdict on deformation, warnings, the unit, and the reason if pictures could not be drawn."""

    registration: Registration
    deformation: Deformation
    warnings: tuple[str, ...]
    unit: str | None
    without_figures: str | None


def deform_files(
    reference: Path,
    candidate: Path,
    method: str,
    crop: str,
    seed: int,
    out: Path | None,
    *,
    vertices: bool = False,
    figures: Figures | None,
    step: Callable[[str], None],
) -> DeformationOutcome:
    """Test a candidate file for deformation and write deformation.json, the field, the aligned candidate and pictures.

    Args:
        reference: path of the reference.
        candidate: path of the candidate.
        method: the registration method, as in `--register`.
        crop: the region, as in `--crop`.
        seed: random seed.
        out: the output folder; None: write nothing.
        vertices: whether a candidate mesh is measured at its vertices rather than at samples.
        figures: appearance of the pictures, recorded in settings.json; None: draw none.
        step: called with a short text before each step that takes time.

    Raises:
        PcbenchError, OSError: an input or the output is invalid; nothing was written.
    """
    warnings: list[str] = []
    shapes = []
    sources = Source.open(reference), Source.open(candidate, vertices=vertices)
    reading = [source.reading_seconds for source in sources]
    plan = ProgressPlan(
        step, [*reading, 1.0 + 20 * sum(reading), *([sum(reading), drawing_seconds(1)] if out is not None else [])]
    )
    for source in sources:
        plan(f"reading {source.path}")
        shapes.append(source.read(warnings.append))
        check_lengths(shapes[-1], str(source.path))
    given, moved = shapes
    without_figures = None

    def run() -> tuple[Registration, Deformation]:
        plan("registering, testing for deformation")
        return deform(given, moved, method, crop, seed)

    if out is None:
        registration, deformation = run()
    else:
        with report_folder(
            out, keep=[reference, candidate, *filter(None, map(file_in_setting, (method, crop)))]
        ) as folder:
            registration, deformation = run()
            plan("writing the report")
            cloud = sample_candidate(moved, given, seed)
            rows = voxel_downsample_to(cloud.points, _MAX_ALIGNED_POINTS, start=1e-4 * robust_extent(cloud.points))
            transform = registration.T_reference_candidate
            aligned = Cloud(transform.apply(cloud.points[rows]), crs=given.crs, unit=given.unit)
            write_deformation(folder, deformation, aligned, transform, given.crs, given.unit)
            if figures is not None:
                record_figures(folder / "settings.json", figures)
                plan("drawing the pictures")
                without_figures = draw_if_possible(folder, figures=figures).problem
    return DeformationOutcome(
        registration,
        deformation,
        (*warnings, *(notice.text for notice in registration.warnings)),
        given.unit,
        without_figures,
    )
