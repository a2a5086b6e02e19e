"""Definitions of pcbench, of other tools and of papers as protocols: given poses, neither masks nor a sampling order.

`PcbenchProtocol` is the default; a region selects its queries. The others have the definitions of
`pcbench.measure.presets`, for which a region crops both clouds.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np

from pcbench.errors import InputError
from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.crop import points_inside
from pcbench.geometry.crs import check_lengths
from pcbench.geometry.mesh import Mesh
from pcbench.geometry.mesh_samples import REFERENCE_SAMPLES, sample_candidate, sample_reference, sampling_notice
from pcbench.geometry.neighbors import Index, Matches
from pcbench.geometry.region_text import as_region
from pcbench.geometry.regions import Region
from pcbench.geometry.sampling import NeighborRange
from pcbench.geometry.transform import Similarity
from pcbench.geometry.units import check_same_unit
from pcbench.io.contents import FileStatus, status_of
from pcbench.io.source import Source
from pcbench.measure import presets
from pcbench.measure.metrics import FScore
from pcbench.measure.own_metrics import MeasuredPair, OwnMetric, OwnResults, measure_own, own_scores
from pcbench.measure.protocols.protocol import (
    Evaluation,
    EvaluationInputs,
    ProtocolScore,
    Shape,
    protocol_text,
)
from pcbench.measure.score_pairs import BothWays, MatchedPair, normals_of, plane_metrics, point_metrics

_DIRECTED_LENGTHS = ("mean_distance", "d1_rms", "d2_rms")
_LENGTHS = ("chamfer", "hausdorff")


@dataclass(frozen=True)
class PcbenchProtocol:
    """pcbench's own metrics.

    Attributes:
        thresholds: distance thresholds of precision, recall and F-score; none: these are left out.
        samples: number of points that are sampled on a candidate mesh; 0: ten per point of the reference.
    """

    thresholds: tuple[float, ...] = ()
    samples: int = 0

    name: ClassVar[str] = "pcbench"
    title: ClassVar[str] = "pcbench"
    citation: ClassVar[str] = "page Definitions of its documentation"
    version: ClassVar[str] = "pcbench"

    def __post_init__(self) -> None:
        _check_settings(self.name, self.thresholds, self.samples)

    def other_files(self, inputs: EvaluationInputs) -> tuple[Path, ...]:
        """Return no files."""
        return ()

    def evaluate(self, inputs: EvaluationInputs) -> Evaluation:
        """Measure mean distances, D1, D2, Chamfer, Hausdorff and F-scores in the given pose.

        Raises:
            InputError: a file cannot be read, or a region contains no point.
        """
        pair = _PosedPair.read(inputs, self.samples)
        reference, moved = pair.reference, pair.moved
        inputs.on_step("matching points")
        matched = MatchedPair.of(reference.index, Index(moved))
        rows, rows_back = pair.rows_inside()
        values = point_metrics(
            matched.to_reference.distances[rows], matched.to_candidate.distances[rows_back], self.thresholds
        )
        notes = list(pair.notes)
        if reference.has_normals:
            values |= plane_metrics(matched, reference.normals, rows, rows_back)
        else:
            notes.append("the reference has fewer than three points, so that there is no D2")
        own = _measure_user_defined(inputs.metrics, pair, matched, rows, rows_back)
        scores = (*_own_scores(values, pair.unit), *own_scores(own, pair.unit))
        notes += map(str, own.warnings)
        counts = pair.counts(len(rows), len(rows_back))
        return Evaluation(protocol_text(self), scores, counts, tuple(notes), own.failed)


@dataclass(frozen=True)
class PresetProtocol:
    """Definitions of another tool or paper; see `pcbench.measure.presets`.

    Attributes:
        samples: number of points that are sampled on a candidate mesh; 0: ten per point of the reference.
        squares: names of scores in squared units, besides those that end in `_mse`.
    """

    samples: int = 0

    name: ClassVar[str] = ""
    title: ClassVar[str] = ""
    citation: ClassVar[str] = ""
    version: ClassVar[str] = ""
    squares: ClassVar[frozenset[str]] = frozenset()

    def __post_init__(self) -> None:
        _check_settings(self.name, self._thresholds(), self.samples)

    def _thresholds(self) -> tuple[float, ...]:
        return ()

    def _mpeg_peak(self) -> float | None:
        return None

    def other_files(self, inputs: EvaluationInputs) -> tuple[Path, ...]:
        """Return no files."""
        return ()

    def evaluate(self, inputs: EvaluationInputs) -> Evaluation:
        """Compute the preset in the given pose.

        Raises:
            InputError: a file cannot be read, or a region contains no point.
        """
        pair = _PosedPair.read(inputs, self.samples)
        reference, moved = pair.reference, pair.moved
        rows, rows_back = pair.rows_inside()
        inputs.on_step("matching points")
        normals = reference.normals if reference.has_normals else None
        given = reference.cloud.normals
        if inputs.crop is None:
            index, neighbors = reference.index, reference.neighbors
        else:
            index = Index(reference.index.points[rows_back])
            neighbors = NeighborRange.within(index)
            normals, given = (None if each is None else each[rows_back] for each in (normals, given))
        cropped = presets.match(index, Index(moved[rows]), neighbors, normals, given)
        result = presets.measure_preset(self.name, cropped, self._thresholds(), mpeg_peak=self._mpeg_peak())
        scores = tuple(_preset_scores(result, pair.unit, self.squares))
        return Evaluation(protocol_text(self), scores, pair.counts(len(rows), len(rows_back)), pair.notes)


@dataclass(frozen=True)
class Gao2025Protocol(PresetProtocol):
    """Definitions of Gao et al. 2025, see `pcbench.measure.presets.gao2025`."""

    name: ClassVar[str] = "gao2025"
    title: ClassVar[str] = "Gao et al. 2025"
    citation: ClassVar[str] = "Gao et al. 2025, table 2"
    version: ClassVar[str] = "the paper; its code is not public"
    squares: ClassVar[frozenset[str]] = frozenset({"chamfer"})


@dataclass(frozen=True)
class MpegProtocol(PresetProtocol):
    """Metrics of MPEG's pc_error, see `pcbench.measure.presets.mpeg`.

    Attributes:
        peak: peak of the PSNR; 0: the largest distance from a point of the reference to its nearest neighbour.
    """

    peak: float = 0.0

    name: ClassVar[str] = "mpeg"
    title: ClassVar[str] = "MPEG pc_error"
    citation: ClassVar[str] = "Tian et al. 2017, Geometric distortion metrics for point cloud compression"
    version: ClassVar[str] = "mpeg-pcc-dmetric 0.14.2"
    squares: ClassVar[frozenset[str]] = frozenset({"hausdorff_squared_d1", "hausdorff_squared_d2"})

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 <= self.peak < np.inf:
            raise InputError(f"mpeg: expected the peak as a length, or 0 for the default, got {self.peak:g}")

    def _mpeg_peak(self) -> float | None:
        return self.peak or None


@dataclass(frozen=True)
class PdalProtocol(PresetProtocol):
    """Numbers that `pdal chamfer` and `pdal hausdorff` print, see `pcbench.measure.library_presets.Pdal`."""

    name: ClassVar[str] = "pdal"
    title: ClassVar[str] = "PDAL"
    citation: ClassVar[str] = "PDAL contributors, pdal chamfer and pdal hausdorff"
    version: ClassVar[str] = "PDAL 2"
    squares: ClassVar[frozenset[str]] = frozenset({"chamfer"})


@dataclass(frozen=True)
class Pytorch3dProtocol(PresetProtocol):
    """Numbers that PyTorch3D's `chamfer_distance` returns, see `pcbench.measure.library_presets.Pytorch3d`."""

    name: ClassVar[str] = "pytorch3d"
    title: ClassVar[str] = "PyTorch3D"
    citation: ClassVar[str] = "Ravi et al. 2020, Accelerating 3D deep learning with PyTorch3D"
    version: ClassVar[str] = "PyTorch3D 0.7, loss.chamfer_distance"
    squares: ClassVar[frozenset[str]] = frozenset({"chamfer", "single_directional"})


