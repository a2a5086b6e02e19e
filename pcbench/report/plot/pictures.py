"""The pictures of a report folder by name: what each is drawn from, and by which function."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from pcbench.deformation import Deformation
from pcbench.geometry.cloud import Cloud
from pcbench.io import read_cloud
from pcbench.measure.wording import counted
from pcbench.report.colors import Range, largest_but_strays, ranges
from pcbench.report.figures import Figures
from pcbench.report.plot import Picture, bends, charts, maps
from pcbench.report.plot.views import Frame
from pcbench.report.read import Report, ReportedCandidate, read_deformation, read_report


def pictures(folder: Path, look: Figures) -> dict[str, Picture]:
    """Those of a folder that `pcbench compare` or `pcbench deform` wrote."""
    if (folder / "comparison.json").is_file():
        return _pictures_of_comparison(folder, look)
    return _pictures_of_deformation(folder, look)


def _pictures_of_deformation(folder: Path, look: Figures) -> dict[str, Picture]:
    """Those of a folder that `pcbench deform` wrote."""
    bend = read_deformation(folder)
    if not (folder / "deformation.ply").is_file():
        return {}
    cloud, field = read_cloud(folder / "aligned.ply"), read_cloud(folder / "deformation.ply")
    frame = maps.frame(None, {"candidate": cloud})
    return _bends("", bend, cloud, field, cloud.unit or field.unit or "units of the file", frame, look)


def _bends(
    name: str, bend: Deformation, cloud: Cloud, field: Cloud, unit: str, frame: Frame, look: Figures
) -> dict[str, Picture]:
    title = f"{name or 'candidate'} against the reference: {bend.verdict} ({bend.model} model)"
    prefix, still = f"{name}_" if name else "", "the chosen model moves nothing"
    return {
        f"{prefix}deformation": Picture(lambda path: bends.evidence(bend, field, title, unit, path, look)),
        f"{prefix}displacement": Picture(
            lambda path: bends.arrows(cloud, field, title, unit, frame, path, look), still
        ),
    }


def _pictures_of_comparison(folder: Path, look: Figures) -> dict[str, Picture]:
    report = read_report(folder)
    deviations = {candidate.name: candidate.deviation for candidate in report.candidates}
    cores = {candidate.name: candidate.m3c2 for candidate in report.candidates if candidate.m3c2 is not None}
    frame = maps.frame(report.candidates[0].completeness(), deviations)
    found = {
        "distribution": Picture(lambda path: charts.distribution(report, path, look), "no point is off the reference"),
        "reference": Picture(
            lambda path: maps.reference(report.reference(), report.unit, frame, path, look),
            "the reference's file has gone",
        ),
    }
    for scalar in dict.fromkeys(name for cloud in deviations.values() for name in cloud.attributes):
        found |= _maps(deviations, scalar, report, frame, look)
        if scalar == "distance":
            found |= _completeness(report, frame, look)
    found |= _maps(cores, "m3c2_distance", report, frame, look)
    for candidate in report.candidates:
        if candidate.field is not None and candidate.deformation is not None:
            bend = candidate.deformation
            found |= _bends(candidate.name, bend, candidate.deviation, candidate.field, report.unit, frame, look)
    return found


def _maps(clouds: Mapping[str, Cloud], scalar: str, report: Report, frame: Frame, look: Figures) -> dict[str, Picture]:
    """The pictures of one scalar, a candidate each."""
    values = {
        name: np.asarray(cloud.attributes[scalar], dtype=np.float64)
        for name, cloud in clouds.items()
        if scalar in cloud.attributes and np.isfinite(cloud.attributes[scalar]).any()
    }
    known = {name: of[np.isfinite(of)] for name, of in values.items()}
    signed = any(bool((of < 0).any()) for of in known.values())
    highest = {name: largest_but_strays(of) for name, of in known.items()}
    scales = ranges(highest, spacing=report.spacing_median, signed=signed, given=look.range)
    label = f"{maps.LABELS.get(scalar, scalar.replace('_', ' '))} [{report.unit}]"
    noun = "core point" if scalar.startswith("m3c2") else "point"

    def picture(name: str, scale: Range) -> Picture:
        title = f"{name} ({counted(len(clouds[name]), noun)})"
        return Picture(
            lambda path: maps.coloured(clouds[name], values[name], title, scale, label, report.unit, frame, path, look)
        )

    return {f"{name}_{scalar}": picture(name, scale) for name, scale in scales.items()}


def _completeness(report: Report, frame: Frame, look: Figures) -> dict[str, Picture]:
    """The reference by its distance to each candidate: bright where something is missing from it."""
    having = [candidate for candidate in report.candidates if candidate.has_completeness]
    highest = {candidate.name: candidate.percentiles_completeness["p95"] for candidate in having}
    scales = ranges(highest, spacing=report.spacing_median, given=look.range)
    label = f"{maps.LABELS['completeness']} [{report.unit}]"

    def picture(candidate: ReportedCandidate, scale: Range) -> Picture:
        def draw(path: Path) -> bool:
            cloud = candidate.completeness()
            assert cloud is not None
            title = f"completeness of {candidate.name} (the reference's {counted(len(cloud), 'point')})"
            values = np.asarray(cloud.attributes["distance"], dtype=np.float64)
            return maps.coloured(cloud, values, title, scale, label, report.unit, frame, path, look)

        return Picture(draw)

    return {f"{candidate.name}_completeness": picture(candidate, scales[candidate.name]) for candidate in having}
