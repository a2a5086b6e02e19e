"""Read report folders to draw their pictures."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pcbench.changes import Change
from pcbench.deformation import Deformation
from pcbench.errors import InputError, PcbenchError, describe_damage
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.mesh import Mesh
from pcbench.geometry.transform import Similarity
from pcbench.io import read_cloud
from pcbench.io.json_values import from_json
from pcbench.io.source import Source
from pcbench.measure.budget import D2Budget
from pcbench.measure.results import CANDIDATE_TO_REFERENCE, REFERENCE_TO_CANDIDATE, DirectedBudget
from pcbench.regular_files import read_json
from pcbench.report.colors import has_colors
from pcbench.report.manifest import complete_replacement
from pcbench.report.viewing import CAMERAS_FILE, ViewingCameras

UNKNOWN_UNIT = "units of the file"
_REPAIR = "copy the folder again, or repeat the command that wrote it"
MESH_SAMPLES = 1_500_000  # points on a mesh that are drawn, without gaps


class MapSample(NamedTuple):
    """Sample of points in a map: its first `even` points are an even sample of `sampled_from` measured points."""

    even: int
    sampled_from: int


@dataclass(frozen=True, eq=False)
class ReportedCandidate:
    """A candidate of a report.

    Attributes:
        name: name of the candidate.
        deviation: its aligned points with their distances.
        m3c2: core points with their M3C2 distances, if computed.
        field: cells with their displacements, if computed.
        deformation: the verdict; None in reports of early versions.
        budget: what D2 consists of; None if it is unknown, and in reports of early versions.
        changes: the changes that were found; none in reports of early versions.
        percentiles_completeness: percentiles of the distances from the reference to it, by name, such as "p50".
        completeness_path: file with the reference's measured points and these distances.
        path: file of the candidate, if it came from one and fits into memory.
        transform: maps candidate to reference coordinates, or to the upright frame of the report.
        samples: the sample that a map has, for each direction whose map does not have all points.
        rotation: rotation to that frame; None: the coordinates are those of the reference.
    """

    name: str
    deviation: Cloud
    m3c2: Cloud | None
    field: Cloud | None
    deformation: Deformation | None
    budget: DirectedBudget | None
    changes: tuple[Change, ...]
    percentiles_completeness: Mapping[str, float]
    completeness_path: Path
    path: Path | None
    transform: Similarity
    samples: Mapping[str, MapSample]
    rotation: Similarity | None = None

    def even_values(self, scalar: str) -> FloatArray:
        """Return a scalar of the deviation map at the points that represent all of them in statistics."""
        sample = self.samples.get(CANDIDATE_TO_REFERENCE)
        values: FloatArray = np.asarray(self.deviation.attributes[scalar], dtype=np.float64)
        return values if sample is None else values[: sample.even]

    def own_colors(self) -> Cloud | None:
        """Read the aligned candidate in its own colours, if it has some and its file still exists."""
        if self.path is None or not self.path.is_file():
            return None
        try:
            cloud = read_cloud(self.path, on_warning=lambda _: None)
        except PcbenchError:
            return None
        return cloud.transformed(self.transform) if has_colors(cloud.colors) else None

    @property
    def has_completeness(self) -> bool:
        """Return whether the report has a completeness map; those of early versions have none."""
        return self.completeness_path.is_file()

    def completeness(self) -> Cloud | None:
        """Read the reference's measured points with their `distance`; the file may be large."""
        return _rotated(_read(self.completeness_path), self.rotation) if self.has_completeness else None


@dataclass(frozen=True, eq=False)
class Report:
    """A saved comparison.

    Attributes:
        unit: the unit of lengths, or words for an unknown one.
        spacing_median: median spacing of the reference.
        reference_path: file of the reference, if it came from one and fits into memory.
        candidates: the candidates.
        cameras: the cameras of the scene, if recorded.
        rotation: rotation from the coordinates of the reference to those of the clouds and cameras; None: there is
            none.
        is_tiled: whether it was compared in tiles, so that its clouds are samples.
    """

    unit: str
    spacing_median: float
    reference_path: Path | None
    candidates: tuple[ReportedCandidate, ...]
    cameras: ViewingCameras | None = None
    rotation: Similarity | None = None
    is_tiled: bool = False

    def reference(self) -> Cloud | None:
        """Read the reference cloud, if it came from a file that still exists."""
        if self.reference_path is None:
            return None
        try:
            shape = Source.open(self.reference_path).read(lambda _: None)
        except PcbenchError:
            return None
        return _rotated(shape.sample(MESH_SAMPLES) if isinstance(shape, Mesh) else shape, self.rotation)


