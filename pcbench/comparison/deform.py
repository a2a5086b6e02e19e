"""Test one file for deformation against another, and write the report folder; for `pcbench deform`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from pcbench.deformation import Deformation, deform
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.crs import check_lengths
from pcbench.geometry.mesh import Mesh
from pcbench.geometry.mesh_samples import sample_candidate
from pcbench.geometry.transform import Similarity
from pcbench.geometry.voxels import robust_extent, voxel_downsample_to
from pcbench.io.source import Source
from pcbench.measure.settings import Settings
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
    reference: Source,
    candidate: Source,
    settings: Settings,
    out: Path | None,
    *,
    figures: Figures | None,
    step: Callable[[str], None],
) -> DeformationOutcome:
    """Test a candidate file for deformation and write deformation.json, the field, the aligned candidate and pictures.

    Args:
        reference: the reference.
        candidate: the candidate.
        settings: the registration, the region and the seed; other settings have no effect.
        out: the output folder; None: write nothing.
        figures: appearance of the pictures, recorded in settings.json; None: draw none.
        step: called with a short text before each step that takes time.

    Raises:
        PcbenchError, OSError: an input or the output is invalid; nothing was written.
    """
    warnings: list[str] = []
    reading = [source.reading_seconds for source in (reference, candidate)]
    writing = [sum(reading), drawing_seconds(1)] if out is not None else []
    plan = ProgressPlan(step, [*reading, 1.0 + 20 * sum(reading), *writing])
    shapes = []
    for source in (reference, candidate):
        plan(f"reading {source.path}")
        shapes.append(source.read(warnings.append))
        check_lengths(shapes[-1], str(source.path))
    fixed, moved = shapes

    def run() -> tuple[Registration, Deformation]:
        plan("registering, testing for deformation")
        return deform(fixed, moved, settings.register, settings.crop, settings.seed)

    without_figures = None
    if out is None:
        registration, deformation = run()
    else:
        with report_folder(out, keep=[*reference.files, *candidate.files, *settings.files]) as folder:
            registration, deformation = run()
            plan("writing the report")
            transform = registration.T_reference_candidate
            aligned = _aligned_sample(moved, fixed, transform, settings.seed)
            write_deformation(folder, deformation, aligned, transform, fixed.crs, fixed.unit)
            if figures is not None:
                record_figures(folder / "settings.json", figures)
                plan("drawing the pictures")
                without_figures = draw_if_possible(folder, figures=figures).problem
    return DeformationOutcome(
        registration,
        deformation,
        (*warnings, *(notice.text for notice in registration.warnings)),
        fixed.unit,
        without_figures,
    )


def _aligned_sample(candidate: Cloud | Mesh, reference: Cloud | Mesh, transform: Similarity, seed: int) -> Cloud:
    """Return evenly thinned points of the aligned candidate, the background of the pictures."""
    points = sample_candidate(candidate, reference, seed).points
    rows = voxel_downsample_to(points, _MAX_ALIGNED_POINTS, start=1e-4 * robust_extent(points))
    return Cloud(transform.apply(points[rows]), crs=reference.crs, unit=reference.unit)
