"""The pictures of a report folder by name: what each is drawn from, and by which function."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pcbench.deformation import Deformation
from pcbench.geometry.cloud import Cloud
from pcbench.io import read_cloud
from pcbench.report.plot import Picture, bends, charts, maps
from pcbench.report.read import read_deformation, read_report


def pictures(folder: Path) -> dict[str, Picture]:
    """Those of a folder that `pcbench compare` or `pcbench deform` wrote."""
    if (folder / "comparison.json").is_file():
        return _pictures_of_comparison(folder)
    return _pictures_of_deformation(folder)


def _pictures_of_deformation(folder: Path) -> dict[str, Picture]:
    """Those of a folder that `pcbench deform` wrote."""
    bend = read_deformation(folder)
    if not (folder / "deformation.ply").is_file():
        return {}
    cloud, field = read_cloud(folder / "aligned.ply"), read_cloud(folder / "deformation.ply")
    return _bends("", bend, cloud, field, cloud.unit or field.unit or "units of the file")


def _bends(name: str, bend: Deformation, cloud: Cloud, field: Cloud, unit: str) -> dict[str, Picture]:
    title = f"{name or 'candidate'} against the reference: {bend.verdict} ({bend.model} model)"
    prefix, still = f"{name}_" if name else "", "the chosen model moves nothing"
    return {
        f"{prefix}deformation": Picture(lambda path: bends.evidence(bend, field, title, unit, path), still),
        f"{prefix}displacement": Picture(lambda path: bends.arrows(cloud, field, title, unit, path), still),
    }


def _pictures_of_comparison(folder: Path) -> dict[str, Picture]:
    report = read_report(folder)
    deviations = {candidate.name: candidate.deviation for candidate in report.candidates}
    cores = {candidate.name: candidate.m3c2 for candidate in report.candidates if candidate.m3c2 is not None}
    found = {
        "distribution": Picture(lambda path: charts.distribution(report, path)),
        "reference": Picture(
            lambda path: maps.reference(report.reference(), deviations, path), "the reference's file has gone"
        ),
    }
    for scalar in dict.fromkeys(name for cloud in deviations.values() for name in cloud.attributes):
        found |= _maps(deviations, scalar, report.unit)
    found |= _maps(cores, "m3c2_distance", report.unit)
    for candidate in report.candidates:
        if candidate.field is not None and candidate.deformation is not None:
            bend = candidate.deformation
            found |= _bends(candidate.name, bend, candidate.deviation, candidate.field, report.unit)
    return found


def _maps(clouds: dict[str, Cloud], scalar: str, unit: str) -> dict[str, Picture]:
    """The pictures of one scalar, a candidate each, with one colour scale."""
    having = {name: cloud for name, cloud in clouds.items() if scalar in cloud.attributes}
    values = [np.asarray(cloud.attributes[scalar], dtype=np.float64) for cloud in having.values()]
    values = [v[np.isfinite(v)] for v in values if np.isfinite(v).any()]
    if not values:
        return {}
    limits = maps.limits(values)
    label = f"{maps.LABELS.get(scalar, scalar.replace('_', ' '))} [{unit}]"

    def picture(name: str) -> Picture:
        return Picture(lambda path: maps.deviation(having, name, scalar, limits, label, path))

    return {f"{name}_{scalar}": picture(name) for name in having}