def read_report(folder: Path, *, upright: bool = False) -> Report:
    """Read the report in a folder.

    Args:
        folder: the folder.
        upright: whether to rotate clouds and cameras about the origin so that +z is up, as the cameras show.

    Raises:
        InputError: one of its files is damaged.
        OSError: comparison.json is missing.
    """
    complete_replacement(folder)
    with damage_in_one_line(folder):
        document = read_json(folder / "comparison.json")
        reference = document["reference"]
        cameras = ViewingCameras.read(folder / CAMERAS_FILE) if (folder / CAMERAS_FILE).is_file() else None
        is_tiled = document.get("tiling") is not None  # its clouds may be too large to read
        rotation = None
        if upright and cameras is not None:
            rotation, cameras = cameras.upright()
        return Report(
            unit=reference.get("unit") or UNKNOWN_UNIT,
            spacing_median=float(reference["spacing_median"] or 0.0),
            reference_path=None if is_tiled else _input_path(folder),
            candidates=tuple(
                _candidate(folder, values, None if is_tiled else _input_path(folder, values["name"]), rotation)
                for values in document["candidates"]
            ),
            cameras=cameras,
            rotation=rotation,
            is_tiled=is_tiled,
        )


def read_deformation(folder: Path) -> Deformation:
    """Read the verdict in a folder that `pcbench deform` wrote.

    Raises:
        InputError: deformation.json is damaged.
        OSError: it is missing.
    """
    complete_replacement(folder)
    with damage_in_one_line(folder):
        return Deformation.from_json(read_json(folder / "deformation.json"))


@contextmanager
def damage_in_one_line(folder: Path) -> Iterator[None]:
    """Turn errors of readers and drawing functions into an InputError that names the damaged report."""
    try:
        yield
    except InputError as error:
        if str(error).startswith(str(folder)):
            raise
        raise InputError(f"{folder}: the report is damaged: {error}: {_REPAIR}") from error
    except (AttributeError, LookupError, TypeError, ValueError, ArithmeticError, RecursionError) as error:
        raise InputError(f"{folder}: the report is damaged: {describe_damage(error)}: {_REPAIR}") from error


def _read(path: Path) -> Cloud:
    """Read a cloud of the report, without the warnings that its input had already."""
    return read_cloud(path, on_warning=lambda _: None)


def _input_path(folder: Path, candidate: str | None = None) -> Path | None:
    """Return the absolute path of the reference or a candidate in settings.json; None if it is missing.

    comparison.json has the path as typed.
    """
    try:
        settings = read_json(folder / "settings.json")
        paths = {file["name"]: file["path"] for file in settings["candidates"]}
        return Path(settings["reference"]["path"] if candidate is None else paths[candidate])
    except (OSError, KeyError, TypeError, ValueError, RecursionError):
        return None


def _candidate(
    folder: Path, values: dict[str, Any], path: Path | None, rotation: Similarity | None
) -> ReportedCandidate:
    def table(kind: str) -> Cloud | None:
        path = folder / f"{values['name']}_{kind}.ply"
        return _rotated(_read(path), rotation) if path.is_file() else None

    transform = Similarity.from_matrix(values["registration"]["T_reference_candidate"])
    return ReportedCandidate(
        name=values["name"],
        deviation=_rotated(_read(folder / f"{values['name']}_deviation.ply"), rotation),
        m3c2=table("m3c2"),
        field=table("deformation"),
        deformation=Deformation.from_json(values["deformation"]) if values.get("deformation") else None,
        budget=_budget(values["budget"]) if values.get("budget") else None,
        changes=tuple(from_json(Change, change) for change in values.get("changes") or ()),
        percentiles_completeness=values["metrics"]["percentiles"][REFERENCE_TO_CANDIDATE],
        completeness_path=folder / f"{values['name']}_completeness.ply",
        path=path,
        transform=transform if rotation is None else rotation @ transform,
        rotation=rotation,
        samples={
            direction: MapSample(int(sample["even"]), int(sample["sampled_from"]))
            for direction, sample in values.get("map_samples", {}).items()
        },
    )


def _budget(values: Mapping[str, Any]) -> DirectedBudget:
    """Read the `budget` of a candidate."""
    forth, back = (from_json(D2Budget, values[way]) for way in (CANDIDATE_TO_REFERENCE, REFERENCE_TO_CANDIDATE))
    return DirectedBudget(forth, back, values["keeps_pose"])


def _rotated(cloud: Cloud, rotation: Similarity | None) -> Cloud:
    """Return a cloud of a report after a rotation, with its displacements."""
    if rotation is None:
        return cloud
    rotated = cloud.transformed(rotation)
    names = [f"displacement_{axis}" for axis in "xyz"]
    if not set(names) <= cloud.attributes.keys():
        return rotated
    vectors = np.stack([np.asarray(cloud.attributes[name], np.float64) for name in names], axis=1)
    turned = dict(zip(names, rotation.apply_normals(vectors).T, strict=True))
    return replace(rotated, attributes={**rotated.attributes, **turned})
