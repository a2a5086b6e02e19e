"""`pcbench deform`: from two files to a folder with the verdict on their deformation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from pcbench.deformation import Deformation, deform
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.voxels import robust_extent, voxel_downsample_to
from pcbench.io import read_cloud
from pcbench.io.files import named_file, reading_seconds
from pcbench.progress import Plan
from pcbench.registration import Registration
from pcbench.report.figures import Figures, record_figures
from pcbench.report.folder import report_folder, write_deformation
from pcbench.report.plot import draw_if_possible, drawing_seconds

_MAX_SHOWN_POINTS = 300_000  # points of the aligned candidate that pictures are drawn over


@dataclass(frozen=True, eq=False)
class DeformationOutcome:
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
    figures: Figures | None,
    step: Callable[[str], None],
) -> DeformationOutcome:
    """`deform` from files to a folder: deformation.json, the field, the aligned candidate (downsampled) and pictures.

    Args:
        figures: how pictures look, which settings.json holds; None: there are none.

    Raises:
        PcbenchError, OSError: an input or the output is not usable; nothing was written then.
    """
    warnings: list[str] = []
    clouds = []
    read = [reading_seconds(path) for path in (reference, candidate)]
    plan = Plan(step, [*read, 1.0 + 20 * sum(read), *([sum(read), drawing_seconds(1)] if out is not None else [])])
    for path in (reference, candidate):
        plan(f"reading {path}")
        clouds.append(read_cloud(path, on_warning=warnings.append))
    reference_cloud, cloud = clouds
    without_figures = None

    def run() -> tuple[Registration, Deformation]:
        plan("registering, and looking for a bend")
        return deform(reference_cloud, cloud, method, crop, seed)

    if out is None:
        found, deformation = run()
    else:
        with report_folder(out, keep=[reference, candidate, *filter(None, map(named_file, (method, crop)))]) as folder:
            found, deformation = run()
            plan("writing the report")
            rows = voxel_downsample_to(cloud.points, _MAX_SHOWN_POINTS, start=1e-4 * robust_extent(cloud.points))
            transform = found.T_reference_candidate
            aligned = Cloud(transform.apply(cloud.points[rows]), crs=reference_cloud.crs, unit=reference_cloud.unit)
            write_deformation(folder, deformation, aligned, transform, reference_cloud.crs, reference_cloud.unit)
            if figures is not None:
                record_figures(folder / "settings.json", figures)
                plan("drawing the pictures")
                without_figures = draw_if_possible(folder, figures=figures)
    return DeformationOutcome(
        found,
        deformation,
        (*warnings, *(notice.text for notice in found.warnings)),
        reference_cloud.unit,
        without_figures,
    )