@dataclass(frozen=True)
class PointCloudUtilsProtocol(PresetProtocol):
    """Numbers that functions of point-cloud-utils return, see `pcbench.measure.library_presets.PointCloudUtils`."""

    name: ClassVar[str] = "point-cloud-utils"
    title: ClassVar[str] = "point-cloud-utils"
    citation: ClassVar[str] = "Williams 2022, Point Cloud Utils"
    version: ClassVar[str] = "point-cloud-utils 0.34"


@dataclass(frozen=True)
class FscoreProtocol(PresetProtocol):
    """Definitions of a library that have an F-score.

    Attributes:
        thresholds: distance thresholds of the F-score.
    """

    thresholds: tuple[float, ...] = ()

    def _thresholds(self) -> tuple[float, ...]:
        return self.thresholds


@dataclass(frozen=True)
class KaolinProtocol(FscoreProtocol):
    """Numbers that functions of Kaolin return, see `pcbench.measure.library_presets.Kaolin`."""

    name: ClassVar[str] = "kaolin"
    title: ClassVar[str] = "Kaolin"
    citation: ClassVar[str] = "Fuji Tsang et al. 2022, Kaolin: a PyTorch library for accelerating 3D deep learning"
    version: ClassVar[str] = "Kaolin, metrics.pointcloud"
    squares: ClassVar[frozenset[str]] = frozenset({"chamfer"})


