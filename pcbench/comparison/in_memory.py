"""Comparison of clouds in memory: the back end of `pcbench.comparison.pipeline` over arrays."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pcbench.changes import Changes
from pcbench.comparison.pipeline import compare_candidates, record_time
from pcbench.comparison.result import Comparison
from pcbench.deformation import Deformation
from pcbench.errors import Notice
from pcbench.geometry.arrays import IntArray, bounds
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.crs import check_lengths
from pcbench.geometry.mesh import Mesh
from pcbench.geometry.mesh_samples import sample_candidate, sampling_notice, vertex_cloud
from pcbench.geometry.splats import has_splats, means_notice
from pcbench.io.map_tiles import MapOverview
from pcbench.measure.deviation import DeviationMap
from pcbench.measure.directions import Direction
from pcbench.measure.intervals import CorrelationCells
from pcbench.measure.m3c2 import compare_along_normals, m3c2_warnings
from pcbench.measure.m3c2_settings import M3C2Settings
from pcbench.measure.offset import SignedOffset, signed_offset
from pcbench.measure.own_metrics import MeasuredPair, OwnMetric, OwnResults, measure_own
from pcbench.measure.pair import (
    AlignedCandidate,
    Matched,
    align,
    assess_deformation,
    find_changes,
    match_pair,
    measure_directions,
    split_into_budget,
)
from pcbench.measure.plane_sample import PlaneSample
from pcbench.measure.presets import CroppedPair, Preset, measure_preset
from pcbench.measure.reference import Reference
from pcbench.measure.results import DirectedBudget
from pcbench.measure.settings import Settings
from pcbench.measure.summaries import DirectionSummary, summarize
from pcbench.measure.tiled.overview import OverviewSums, PixelGrid, along_upward_normals
from pcbench.progress import ProgressPlan
from pcbench.registration import Registration
from pcbench.systems import release_free_memory

_BLOCK_QUERIES = 1 << 16  # queries that are added to a raster at a time


def compare_in_memory(
    reference: Cloud | Mesh,
    candidates: Mapping[str, Cloud | Mesh],
    settings: Settings,
    on_step: Callable[[str], None],
) -> Comparison:
    """Compare candidates with a reference in memory.

    Args:
        reference: the reference; a mesh is sampled uniformly by area, with the normals of its faces.
        candidates: the candidates by name, at least one. A mesh is sampled too, more densely than the reference's
            points, unless `Settings.vertices` selects its vertices.
        settings: the settings.
        on_step: called with a short text before each step that takes time.

    Raises:
        InputError: a cloud, a setting or a region is not usable.
        RegistrationError: a candidate does not overlap the reference.
    """
    with_cores = settings.with_cores_read()
    for name, shape in {"the reference": reference, **candidates}.items():
        check_lengths(shape, name)
    if settings.vertices:
        candidates = {name: vertex_cloud(shape) for name, shape in candidates.items()}
    clouds = {
        name: sample_candidate(shape, reference, settings.seed, settings.samples) for name, shape in candidates.items()
    }
    step = ProgressPlan(on_step, _expected_seconds(reference, clouds, settings))
    step("indexing the reference")
    timings: dict[str, float] = {}
    with record_time(timings, "reference"):
        prepared = Reference.prepare(reference, settings)
    for name in _poisson_maps(settings):
        step("reconstructing the reference's surface")
        prepared = prepared.with_poisson_mesh(name)
    reference_side = ReferenceInMemory(prepared, with_cores, candidates, clouds)
    compared = compare_candidates(
        reference_side, list(clouds), timings["reference"], step, tests_deformation=settings.deformation
    )
    return Comparison(settings, prepared.summary(), *compared)


@dataclass(frozen=True, eq=False)
class ReferenceInMemory:
    """The prepared reference, and the candidates as they were read (`shapes`) and as clouds."""

    prepared: Reference
    settings: Settings
    shapes: Mapping[str, Cloud | Mesh]
    clouds: Mapping[str, Cloud]

    @property
    def crs(self) -> str | None:
        """Coordinate system, if known."""
        return self.prepared.cloud.crs

    @property
    def thresholds(self) -> tuple[float, ...]:
        """Distance thresholds of the F-score."""
        return self.settings.thresholds_for(self.prepared.spacing)

    @property
    def correlation_cells(self) -> CorrelationCells:
        """Correlation cells of the intervals."""
        return self.prepared.cells

    def register(self, name: str) -> PairInMemory:
        """Align a candidate; see `pcbench.measure.pair.align`."""
        release_free_memory()  # that the reading of files, or the candidate before, left in the heap
        aligned = align(self.prepared, name, self.clouds[name], self.settings)
        return PairInMemory(self.prepared, aligned, self.shapes[name], self.settings, self.thresholds)


@dataclass(frozen=True, eq=False)
class PairInMemory:
    """A candidate aligned with the reference; see `pcbench.comparison.pipeline.AlignedPair`."""

    reference: Reference
    aligned: AlignedCandidate
    shape: Cloud | Mesh
    settings: Settings
    thresholds: tuple[float, ...]

    @property
    def registration(self) -> Registration:
        """Registration of the candidate."""
        return self.aligned.registration

    @property
    def points(self) -> int:
        """Number of points of the candidate."""
        return len(self.aligned.cloud)

    @property
    def points_in_region(self) -> int:
        """Number of aligned points inside the region."""
        return int(np.count_nonzero(self.aligned.inside))

    @property
    def faces(self) -> int | None:
        """Number of faces if the candidate is a mesh, whose points are samples."""
        return len(self.shape) if isinstance(self.shape, Mesh) else None

    @property
    def steps(self) -> tuple[float, ...]:
        """Steps in which the candidate's own x, y and z are rounded."""
        return tuple(self.aligned.cloud.quantisation.steps.tolist())

    @property
    def crs(self) -> str | None:
        """Coordinate system of the candidate, if known."""
        return self.aligned.cloud.crs

    @property
    def sampling_notices(self) -> Sequence[Notice]:
        """A notice if the candidate is a sampled mesh, or a model of splats."""
        if not isinstance(self.shape, Mesh):
            return [means_notice(self.points)] if has_splats(self.shape.attributes) else []
        scale = self.registration.T_reference_candidate.scale
        spacing = None if self.reference.target.is_sampled else self.reference.spacing
        return [sampling_notice(self.shape, self.points, self.settings.seed, scale=scale, spacing=spacing)]

    @cached_property
    def matched(self) -> Matched:
        """Closest points of both directions."""
        return match_pair(self.reference, self.aligned)

    @cached_property
    def closest(self) -> IntArray:
        """(M,) reference points closest to the candidate's points inside the region."""
        return self.matched.forth.indices

    def match(self) -> None:
        """Find the closest points of both directions."""
        _ = self.matched

    @cached_property
    def local_changes(self) -> Changes:
        """Changes between the complete clouds, in local coordinates."""
        changes = find_changes(self.reference, self.aligned, self.matched)
        release_free_memory()  # that the search left in the heap
        return changes

    @property
    def changes(self) -> Changes:
        """Changes between the complete clouds, in the reference's coordinates."""
        return self.local_changes.shifted(self.reference.origin)

    @cached_property
    def directions(self) -> tuple[Direction, Direction]:
        """Distances c→r and r→c with their sampling floors."""
        return measure_directions(self.reference, self.aligned, self.matched, self.settings.seed)

    def measure_distances(self) -> None:
        """Measure the distances of both directions, with their sampling floors."""
        _ = self.directions

    def summaries(self) -> tuple[DirectionSummary, DirectionSummary]:
        """Return all that the metrics need to know about the distances c→r and r→c."""
        reference = self.reference
        corner = reference.surface.corner if reference.rows is None else bounds(reference.measured_points)[0]

        def summary(direction: Direction) -> DirectionSummary:
            return summarize(
                direction,
                self.thresholds,
                cells=reference.cells,
                voxel=reference.voxel,
                corner=corner,
                origin=reference.origin,
            )

        forth, back = self.directions
        return summary(forth), summary(back)

    def maps(self) -> tuple[DeviationMap, DeviationMap]:
        """Return the deviation map, also to meshes and by M3C2 if they are wanted, and the completeness map."""
        forth, back = self.directions
        scalars, unsigned = {"distance": forth.distances.to_points}, {"distance"}
        if isinstance(forth.distances.to_planes, np.ndarray):  # sampled ones make no map
            scalars["plane_distance"] = forth.distances.to_planes
        for name, mesh in self.reference.meshes.items():
            if not mesh.supports_signed_distance:
                unsigned.add(name)
            scalars[name] = mesh.query(forth.points, signed=mesh.supports_signed_distance).distances
        along_normals = None
        if "m3c2" in self.settings.maps:
            how = self.settings.m3c2 if isinstance(self.settings.m3c2, M3C2Settings) else M3C2Settings()
            along_normals = compare_along_normals(self.reference, self.aligned.index, self.registration, how)
        points, rows = forth.points + self.reference.origin, np.flatnonzero(self.aligned.inside)
        from_candidate, from_reference = self._overviews()
        deviation = DeviationMap(points, rows, scalars, along_normals, frozenset(unsigned), overview=from_candidate)
        distances = {"distance": back.distances.to_points}
        return deviation, DeviationMap(*self.reference.measured, distances, overview=from_reference)

    def _overviews(self) -> tuple[MapOverview, MapOverview]:
        """Return the rasters of both maps, with the same values as those in tiles."""
        reference = self.reference
        pixels = PixelGrid.covering(reference.points, *reference.surface.bounds, reference.spacing)

        def overview(direction: Direction, tangents: IntArray | None, sign: int) -> MapOverview:
            """Return the raster of a direction, whose planes are those at rows (M,) of the reference, or at all."""
            total, distances = OverviewSums(pixels), direction.distances
            for start in range(0, len(direction.points), _BLOCK_QUERIES):  # to limit memory
                block = slice(start, start + _BLOCK_QUERIES)
                signed = np.full(len(direction.points[block]), np.nan)
                if isinstance(distances.to_planes, np.ndarray):
                    normals = reference.surface.compute_normals(tangents)
                    normals = normals[block if tangents is None else tangents[block]]
                    signed = sign * along_upward_normals(distances.to_planes[block], normals)
                total.add_points(direction.points[block], distances.to_points[block], signed)
            return total.overview(reference.origin)

        forth, back = self.directions
        # A point of the reference below the candidate has a negative distance to it.
        return overview(forth, self.closest, 1), overview(back, reference.rows, -1)

    def presets(self, deviation: DeviationMap) -> Mapping[str, Preset]:
        """Return the metrics as other tools define them, between clouds cut at the region."""
        is_sampled = any(isinstance(way.distances.to_planes, PlaneSample) for way in self.directions)
        pair = self.matched.pair if is_sampled else self._with_normals(self.matched.pair)
        to_poisson = deviation.scalars.get("poisson_distance")
        return {
            name: measure_preset(name, pair, self.thresholds, to_poisson=to_poisson, mpeg_peak=self.settings.mpeg_peak)
            for name in self.settings.measured_presets
        }

    def own_metrics(self) -> OwnResults:
        """Return the user-defined metrics, of points minus the reference's origin."""
        metrics = tuple(map(OwnMetric.of, self.settings.own_metrics))
        if not metrics:
            return OwnResults({}, ())
        reference, is_cropped = self.reference, self.reference.region is not None
        pair = MeasuredPair.of(
            self.aligned.index.points,
            reference.points,
            self.matched.forth,
            self.matched.back,
            normals=reference.surface.compute_normals(None) if reference.has_normals else None,
            origin=reference.origin,
            unit=reference.cloud.unit,
            candidate_rows=np.flatnonzero(self.aligned.inside) if is_cropped else None,
            reference_rows=reference.rows,
        )
        return measure_own(metrics, pair)

    def _with_normals(self, pair: CroppedPair) -> CroppedPair:
        """Return a cropped pair with the reference's normals, computed and as given, if there are any."""
        rows, given = self.reference.rows, self.reference.cloud.normals
        normals = self.reference.surface.compute_normals(rows) if self.reference.has_normals else None
        if rows is not None:
            normals, given = (None if n is None else n[rows] for n in (normals, given))
        return pair._replace(normals=normals, raw_normals=given)

    def release_matches(self) -> None:
        """Release the matches, except the closest points of the reference."""
        _ = self.closest
        self.__dict__.pop("matched", None)
        release_free_memory()

    def assess_deformation(self) -> Deformation:
        """Assess the deformation of the part that did not change."""
        return assess_deformation(self.reference, self.aligned, self.settings.seed, self.local_changes)

    def split_into_budget(self, deformation: Deformation) -> DirectedBudget | None:
        """Return what D2 consists of; None if it is unknown or estimated from a sample."""
        return split_into_budget(
            self.reference, self.aligned, self.closest, self.directions, self.local_changes, deformation
        )

    @property
    def offset(self) -> SignedOffset | None:
        """Signed offset from the reference's surface; None without normals."""
        forth, _ = self.directions
        return signed_offset(forth.distances, forth.cells, self.reference.cells)

    @property
    def censored(self) -> Mapping[str, float]:
        """No distance is censored in memory."""
        return {}

    def warnings(self, deviation: DeviationMap) -> Sequence[Notice]:
        """Return the warnings about M3C2, if it was computed."""
        return [] if deviation.m3c2 is None else list(m3c2_warnings(deviation.m3c2))


def _expected_seconds(reference: Cloud | Mesh, candidates: Mapping[str, Cloud], settings: Settings) -> list[float]:
    """Estimate the duration of each announced step, in seconds, for progress bars."""
    first = len(reference) / 1e6 if isinstance(reference, Cloud) else 1.0
    expected = [0.2 + 2 * first, *(20.0 + 30 * first for _ in _poisson_maps(settings))]
    for cloud in candidates.values():
        both = first + len(cloud) / 1e6
        m3c2_too = 5.0 + 5 * both if "m3c2" in settings.maps else 0.0
        expected += [0.3 + 3 * both, 0.1 + 0.5 * both, 0.2 + 1 * both + m3c2_too]
        expected += [1.0 + 4 * both] if settings.deformation else []
    return expected


def _poisson_maps(settings: Settings) -> Iterator[str]:
    return (name for name in settings.maps if name.startswith("poisson"))
