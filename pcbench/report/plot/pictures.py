"""The pictures of a report folder by name: what each is drawn from, and by which function."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pcbench.deformation import Deformation
from pcbench.errors import PcbenchError
from pcbench.geometry.cloud import Cloud
from pcbench.io import read_cloud
from pcbench.io.meshes import holds_mesh, read_mesh
from pcbench.report.plot import Picture, bends, charts, maps

_MESH_SAMPLES = 500_000


@dataclass(frozen=True, eq=False)
class Report:
    """A report folder, read."""

    folder: Path
    document: dict[str, Any]
    deviations: dict[str, Cloud]  # by candidate: aligned points with their distances
    m3c2: dict[str, Cloud]  # by candidate, where there is one: core points with theirs
    fields: dict[str, Cloud]  # by candidate, where there is one: cells with their displacements

    @property
    def unit(self) -> str:
        return self.document["reference"].get("unit") or "units of the file"

    def reference(self) -> Cloud | None:
        """The reference cloud, if its file is still there."""
        settings = json.loads((self.folder / "settings.json").read_text(encoding="utf-8"))
        path = Path(settings["reference"]["path"])
        try:
            if holds_mesh(path):
                return read_mesh(path, on_warning=lambda _: None).sample(_MESH_SAMPLES)
            return read_cloud(path, on_warning=lambda _: None)
        except PcbenchError:
            return None


def read_report(folder: Path) -> Report:
    document = json.loads((folder / "comparison.json").read_text(encoding="utf-8"))
    names = [candidate["name"] for candidate in document["candidates"]]
    deviations = {name: read_cloud(folder / f"{name}_deviation.ply") for name in names}
    cores = {name: folder / f"{name}_m3c2.ply" for name in names}
    m3c2 = {name: read_cloud(path) for name, path in cores.items() if path.is_file()}
    tables = {name: folder / f"{name}_deformation.ply" for name in names}
    fields = {name: read_cloud(path) for name, path in tables.items() if path.is_file()}
    return Report(folder, document, deviations, m3c2, fields)


def pictures(folder: Path) -> dict[str, Picture]:
    """Those of a folder that `pcbench compare` or `pcbench deform` wrote."""
    if (folder / "comparison.json").is_file():
        return _pictures_of_comparison(folder)
    return _pictures_of_deformation(folder)


def _pictures_of_deformation(folder: Path) -> dict[str, Picture]:
    """Those of a folder that `pcbench deform` wrote."""
    bend = Deformation.from_json(json.loads((folder / "deformation.json").read_text(encoding="utf-8")))
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
    found = {
        "distribution": Picture(lambda path: charts.distribution(report.document, report.deviations, path)),
        "reference": Picture(
            lambda path: maps.reference(report.reference(), report.deviations, path), "the reference's file has gone"
        ),
    }
    scalars = dict.fromkeys(name for cloud in report.deviations.values() for name in cloud.attributes)
    for scalar in scalars:
        found |= _maps(report.deviations, scalar, report.unit)
    found |= _maps(report.m3c2, "m3c2_distance", report.unit)
    verdicts = {candidate["name"]: candidate.get("deformation") for candidate in report.document["candidates"]}
    for name, field in report.fields.items():
        if verdicts[name]:
            found |= _bends(name, Deformation.from_json(verdicts[name]), report.deviations[name], field, report.unit)
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
