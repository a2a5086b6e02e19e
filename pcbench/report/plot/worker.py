"""The drawing process: `python -m pcbench.report.plot.worker REPORT [NAME...]` prints the files it wrote."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pcbench.deformation import Deformation
from pcbench.errors import PcbenchError
from pcbench.geometry.cloud import Cloud
from pcbench.io import read_cloud
from pcbench.io.meshes import holds_mesh, read_mesh
from pcbench.report.plot import bends, charts, maps
from pcbench.studies.bench import charts as bench

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


def draw(folder: Path, wanted: list[str]) -> list[Path]:
    kinds = {
        "comparison.json": _pictures_of_comparison,
        "deformation.json": _pictures_of_deformation,
        "bench.json": _pictures_of_bench,
    }
    pictures = next(kinds[name](folder) for name in kinds if (folder / name).is_file())
    if unknown := [name for name in wanted if name not in pictures]:
        raise PcbenchError(f"no picture {unknown[0]!r}: expected {', '.join(pictures)}")
    (folder / "figures").mkdir(exist_ok=True)
    written = []
    for name in wanted or pictures:
        path = folder / "figures" / f"{name}.png"
        if pictures[name](path):
            written.append(path.relative_to(folder))
        elif name in wanted:
            unmeasured = dict.fromkeys(("speed", "accuracy_completeness"), "no run was measured")
            reasons = {"reference": "the reference's file has gone", **unmeasured}
            why = reasons.get(name, "the chosen model moves nothing")
            raise PcbenchError(f"no picture {name!r}: {why}")
    return written


def _pictures_of_bench(folder: Path) -> dict[str, Callable[[Path], bool]]:
    values = json.loads((folder / "bench.json").read_text(encoding="utf-8"))
    return {
        "speed": lambda path: bench.speed(values, path),
        "accuracy_completeness": lambda path: bench.split(values, path),
    }


def _pictures_of_deformation(folder: Path) -> dict[str, Callable[[Path], bool]]:
    """Those of a folder that `pcbench deform` wrote."""
    bend = Deformation.from_json(json.loads((folder / "deformation.json").read_text(encoding="utf-8")))
    if not (folder / "deformation.ply").is_file():
        return {}
    cloud, field = read_cloud(folder / "aligned.ply"), read_cloud(folder / "deformation.ply")
    return _bends("", bend, cloud, field, cloud.unit or field.unit or "units of the file")


def _bends(name: str, bend: Deformation, cloud: Cloud, field: Cloud, unit: str) -> dict[str, Callable[[Path], bool]]:
    title = f"{name or 'candidate'} against the reference: {bend.verdict} ({bend.model} model)"
    prefix = f"{name}_" if name else ""
    return {
        f"{prefix}deformation": lambda path: bends.evidence(bend, field, title, unit, path),
        f"{prefix}displacement": lambda path: bends.arrows(cloud, field, title, unit, path),
    }


def _pictures_of_comparison(folder: Path) -> dict[str, Callable[[Path], bool]]:
    report = read_report(folder)
    pictures: dict[str, Callable[[Path], bool]] = {
        "distribution": lambda path: charts.distribution(report.document, report.deviations, path)
    }
    pictures["reference"] = lambda path: maps.reference(report.reference(), report.deviations, path)
    scalars = dict.fromkeys(name for cloud in report.deviations.values() for name in cloud.attributes)
    for scalar in scalars:
        pictures |= _maps(report.deviations, scalar, report.unit)
    pictures |= _maps(report.m3c2, "m3c2_distance", report.unit)
    found = {candidate["name"]: candidate.get("deformation") for candidate in report.document["candidates"]}
    for name, field in report.fields.items():
        if found[name]:
            pictures |= _bends(name, Deformation.from_json(found[name]), report.deviations[name], field, report.unit)
    return pictures


def _maps(clouds: dict[str, Cloud], scalar: str, unit: str) -> dict[str, Callable[[Path], bool]]:
    """The pictures of one scalar, a candidate each, with one colour scale."""
    having = {name: cloud for name, cloud in clouds.items() if scalar in cloud.attributes}
    values = [np.asarray(cloud.attributes[scalar], dtype=np.float64) for cloud in having.values()]
    values = [v[np.isfinite(v)] for v in values if np.isfinite(v).any()]
    if not values:
        return {}
    limits = maps.limits(values)
    label = f"{maps.LABELS.get(scalar, scalar.replace('_', ' '))} [{unit}]"

    def picture(name: str) -> Callable[[Path], bool]:
        return lambda path: maps.deviation(having, name, scalar, limits, label, path)

    return {f"{name}_{scalar}": picture(name) for name in having}


def main() -> int:
    folder, *wanted = sys.argv[1:]
    try:
        written = draw(Path(folder), wanted)
    except PcbenchError as error:
        print(" ".join(str(error).split()))
        return 2
    print("\n".join(str(path) for path in written))
    return 0


if __name__ == "__main__":
    sys.exit(main())