@dataclass(frozen=True)
class Open3dProtocol(FscoreProtocol):
    """Numbers that Open3D's `compute_metrics` returns, see `pcbench.measure.library_presets.Open3d`."""

    name: ClassVar[str] = "open3d"
    title: ClassVar[str] = "Open3D"
    citation: ClassVar[str] = "Zhou et al. 2018, Open3D: a modern library for 3D data processing"
    version: ClassVar[str] = "Open3D 0.20, t.geometry.PointCloud.compute_metrics"


PRESET_PROTOCOLS = (
    PcbenchProtocol,
    Gao2025Protocol,
    MpegProtocol,
    *(Open3dProtocol, PdalProtocol, Pytorch3dProtocol, KaolinProtocol, PointCloudUtilsProtocol),
)


@dataclass(frozen=True, eq=False)
class _PreparedReference:
    """A reference near its own origin, with what all candidates of its scene need."""

    cloud: Cloud
    origin: FloatArray
    index: Index
    is_mesh: bool
    note: str

    @classmethod
    def of(cls, shape: Cloud | Mesh, seed: int) -> _PreparedReference:
        cloud = sample_reference(shape, seed)
        origin = np.floor(cloud.points.mean(axis=0))
        is_mesh = isinstance(shape, Mesh)
        note = f"the reference is a mesh: {len(cloud):,} points sampled on it by area (seed {seed})" if is_mesh else ""
        return cls(cloud, origin, Index(cloud.points - origin), is_mesh, note)

    @cached_property
    def normals(self) -> FloatArray:
        return normals_of(self.index, self.cloud.normals)

    @property
    def has_normals(self) -> bool:
        return len(self.cloud) >= 3

    @cached_property
    def neighbors(self) -> NeighborRange | None:
        return NeighborRange.within(self.index)


class _PosedPair(NamedTuple):
    """The reference, the candidate's points near the reference's origin, and what a reader has to know."""

    reference: _PreparedReference
    moved: FloatArray
    region: Region | None
    unit: str
    notes: tuple[str, ...]

    @classmethod
    def read(cls, inputs: EvaluationInputs, samples: int) -> _PosedPair:
        """Read both shapes, sample meshes, and apply the pose.

        Raises:
            InputError: a file cannot be read, its coordinates are degrees, the files have different units, or the
                polygons of the region are in another coordinate system.
        """
        notes: list[str] = []
        inputs.on_step("reading the clouds")
        reference = _prepare(inputs.reference, inputs.seed, notes)
        shape = _read(inputs.candidate, notes)
        if isinstance(shape, Mesh) and (samples or reference.is_mesh):
            cloud = shape.sample(samples or REFERENCE_SAMPLES, inputs.seed)
        else:
            cloud = sample_candidate(shape, reference.cloud, inputs.seed)
        if inputs.pose is None:  # a pose may have the scale between two units
            check_same_unit(reference.cloud.unit, cloud.unit)
        pose = Similarity.identity() if inputs.pose is None else inputs.pose
        if isinstance(shape, Mesh):
            notes.append(str(sampling_notice(shape, len(cloud), inputs.seed, scale=pose.scale)))
        moved = cloud.points if inputs.pose is None else pose.apply(cloud.points)
        region = None if inputs.crop is None else as_region(inputs.crop, reference.cloud)
        return cls(reference, moved - reference.origin, region, reference.cloud.unit or "", tuple(notes))

    def rows_inside(self) -> tuple[IntArray, IntArray]:
        """Return the indices of the candidate's and of the reference's points inside the region, or of all.

        Raises:
            InputError: there is none.
        """
        origin = self.reference.origin
        region = None if self.region is None else self.region.shifted(origin)
        text = "" if self.region is None else self.region.text
        sides = ((self.moved, "the candidate's"), (self.reference.index.points, "the reference's"))
        rows = [np.flatnonzero(points_inside(points, region, text, owner, origin)) for points, owner in sides]
        return rows[0], rows[1]

    def counts(self, inside: int, inside_back: int) -> tuple[ProtocolScore, ...]:
        """Return the numbers of points, and those inside the region if there is one."""
        counts = {"candidate_points": len(self.moved), "reference_points": len(self.reference.cloud)}
        if self.region is not None:
            counts |= {"candidate_points_inside": inside, "reference_points_inside": inside_back}
        return tuple(ProtocolScore(name, float(count), better=None) for name, count in counts.items())


