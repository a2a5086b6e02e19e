"""Comparison of clouds on disk, tile by tile: the back end of `pcbench.comparison.pipeline` over files.

1. Every piece of every cloud is read once and stored as a run along a Morton curve; the reference is cut into tiles.
2. The normals of the reference and its spacing are computed tile by tile.
3. Registration uses samples at full density.
4. The aligned candidate is cut into tiles, and the distances in both directions are measured tile by tile.
5. Sampling floors and the test for deformation search the surroundings of their queries in all tiles.
6. Exact counts and sums are merged into the same metrics as in memory.

No number depends on the tiles, the workers or the order in which they finish. Each step keeps its results in the
workspace.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from pcbench.changes import Changes
from pcbench.comparison.pipeline import compare_candidates, record_time
from pcbench.comparison.plan import CloudsOnDisk
from pcbench.comparison.result import Comparison
from pcbench.deformation import Deformation, SeparatedChanges
from pcbench.errors import Notice, PcbenchError
from pcbench.geometry.splats import means_notice
from pcbench.geometry.voxels import robust_extent
from pcbench.measure.budget import FitFrame
from pcbench.measure.deviation import DeviationMap, Spread
from pcbench.measure.intervals import CorrelationCells
from pcbench.measure.offset import SignedOffset
from pcbench.measure.own_metrics import OwnResults
from pcbench.measure.presets import Preset
from pcbench.measure.results import (
    CANDIDATE_TO_REFERENCE,
    REFERENCE_TO_CANDIDATE,
    DirectedBudget,
    ReferenceSummary,
    Tiling,
)
from pcbench.measure.settings import Settings
from pcbench.measure.summaries import DirectionSummary
from pcbench.measure.tiled import windows
from pcbench.measure.tiled.alignment import NearFit, SampleResults, register_on_disk
from pcbench.measure.tiled.assessment import (
    AlignedCloud,
    Floors,
    assess_deformation,
    find_changes,
    measure_floors,
    split_into_budget,
)
from pcbench.measure.tiled.directions import MeasuredDirection, TiledPair, measure_spreads, measure_tiles
from pcbench.measure.tiled.labels import PointLabels
from pcbench.measure.tiled.maps import show_direction, write_direction
from pcbench.measure.tiled.overview import PixelGrid
from pcbench.measure.tiled.prepared import TiledReference, prepare_reference
from pcbench.measure.tiled.presets import measure_presets
from pcbench.measure.tiled.runs import tile_ranges
from pcbench.measure.tiled.settings import TilingSettings
from pcbench.measure.tiled.steps import REFERENCE, Steps
from pcbench.measure.tiled.stored import StoredCloud, lattice_around, rough_boxes, store_cloud
from pcbench.measure.tiled.tiles import TiledCloud, TileSummary
from pcbench.registration import Registration
from pcbench.tasks import TaskRunner, Workers

SAMPLED_REGION = "sampled-region"
"""Code of the warning that the region was found from a sample of the reference."""


def compare_in_tiles(
    clouds: CloudsOnDisk,
    settings: Settings,
    tiling: TilingSettings,
    *,
    key: str,
    workspace: Path,
    maps: Path | None,
    on_step: Callable[[str], None],
) -> Comparison:
    """Compare candidates with a reference tile by tile; metrics equal those of a comparison in memory.

    Args:
        clouds: the clouds.
        settings: settings of the comparison. Maps, the presets mpeg and tnt, and a tolerance are not computed in tiles.
        tiling: settings of the tiles, of memory and of workers.
        key: identifies the inputs and settings, see `CloudsOnDisk.key`.
        workspace: folder for intermediate files, which exists. The same call continues from finished tiles in it.
        maps: folder for the maps of all points, which is created; None: no maps are written.
        on_step: called with a short text before each step that takes time.

    Raises:
        InputError: a file or a setting is not usable, or a file is damaged and such files are not left out.
        RegistrationError: a candidate does not overlap the reference.
        WorkerError: a tile needs too much memory, or the cluster is lost.
        PcbenchError: a file changed while it was read.
    """
    folder = workspace.absolute() / key[:16]
    key = f"{key}{maps is not None}"  # without maps, tiles have no sums for overviews
    with TaskRunner(Workers(tiling.chosen_workers, tiling.cluster), folder / "results", on_step) as runner:
        steps = Steps(runner, folder, key, settings, tiling, tiling.chosen_tile_points, on_step)
        stored = _store(steps, clouds)
        are_small = all(cloud.count <= windows.MAX_SAMPLE for cloud in stored.values())
        timings: dict[str, float] = {}
        with record_time(timings, "reference"):
            prepared = prepare_reference(steps, stored[REFERENCE], are_small=are_small)
        stages = dict(zip(clouds.candidates, list(stored)[1:], strict=True))
        reference = ReferenceInTiles(steps, prepared, stages, stored, maps)
        compared = compare_candidates(
            reference,
            list(stages),
            timings["reference"],
            lambda _: None,  # the steps in tiles announce themselves
            tests_deformation=settings.deformation,
        )
        return Comparison(settings, reference.summary(), *compared, tiling=reference.describe_tiling())


def _store(steps: Steps, clouds: CloudsOnDisk) -> dict[str, StoredCloud]:
    """Store the points of the reference and of each candidate along the same Morton curve, by the name of their stage.

    Raises:
        PcbenchError: a file changed while it was read.
    """
    pose = steps.settings.known_pose
    named = {REFERENCE: clouds.reference}
    named |= {f"candidate-{number}": cloud for number, cloud in enumerate(clouds.candidates.values(), 1)}
    boxes = rough_boxes(named, steps.runner, steps.key)
    poses = dict.fromkeys(boxes, pose) | {REFERENCE: None}
    lattice = lattice_around(boxes, poses)

    stored: dict[str, StoredCloud] = {}
    for source, (stage, cloud) in zip(clouds.sources, named.items(), strict=True):
        placed, folder = replace(lattice, pose=poses[stage]), steps.folder / stage / "runs"
        stored[stage] = store_cloud(
            stage,
            cloud,
            placed,
            folder,
            steps.runner,
            steps.key,
            clouds.contents,
            skip_bad=steps.tiling.skip_bad,
        )
        try:
            for file in source.content_files():  # also those that pieces do not name, such as nodes of EPT
                if file in clouds.contents:
                    clouds.contents[file].check()
        except PcbenchError:
            shutil.rmtree(steps.folder)  # nobody knows which pieces have the recorded content
            raise
    return stored


@dataclass(frozen=True, eq=False)
class ReferenceInTiles:
    """The reference in tiles, and the stored candidates.

    Attributes:
        tasks: settings, workers and files of all steps.
        prepared: the reference with all that its candidates share.
        stages: name of each candidate's stages and folders, by the candidate's name.
        stored: the clouds by the names of their stages.
        maps: folder for the maps of all points; None: none are written.
        samples: the sample of the reference for each candidate that was registered so far.
    """

    tasks: Steps
    prepared: TiledReference
    stages: Mapping[str, str]
    stored: Mapping[str, StoredCloud]
    maps: Path | None
    samples: list[ReferenceSummary] = field(default_factory=list)

    @property
    def crs(self) -> str | None:
        """Coordinate system, if known."""
        return self.prepared.stored.source.crs

    @property
    def thresholds(self) -> tuple[float, ...]:
        """Distance thresholds of the F-score."""
        return self.prepared.thresholds

    @property
    def correlation_cells(self) -> CorrelationCells:
        """Correlation cells of the intervals, without the cell of each point."""
        grid = self.prepared.grid
        return CorrelationCells(np.zeros(0, np.int16), grid.shape, grid.side)

    def register(self, name: str) -> PairInTiles:
        """Align a candidate; see `pcbench.measure.tiled.alignment.register_on_disk`."""
        stage = self.stages[name]
        sample = register_on_disk(self.tasks, self.prepared, stage, name, self.stored[stage])
        self.samples.append(sample.reference)
        return PairInTiles(self, name, stage, self.stored[stage], sample)

    def summary(self) -> ReferenceSummary:
        """Summarise the reference for the result, after its candidates were compared."""
        prepared, sample = self.prepared, self.samples[0]
        stored, source = prepared.stored, prepared.stored.source
        return ReferenceSummary(
            points=stored.count,
            points_in_region=prepared.inside,
            spacing_median=prepared.spacing,
            extent=robust_extent(stored.even - prepared.origin),
            crs=source.crs,
            unit=source.unit,
            steps=tuple(stored.quantisation.steps.tolist()),
            normals=sample.normals,
            faces=None,
            block_side=prepared.grid.side,
            voxel_side=prepared.voxel,
            warnings=(*sample.warnings, *_reader_warnings(stored), *self._region_warnings()),
        )

    def _region_warnings(self) -> list[Notice]:
        """Return a warning if the region follows from a sample of the points, and so may differ from that in memory."""
        crop, stored = self.tasks.settings.crop, self.prepared.stored
        if (
            not isinstance(crop, str)
            or not crop.strip().lower().startswith("quantile")
            or len(stored.even) == stored.count
        ):
            return []
        text = f"the sphere of --crop {crop} is that of {len(stored.even):,} of {stored.count:,} points, evenly chosen"
        return [Notice(SAMPLED_REGION, f"{text}; a comparison in memory uses all")]

    def describe_tiling(self) -> Tiling:
        """Describe how the comparison was computed, after its candidates were compared."""
        is_complete = self.prepared.complete is not None
        return Tiling(
            self.tasks.tile_points,
            sum(len(tile_ranges(cloud.runs, self.tasks.tile_points)) for cloud in self.stored.values()),
            None if is_complete else max(sample.points for sample in self.samples),
            self.tasks.tiling.max_distance,
            tuple(file for cloud in self.stored.values() for file in cloud.left_out),
        )


@dataclass(frozen=True, eq=False)
class PairInTiles:
    """A candidate aligned with the reference; see `pcbench.comparison.pipeline.AlignedPair`.

    Attributes:
        reference: the reference.
        name: name of the candidate.
        stage: name of its stages and folders.
        cloud: its points as sorted runs.
        sample: its registration, from samples.
    """

    reference: ReferenceInTiles
    name: str
    stage: str
    cloud: StoredCloud
    sample: SampleResults

    @property
    def tasks(self) -> Steps:
        """Settings, workers and files of all steps."""
        return self.reference.tasks

    @property
    def prepared(self) -> TiledReference:
        """The reference with all that its candidates share."""
        return self.reference.prepared

    @property
    def registration(self) -> Registration:
        """Registration of the candidate."""
        return self.sample.registration

    @property
    def points(self) -> int:
        """Number of points of the candidate."""
        return self.cloud.count

    @property
    def points_in_region(self) -> int:
        """Number of aligned points inside the region."""
        return sum(tile.inside for tile in self.tile_summaries)

    @property
    def faces(self) -> int | None:
        """Meshes are not compared in tiles."""
        return None

    @property
    def steps(self) -> tuple[float, ...]:
        """Steps in which the candidate's own x, y and z are rounded."""
        return tuple(self.cloud.quantisation.steps.tolist())

    @property
    def crs(self) -> str | None:
        """Coordinate system of the candidate, if known."""
        return self.cloud.source.crs

    @property
    def sampling_notices(self) -> Sequence[Notice]:
        """A notice if the candidate is a model of splats."""
        return [means_notice(self.points)] if self.cloud.source.has_splats else []

    @cached_property
    def tile_summaries(self) -> list[TileSummary]:
        """Contents of the tiles of the aligned candidate."""
        pose, origin, region = self.registration.T_local, self.prepared.origin, self.prepared.region
        return self.tasks.make_tiles(self.stage, self.cloud, origin, pose, region)

    @cached_property
    def tiles(self) -> TiledCloud:
        """The aligned candidate in tiles."""
        return TiledCloud.of(self.tasks.folder / self.stage / "tiles", self.tile_summaries)

    def match(self) -> None:
        """Cut the aligned candidate into tiles, in which closest points are searched.

        Raises:
            InputError: no aligned point lies in the region.
        """
        self.tasks.check_inside(self.points_in_region, self.cloud, f"{self.name}'s")

    @cached_property
    def sides(self) -> tuple[AlignedCloud, AlignedCloud]:
        """The reference and the aligned candidate, whose points are read as they are needed."""
        candidate = AlignedCloud(
            self.cloud,
            self.tiles,
            self.prepared.origin,
            self.registration.T_local,
            self.prepared.region,
            self.tasks.runner,
            self.stage,
            f"{self.tasks.key}{self.stage}",
            self.tasks.folder / f"{self.stage}.tiles",
        )
        return self.prepared.aligned(self.tasks, self.stage), candidate

    @cached_property
    def separated_changes(self) -> SeparatedChanges:
        """Changes between the complete clouds, with the labels of sampled points, in local coordinates."""
        self.tasks.report(f"{self.name}: searching for changes")
        return find_changes(*self.sides)

    @property
    def changes(self) -> Changes:
        """Changes between the complete clouds, in the reference's coordinates."""
        sampled = self.separated_changes.sampled
        return Changes(sampled.found, *sampled.labels, sampled.left_out).shifted(self.prepared.origin)

    @cached_property
    def pair(self) -> TiledPair:
        """Both clouds, with all that the tasks of the candidate have in common."""
        prepared, stored, origin = self.prepared, self.prepared.stored, self.prepared.origin
        pixels = None
        if self.reference.maps is not None:
            corners = stored.low - origin, stored.high - origin
            pixels = PixelGrid.covering(stored.even - origin, *corners, prepared.spacing)
        return TiledPair(
            reference=prepared.tiles,
            candidate=self.tiles,
            forth=self.tasks.folder / self.stage / "forth",
            back=self.tasks.folder / self.stage / "back",
            grid=prepared.grid,
            voxel=prepared.voxel,
            corner=prepared.corner,
            thresholds=prepared.thresholds,
            max_distance=self.tasks.tiling.max_distance or np.inf,
            overlap_distance=self.registration.overlap_distance,
            pixels=pixels,
            frame=FitFrame.of(prepared.tiles.corners),
            labels=(PointLabels.of(self.separated_changes, 1), PointLabels.of(self.separated_changes, 0)),
        )

    @cached_property
    def directions(self) -> tuple[MeasuredDirection, MeasuredDirection]:
        """Distances c→r and r→c, in files, and their sums."""
        return measure_tiles(self.tasks, self.pair, self.stage, self.name, self.prepared.region)

    def measure_distances(self) -> None:
        """Measure the distances of both directions, tile by tile."""
        _ = self.directions

    @cached_property
    def spreads(self) -> tuple[dict[str, Spread], dict[str, Spread]]:
        """Summary statistics of the distances of both directions."""
        forth, back = self.directions
        return measure_spreads(self.tasks, forth), measure_spreads(self.tasks, back)

    @cached_property
    def floors(self) -> tuple[Floors, Floors]:
        """Sampling floors of both directions."""
        self.tasks.report(f"{self.name}: sampling floors")
        forth, _ = self.directions
        return measure_floors(*self.sides, forth.sums, self.prepared.spacing, self.tasks.settings.seed)

    def summaries(self) -> tuple[DirectionSummary, DirectionSummary]:
        """Return all that the metrics need to know about the distances c→r and r→c, with their sampling floors."""
        forth, back = (
            direction.sums.totals.summary(
                cells=self.prepared.grid.number, floors=floors, spreads=spreads, origin=self.prepared.origin
            )
            for direction, floors, spreads in zip(self.directions, self.floors, self.spreads, strict=True)
        )
        return forth, back

    def maps(self) -> tuple[DeviationMap, DeviationMap]:
        """Return samples of the deviation map and the completeness map; those of all points are written to files."""
        (forth, back), (of_forth, of_back), origin = self.directions, self.spreads, self.prepared.origin
        with_planes = forth.sums.totals.has_planes
        deviation = show_direction(self.tasks, forth, of_forth, origin, with_planes=with_planes)
        completeness = show_direction(self.tasks, back, of_back, origin, with_planes=False)
        if (folder := self.reference.maps) is not None:
            folder.mkdir(parents=True, exist_ok=True)
            for kind, direction in (("distance", forth), ("completeness", back)):
                write_direction(
                    self.tasks,
                    direction,
                    folder,
                    self.name,
                    kind,
                    origin=origin,
                    crs=self.reference.crs,
                    unit=self.prepared.stored.source.unit,
                )
        return deviation, completeness

    def presets(self, deviation: DeviationMap) -> Mapping[str, Preset]:
        """Return the metrics as other tools define them, as far as tiles support them."""
        return measure_presets(self.tasks, self.pair, self.directions, self.prepared.region, self.stage, self.name)

    def own_metrics(self) -> OwnResults:
        """Return no user-defined metrics, because they get complete clouds."""
        return OwnResults({}, ())

    def release_matches(self) -> None:
        """Release the rasters, which are written; matches are on disk."""
        self.__dict__["directions"] = tuple(replace(direction, overview=None) for direction in self.directions)

    def assess_deformation(self) -> Deformation:
        """Assess the deformation of the part that did not change."""
        self.tasks.report(f"{self.name}: assessing deformation")
        farthest = self.directions[0].sums.totals.farthest
        return assess_deformation(
            *self.sides,
            self.registration,
            np.inf if farthest is None else farthest.distance,
            self.tasks.settings.seed,
            self.separated_changes,
        )

    def split_into_budget(self, deformation: Deformation) -> DirectedBudget | None:
        """Return what D2 consists of; None if it is unknown."""
        return split_into_budget(self.pair, self.directions, self.floors, deformation, self.registration)

    @property
    def offset(self) -> SignedOffset | None:
        """Signed offset of the sample from the reference's surface; None without normals."""
        return self.sample.offset

    @property
    def censored(self) -> Mapping[str, float]:
        """Share of the points of each direction beyond the maximum distance; empty if there is no maximum."""
        if self.tasks.tiling.max_distance is None:
            return {}
        forth, back = self.directions
        return {
            CANDIDATE_TO_REFERENCE: forth.sums.totals.censored / self.points_in_region,
            REFERENCE_TO_CANDIDATE: back.sums.totals.censored / self.prepared.inside,
        }

    def warnings(self, deviation: DeviationMap) -> Sequence[Notice]:
        """Return a warning if all points fit worse than the sample, and those of reading the candidate."""
        near = NearFit.of_sums(self.directions[0].sums.near, self.points_in_region)
        doubt = None if self.sample.near is None else self.sample.near.warning(near)
        return [*([] if doubt is None else [doubt]), *_reader_warnings(self.cloud)]


def _reader_warnings(cloud: StoredCloud) -> list[Notice]:
    """Return the warnings of reading a cloud's points, without those of its headers."""
    return [Notice("reader", text) for text in cloud.warnings[len(cloud.source.warnings) :]]
