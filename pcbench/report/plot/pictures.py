"""The pictures of a report folder by name, with their data and drawing functions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from pcbench.deformation import Deformation
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cloud import Cloud
from pcbench.io import read_cloud
from pcbench.io.map_tiles import read_overview
from pcbench.measure.results import CANDIDATE_TO_REFERENCE, REFERENCE_TO_CANDIDATE
from pcbench.report.colors import Range, ranges, ranges_of
from pcbench.report.figures import Figures
from pcbench.report.manifest import MAPS
from pcbench.report.plot import Picture, bends, charts, maps
from pcbench.report.plot.overviews import draw_overview
from pcbench.report.plot.sections import draw_section
from pcbench.report.read import UNKNOWN_UNIT, Report, ReportedCandidate, read_deformation, read_report
from pcbench.report.scalars import COMPLETENESS, SCALARS, scalar_of
from pcbench.report.words import point_count


def pictures(folder: Path, look: Figures) -> dict[str, Picture]:
    """Return the pictures of a folder written by `pcbench compare` or `pcbench deform`."""
    if (folder / "comparison.json").is_file():
        return _pictures_of_comparison(folder, look)
    return _pictures_of_deformation(folder, look)


def _pictures_of_deformation(folder: Path, look: Figures) -> dict[str, Picture]:
    """Return the pictures of a folder written by `pcbench deform`."""
    deformation = read_deformation(folder)
    if not (folder / "deformation.ply").is_file():
        return {}
    cloud, field = (
        read_cloud(folder / f"{name}.ply", on_warning=lambda _: None) for name in ("aligned", "deformation")
    )
    unit = cloud.unit or field.unit or UNKNOWN_UNIT
    framing = maps.Framing(maps.frame(None, {"candidate": cloud}), unit, look)
    return _deformation_pictures("", deformation, cloud, field, framing)


def _deformation_pictures(
    name: str, deformation: Deformation, cloud: Cloud, field: Cloud, framing: maps.Framing
) -> dict[str, Picture]:
    cameras = framing.frame.cameras
    axes = ("x", "y", "z") if cameras is None else cameras.axis_names
    if cameras is not None and cameras.is_rotated:
        deformation = replace(deformation, growth=None)  # its trends are along the reference's z, which is not up here
    title = f"{name or 'candidate'} against the reference: {deformation.label} ({deformation.model} model)"
    prefix, reason = f"{name}_" if name else "", "the chosen model has no displacements"
    return {
        f"{prefix}deformation": Picture(
            lambda path: bends.evidence(deformation, field, title, framing, path, axes[:2])
        ),
        f"{prefix}displacement": Picture(lambda path: bends.arrows(cloud, field, title, framing, path), reason),
    }


def _pictures_of_comparison(folder: Path, look: Figures) -> dict[str, Picture]:
    report = read_report(folder, upright=True)
    deviations = {candidate.name: candidate.deviation for candidate in report.candidates}
    cores = {candidate.name: candidate.m3c2 for candidate in report.candidates if candidate.m3c2 is not None}
    measured = report.candidates[0].completeness()
    framing = maps.Framing(maps.frame(measured, deviations, report.cameras), report.unit, look)
    scenery = maps.Scenery(np.zeros((0, 3)) if measured is None else measured.points, framing)
    named = {
        "distribution": Picture(lambda path: charts.distribution(report, path, look), "all distances are zero"),
        "reference": Picture(
            lambda path: maps.draw_own_colors("reference", report.reference(), framing, path),
            "the file of the reference no longer exists, or it was compared in tiles because of its size",
        ),
        **{f"{candidate.name}_colors": _own_colors(candidate, framing) for candidate in report.candidates},
    }
    for scalar in dict.fromkeys(name for cloud in deviations.values() for name in cloud.attributes):
        named |= _maps(deviations, scalar, report, scenery)
        if scalar == "distance":
            named |= _completeness(report, scenery)
    named |= _overviews(folder, report, look)
    named |= _sections(report, scenery.points, look)
    named |= _maps(cores, "m3c2_distance", report, scenery)
    for candidate in report.candidates:
        if candidate.field is not None and candidate.deformation is not None:
            named |= _deformation_pictures(
                candidate.name, candidate.deformation, candidate.deviation, candidate.field, framing
            )
    return named


def _maps(clouds: Mapping[str, Cloud], scalar: str, report: Report, scenery: maps.Scenery) -> dict[str, Picture]:
    """Return the pictures of one scalar, one per candidate."""
    values = {
        name: np.asarray(cloud.attributes[scalar], dtype=np.float64)
        for name, cloud in clouds.items()
        if scalar in cloud.attributes and np.isfinite(cloud.attributes[scalar]).any()
    }
    noun = scalar_of(scalar).noun
    samples = {} if noun == "core point" else {c.name: c.samples.get(CANDIDATE_TO_REFERENCE) for c in report.candidates}
    even = {
        name: scalars if (sample := samples.get(name)) is None else scalars[: sample.even]
        for name, scalars in values.items()
    }
    scales = ranges_of(even, spacing=report.spacing_median, end=scenery.framing.look.range)
    label = f"{scalar_of(scalar).label} [{report.unit}]"

    def picture(name: str, scale: Range) -> Picture:
        sample = samples.get(name)
        count = point_count(len(clouds[name]), sample and sample.sampled_from, noun)
        title = f"{name} ({count})"
        return Picture(
            lambda path: maps.draw_coloured_cloud(clouds[name], values[name], title, scale, label, scenery, path)
        )

    return {f"{name}_{scalar}": picture(name, scale) for name, scale in scales.items()}


def _overviews(folder: Path, report: Report, look: Figures) -> dict[str, Picture]:
    """Return a picture of each overview raster of a comparison in tiles; in memory, other maps show all points."""
    if not report.is_tiled:
        return {}

    def picture(path: Path, title: str, label: str) -> Picture:
        def draw(picture_file: Path) -> bool:
            overview = read_overview(path)
            return draw_overview(overview, title, label, report.unit, report.spacing_median, picture_file, look)

        return Picture(draw)

    kinds = {"distance": "{} from above", "completeness": "completeness of {} from above"}
    return {
        f"{candidate.name}_{kind}_overview": picture(path, title.format(candidate.name), SCALARS[kind].label)
        for candidate in report.candidates
        for kind, title in kinds.items()
        if (path := folder / MAPS / f"{candidate.name}_{kind}.tif").is_file()
    }


def _own_colors(candidate: ReportedCandidate, framing: maps.Framing) -> Picture:
    """Return the picture of an aligned candidate in its own colours."""
    return Picture(
        lambda path: maps.draw_own_colors(candidate.name, candidate.own_colors(), framing, path),
        "the cloud has no colours, its file no longer exists, or it was compared in tiles because of its size",
    )


def _sections(report: Report, reference: FloatArray, look: Figures) -> dict[str, Picture]:
    """Return a section through the largest deviations of each candidate, by signed distances if they exist."""
    clouds = {candidate.name: candidate.deviation for candidate in report.candidates}
    scalar = "plane_distance" if all("plane_distance" in cloud.attributes for cloud in clouds.values()) else "distance"
    values = {name: np.asarray(cloud.attributes[scalar], dtype=np.float64) for name, cloud in clouds.items()}
    even = {candidate.name: candidate.even_values(scalar) for candidate in report.candidates}
    scales = ranges_of(even, spacing=report.spacing_median, end=look.range)
    label = f"{SCALARS[scalar].label} [{report.unit}]"

    def picture(name: str) -> Picture:
        def draw(path: Path) -> bool:
            return bool(values[name].any()) and draw_section(
                clouds[name].points, values[name], reference, report.spacing_median, name, scales[name], label,
                report.unit, path, look, report.rotation, report.cameras,
            )  # fmt: skip

        return Picture(draw, "all distances are zero, or no place has enough points for a section")

    return {f"{name}_section": picture(name) for name in clouds} if len(reference) else {}


def _completeness(report: Report, scenery: maps.Scenery) -> dict[str, Picture]:
    """Return maps of the reference coloured by its distance to each candidate, which show missing parts."""
    mapped = [candidate for candidate in report.candidates if candidate.has_completeness]
    highest = {candidate.name: candidate.percentiles_completeness["p95"] for candidate in mapped}
    scales = ranges(highest, spacing=report.spacing_median, end=scenery.framing.look.range)
    label = f"{SCALARS[COMPLETENESS].label} [{report.unit}]"

    def picture(candidate: ReportedCandidate, scale: Range) -> Picture:
        def draw(path: Path) -> bool:
            cloud = candidate.completeness()
            assert cloud is not None
            sample = candidate.samples.get(REFERENCE_TO_CANDIDATE)
            count = point_count(len(cloud), sample and sample.sampled_from)
            title = f"completeness of {candidate.name} (the reference's {count})"
            values = np.asarray(cloud.attributes["distance"], dtype=np.float64)
            return maps.draw_coloured_cloud(cloud, values, title, scale, label, scenery, path)

        return Picture(draw)

    return {f"{candidate.name}_completeness": picture(candidate, scales[candidate.name]) for candidate in mapped}