def _prepare(shape: Shape, seed: int, notes: list[str]) -> _PreparedReference:
    """Return a prepared reference; that of a file is kept for the next candidate of its scene."""
    if isinstance(shape, Path):
        source = Source.open(shape)
        statuses = tuple((file, status_of(file)) for file in source.content_files() if file.is_file())
        reference, warnings = _prepare_file(shape, statuses, seed)
        notes += warnings
    else:
        reference = _PreparedReference.of(_read(shape, notes), seed)
    if reference.note:
        notes.append(reference.note)
    return reference


@lru_cache(maxsize=1)
def _prepare_file(
    path: Path, statuses: tuple[tuple[Path, FileStatus], ...], seed: int
) -> tuple[_PreparedReference, tuple[str, ...]]:
    warnings: list[str] = []
    return _PreparedReference.of(_read(path, warnings), seed), tuple(warnings)


def _read(shape: Shape, notes: list[str]) -> Cloud | Mesh:
    name = str(shape) if isinstance(shape, Path) else "the cloud"
    given = Source.open(shape).read(notes.append) if isinstance(shape, Path) else shape
    check_lengths(given, name)
    return given


def _check_settings(name: str, thresholds: tuple[float, ...], samples: int) -> None:
    if wrong := [value for value in thresholds if not 0 < value < np.inf]:
        raise InputError(f"{name}: expected thresholds as positive lengths, got {wrong[0]:g}")
    if len(set(thresholds)) < len(thresholds):
        raise InputError(f"{name}: expected different thresholds, got one of them twice")
    if samples < 0:
        raise InputError(f"{name}: expected samples as a number of points, or 0 for the default, got {samples}")


def _measure_user_defined(
    names: Sequence[str], pair: _PosedPair, matched: MatchedPair, rows: IntArray, rows_back: IntArray
) -> OwnResults:
    """Call user-defined metrics with the points at `rows` of the candidate and at `rows_back` of the reference."""
    metrics = [OwnMetric.of(name) for name in names]
    if not metrics:
        return OwnResults({}, ())
    reference, forth, back = pair.reference, matched.to_reference, matched.to_candidate
    measured = MeasuredPair.of(
        pair.moved,
        reference.index.points,
        Matches(forth.distances[rows], forth.indices[rows]),
        Matches(back.distances[rows_back], back.indices[rows_back]),
        normals=reference.normals if reference.has_normals else None,
        origin=reference.origin,
        unit=pair.unit or None,
        candidate_rows=rows,
        reference_rows=rows_back,
    )
    return measure_own(metrics, measured)


def _own_scores(values: Mapping[str, Any], unit: str) -> Iterator[ProtocolScore]:
    """Yield the scores of `PcbenchProtocol`; those without a value have None, so that all pairs have the same names."""
    for name in _LENGTHS:
        yield ProtocolScore(name, values[name], unit)
    for name in _DIRECTED_LENGTHS:
        both: BothWays | None = values.get(name)
        for way in BothWays._fields:
            yield ProtocolScore(f"{name}.{way}", None if both is None else getattr(both, way), unit)
    for at_threshold in values["fscore"]:
        yield from _fscore_parts(at_threshold)


def _fscore_parts(at_threshold: FScore) -> Iterator[ProtocolScore]:
    for name in ("precision", "recall", "fscore"):
        yield ProtocolScore(f"{name}@{at_threshold.threshold:g}", getattr(at_threshold, name), better="higher")


def _preset_scores(result: presets.Preset, unit: str, squares: Collection[str]) -> Iterator[ProtocolScore]:
    """Yield the numbers of a preset; those of both directions have the direction in their name."""
    for item in fields(result):
        value: Any = getattr(result, item.name)
        is_squared = item.name.endswith("_mse") or item.name in squares
        length = f"{unit}²" if unit and is_squared else unit
        if is_dataclass(value):
            for way in fields(value):
                yield ProtocolScore(f"{item.name}.{way.name}", getattr(value, way.name), length)
        elif isinstance(value, tuple):
            for at_threshold in value:
                yield from _fscore_parts(at_threshold)
        elif item.name.endswith("_psnr"):
            yield ProtocolScore(item.name, value, "dB", "higher")
        elif item.name != "d2_poisson_mse":  # needs a mesh that this protocol does not make
            yield ProtocolScore(item.name, value, length, None if item.name == "peak" else "lower")
