"""Comparison of clouds on disk, tile by tile.

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

import itertools
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np

from pcbench.changes import Changes
from pcbench.deformation import SeparatedChanges
from pcbench.errors import Notice, PcbenchError
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.regions import Region
from pcbench.geometry.voxels import robust_extent
from pcbench.io.contents import FileState, cloud_contents, cloud_files
from pcbench.io.map_tiles import map_tile_extension, write_overview, write_tile_index
from pcbench.io.pieces import CloudOnDisk
from pcbench.measure.budget import FitFrame, consistent_with
from pcbench.measure.comparison import crs_warnings, differences, record_time
from pcbench.measure.deviation import DeviationMap, Spread
from pcbench.measure.intervals import CorrelationCells, CorrelationGrid
from pcbench.measure.presets import Preset
from pcbench.measure.results import (
    CANDIDATE_TO_REFERENCE,
    REFERENCE_TO_CANDIDATE,
    Candidate,
    CandidateComparisons,
    ReferenceSummary,
    Tiling,
)
from pcbench.measure.scores import Measurement, measure
from pcbench.measure.settings import Settings
from pcbench.measure.tiled import windows
from pcbench.measure.tiled.alignment import NearFit, known_pose, register_on_disk
from pcbench.measure.tiled.assessment import (
    AlignedCloud,
    assess_deformation,
    find_changes,
    measure_floors,
    split_into_budget,
)
from pcbench.measure.tiled.directions import (
    DISTANCE,
    PLANE_DISTANCE,
    DistanceSums,
    MeasuredDirection,
    TiledPair,
    measure_candidate_tile,
    measure_reference_tile,
)
from pcbench.measure.tiled.inputs import inputs_key, open_input
from pcbench.measure.tiled.labels import PointLabels
from pcbench.measure.tiled.lattice import Lattice
from pcbench.measure.tiled.maps import LARGEST_SHARE, MAP_SAMPLE, deviation_map, sample_map, write_tile_of_map
from pcbench.measure.tiled.overview import PixelGrid
from pcbench.measure.tiled.prepared import TiledReference, prepare_reference
from pcbench.measure.tiled.presets import crop_tile, presets_of
from pcbench.measure.tiled.settings import TILED_PRESETS, TilingSettings
from pcbench.measure.tiled.spreads import Distribution, spread_of
from pcbench.measure.tiled.steps import REFERENCE, Steps, tile_tasks
from pcbench.measure.tiled.stored import StoredCloud, lattice_around, rough_boxes, store_cloud
from pcbench.measure.tiled.tiles import TiledCloud, TileSummary
from pcbench.registration import Registration
from pcbench.systems import peak_memory
from pcbench.tasks import TaskRunner, Workers
from pcbench.tasks.results import write_result

T = TypeVar("T")


def compare_on_disk(
    reference: Path,
    candidates: Mapping[str, Path],
    settings: Settings,
    tiling: TilingSettings,
    *,
    workspace: Path,
    contents: Mapping[Path, FileState] | None = None,
    maps: Path | None = None,
    on_step: Callable[[str], None] | None = None,
) -> CandidateComparisons:
    """Compare candidates with a reference tile by tile; metrics equal those of `pcbench.compare` in memory.

    Args:
        reference: file, folder of tiles, pattern, .vpc index or EPT folder of the reference.
        candidates: the same for each candidate, by name.
        settings: settings of the comparison. Maps, the presets mpeg and tnt, and a tolerance are not computed in tiles.
        tiling: settings of the tiles, of memory and of workers.
        workspace: folder for intermediate files, which exists. The same call continues from finished tiles in it.
        contents: state of each file of the clouds; None: they are read for it.
        maps: folder for the maps of all points, which is created; None: no maps are written.
        on_step: progress callback, called with a short description of each step.

    Raises:
        InputError: a file or a setting is not usable, or a file is damaged and such files are not left out.
        RegistrationError: a candidate does not overlap the reference.
        WorkerError: a tile needs too much memory, or the cluster is lost.
        PcbenchError: a file changed while it was read.
    """
    report = on_step or (lambda _: None)
    paths = {REFERENCE: reference}
    paths |= {f"candidate-{number}": path for number, path in enumerate(candidates.values(), 1)}
    pieces = tiling.chosen_piece_points
    clouds = {name: open_input(path, settings, pieces, skip_bad=tiling.skip_bad) for name, path in paths.items()}
    tile_points = tiling.chosen_tile_points
    if contents is None:
        contents = cloud_contents(cloud.path for cloud in clouds.values())
    key = inputs_key(clouds, contents, settings, replace(tiling, tile_points=tile_points), maps)
    workers = Workers(tiling.chosen_workers, tiling.cluster)
    folder = workspace.absolute() / key[:16]
    with TaskRunner(workers, folder / "results", report) as runner:
        run = _Run(runner, folder, key, settings, tiling, tile_points, report, contents, maps)
        return run.compare(clouds, list(candidates))


class _ComparedCandidate(NamedTuple):
    """A candidate with the results of its comparison, the reference's sample in short, and the number of its tiles."""

    candidate: Candidate
    measurement: Measurement
    sample: ReferenceSummary
    tiles: int


@dataclass(frozen=True, eq=False)
class _Run(Steps):
    """The steps of one comparison.

    Attributes:
        contents: state of each file of the clouds.
        maps: folder for the maps of all points; None: none are written.
    """

    contents: Mapping[Path, FileState]
    maps: Path | None

    def compare(self, clouds: Mapping[str, CloudOnDisk], names: Sequence[str]) -> CandidateComparisons:
        """Compare the candidates, which have these names, with the reference; it is the first of the clouds."""
        pose = known_pose(self.settings)
        boxes = rough_boxes(clouds, self.runner, self.key)
        poses = dict.fromkeys(boxes, pose) | {REFERENCE: None}
        lattice = lattice_around(boxes, poses)
        stored = {name: self._store(name, cloud, replace(lattice, pose=poses[name])) for name, cloud in clouds.items()}
        are_small = all(cloud.count <= windows.MAX_SAMPLE for cloud in stored.values())
        timings: dict[str, float] = {}
        with record_time(timings, "reference"):
            reference = prepare_reference(self, stored[REFERENCE], are_small=are_small)
        compared = [
            self._compare_one(reference, stage, name, cloud)
            for name, (stage, cloud) in zip(names, itertools.islice(stored.items(), 1, None), strict=True)
        ]
        candidates = [
            replace(found.candidate, timings_s={**found.candidate.timings_s, **timings}) for found in compared
        ]
        apart = differences(_cells(reference.grid), candidates, [found.measurement for found in compared])
        tiling = Tiling(
            self.tile_points,
            len(reference.tiles) + sum(found.tiles for found in compared),
            None if reference.complete is not None else max(found.sample.points for found in compared),
            self.tiling.max_distance,
            tuple(file for cloud in stored.values() for file in cloud.left_out),
        )
        summary = self._summary(reference, compared[0].sample)
        return CandidateComparisons(self.settings, summary, tuple(candidates), tuple(apart), tiling)

    def _store(self, name: str, cloud: CloudOnDisk, lattice: Lattice) -> StoredCloud:
        folder, skip_bad = self.folder / name / "runs", self.tiling.skip_bad
        stored = store_cloud(name, cloud, lattice, folder, self.runner, self.key, self.contents, skip_bad=skip_bad)
        try:
            for file in cloud_files(cloud.path):  # also those that pieces do not name, such as nodes of EPT
                if file in self.contents:
                    self.contents[file].check()
        except PcbenchError:
            shutil.rmtree(self.folder)  # nobody knows which pieces have the recorded content
            raise
        return stored

    def _compare_one(self, reference: TiledReference, stage: str, name: str, cloud: StoredCloud) -> _ComparedCandidate:
        """Register and measure a candidate."""
        timings: dict[str, float] = {}
        with record_time(timings, "registration"):
            sample = register_on_disk(self, reference, stage, name, cloud)
        with record_time(timings, "matching"):
            pose, origin, region = sample.registration.T_local, reference.origin, reference.region
            summaries = self.make_tiles(stage, cloud, origin, pose, region)
            inside = sum(summary.inside for summary in summaries)
            self.check_inside(inside, cloud, f"{name}'s")
            tiles = TiledCloud.of(self.folder / stage / "tiles", summaries)
        known, file = reference.aligned(self, stage), self.folder / f"{stage}.tiles"
        aligned = AlignedCloud(cloud, tiles, origin, pose, region, self.runner, stage, f"{self.key}{stage}", file)
        with record_time(timings, "changes"):
            self.report(f"{name}: searching for changes")
            changes = find_changes(known, aligned)
        with record_time(timings, "distances"):
            pair = self._pair(reference, stage, tiles, sample.registration, changes)
            directions = forth, back = self._measure_tiles(pair, stage, name, region)
        with record_time(timings, "metrics"):
            self.report(f"{name}: sampling floors")
            every_floor = measure_floors(known, aligned, forth.sums, reference.spacing, self.settings.seed)
            spreads = [self._spreads(direction) for direction in directions]
            to_reference, to_candidate = (
                found.sums.totals.summary(
                    cells=pair.grid.number, floors=floors, spreads=spread, origin=reference.origin
                )
                for found, floors, spread in zip(directions, every_floor, spreads, strict=True)
            )
            measurement = measure(to_reference, to_candidate, pair.thresholds, cells=_cells(pair.grid))
        with record_time(timings, "maps"):
            deviation = self._map(forth, spreads[0], reference.origin, with_planes=forth.sums.totals.has_planes)
            completeness = self._map(back, spreads[1], reference.origin, with_planes=False)
            if self.maps is not None:
                self.maps.mkdir(parents=True, exist_ok=True)
                self._write_map(self.maps, name, "distance", forth, reference, pair.pixels)
                self._write_map(self.maps, name, "completeness", back, reference, pair.pixels)
        with record_time(timings, "deformation"):
            self.report(f"{name}: assessing deformation")
            largest = forth.sums.totals.farthest
            deformation = assess_deformation(
                known,
                aligned,
                sample.registration,
                np.inf if largest is None else largest.distance,
                self.settings.seed,
                changes,
            )
        with record_time(timings, "budget"):
            split = split_into_budget(pair, directions, every_floor, deformation, sample.registration)
            if split is not None:
                deformation = consistent_with(split.accuracy, deformation)
        with record_time(timings, "presets"):
            quoted = self._presets(reference, pair, stage, name, directions)
        near = NearFit.of_sums(forth.sums.near, inside)
        warnings = [
            *crs_warnings(reference.stored.source.crs, cloud.source.crs),
            *measurement.warnings,
            *filter(None, [None if sample.near is None else sample.near.warning(near)]),
            *(Notice("reader", text) for text in cloud.warnings[len(cloud.source.warnings) :]),
        ]
        censored = {
            CANDIDATE_TO_REFERENCE: forth.sums.totals.censored / inside,
            REFERENCE_TO_CANDIDATE: back.sums.totals.censored / reference.inside,
        }
        candidate = Candidate(
            name=name,
            points=cloud.count,
            points_in_region=inside,
            registration=sample.registration,
            metrics=replace(measurement.metrics, presets=quoted),
            deviation=deviation,
            completeness=completeness,
            deformation=deformation,
            timings_s=timings,
            peak_rss_bytes=peak_memory(),
            steps=tuple(cloud.quantisation.steps.tolist()),
            warnings=tuple(warnings),
            budget=split,
            changes=Changes(changes.sampled.found, *changes.sampled.labels).shifted(origin),
            offset=sample.offset,
            censored={} if self.tiling.max_distance is None else censored,
        )
        return _ComparedCandidate(candidate, measurement, sample.reference, len(summaries))

    def _pair(
        self,
        reference: TiledReference,
        stage: str,
        candidate: TiledCloud,
        registration: Registration,
        changes: SeparatedChanges,
    ) -> TiledPair:
        stored, origin, pixels = reference.stored, reference.origin, None
        if self.maps is not None:
            corners = stored.low - origin, stored.high - origin
            pixels = PixelGrid.covering(stored.even - origin, *corners, reference.spacing)
        return TiledPair(
            reference=reference.tiles,
            candidate=candidate,
            forth=self.folder / stage / "forth",
            back=self.folder / stage / "back",
            grid=reference.grid,
            voxel=reference.voxel,
            corner=reference.corner,
            thresholds=reference.thresholds,
            max_distance=self.tiling.max_distance or np.inf,
            overlap_distance=registration.overlap_distance,
            pixels=pixels,
            frame=FitFrame.of(reference.tiles.corners),
            labels=(PointLabels.of(changes, 1), PointLabels.of(changes, 0)),
        )

    def _measure_tiles(
        self, pair: TiledPair, stage: str, name: str, region: Region | None
    ) -> tuple[MeasuredDirection, MeasuredDirection]:
        """Measure both directions, c→r and r→c, tile by tile, inside a region."""
        file, key = self.folder / f"{stage}.pair", f"{self.key}{stage}"
        write_result(file, key, pair)

        def measured(
            way: str, function: Callable[..., DistanceSums], queries: TiledCloud, folder: Path, title: str
        ) -> MeasuredDirection:
            folder.mkdir(parents=True, exist_ok=True)
            tasks = tile_tasks(queries, lambda number: (file, key, number, region))
            found = self.results(f"{stage}-{way}", function, tasks, title)
            return MeasuredDirection(f"{stage}-{way}", queries, folder, DistanceSums.merge(found))

        return (
            measured("forth", measure_candidate_tile, pair.candidate, pair.forth, f"{name}: measuring c→r"),
            measured("back", measure_reference_tile, pair.reference, pair.back, f"{name}: measuring r→c"),
        )

    def _presets(
        self,
        reference: TiledReference,
        pair: TiledPair,
        stage: str,
        name: str,
        directions: tuple[MeasuredDirection, MeasuredDirection],
    ) -> dict[str, Preset]:
        """Return the presets, measured again between clouds cut at the region if there is one."""
        names = [preset for preset in self.settings.presets if preset in TILED_PRESETS]
        if reference.region is not None and names:
            cropped = replace(
                pair,
                reference=self._crop(REFERENCE, pair.reference, reference.region),
                candidate=self._crop(stage, pair.candidate, reference.region),
                forth=pair.forth / "cropped",
                back=pair.back / "cropped",
                pixels=None,
                frame=None,
            )
            directions = self._measure_tiles(cropped, f"{stage}-cropped", f"{name}, presets", None)
        forth, back = (direction.sums.totals for direction in directions)
        return dict(presets_of(forth, back, pair.thresholds, names))

    def _crop(self, stage: str, tiles: TiledCloud, region: Region) -> TiledCloud:
        """Cut tiles at the region."""
        folder = self.folder / stage / "cropped"
        folder.mkdir(parents=True, exist_ok=True)
        tasks = tile_tasks(tiles, lambda number: (tiles.folder, number, region, folder))
        summaries = self.results(f"{stage}-crop", crop_tile, tasks, "cutting at the region")
        found = {tile.number: tile for tile in summaries}
        every = (found.get(number) or TileSummary.empty(number) for number in range(len(tiles)))
        return replace(TiledCloud.of(folder, every), normals=tiles.normals)

    def _spreads(self, direction: MeasuredDirection) -> dict[str, Spread]:
        """Return the summary statistics of the distances to points and to planes, by the names of their columns."""
        totals = direction.sums.totals

        def spread(name: str, found: Distribution) -> Spread:
            return spread_of(direction.files(name), found, map_files=self.file_map(f"{direction.stage}-{name}"))

        spreads = {DISTANCE: spread(DISTANCE, totals.distances)}
        if totals.censored:  # these are not even bounds
            spreads[DISTANCE] = replace(spreads[DISTANCE], std=None, nmad=None)
        if totals.plane_distances is not None:
            has_planes = totals.has_planes  # False: distances of points beyond the maximum distance are unknown
            spreads[PLANE_DISTANCE] = spread(PLANE_DISTANCE, totals.plane_distances) if has_planes else Spread()
        return spreads

    def _map(
        self, direction: MeasuredDirection, spreads: Mapping[str, Spread], origin: FloatArray, *, with_planes: bool
    ) -> DeviationMap:
        """Return a map of sampled points, for pages and pictures."""
        distances, tiles = direction.sums.totals.distances, direction.queries
        count = distances.count
        step = -(-count // MAP_SAMPLE)
        share_shown = min(LARGEST_SHARE, MAP_SAMPLE / count)
        least = distances.histogram.approximate_percentile(100 * (1 - share_shown)) if step > 1 else 0.0
        tasks = tile_tasks(tiles, lambda number: (tiles.folder, direction.folder, number, step, least))
        parts = self.results(f"{direction.stage}-map", sample_map, tasks, "sampling the map")
        return deviation_map(parts, count, step, spreads, origin, with_planes=with_planes)

    def _write_map(
        self,
        maps: Path,
        name: str,
        kind: str,
        direction: MeasuredDirection,
        reference: TiledReference,
        pixels: PixelGrid | None,
    ) -> None:
        """Write a map of all points, its index and its overview; see `write_overview` for its name and kind."""
        folder, tiles, crs = maps / f"{name}_{kind}", direction.queries, reference.stored.source.crs
        folder.mkdir(exist_ok=True)

        def arguments(number: int) -> tuple[Any, ...]:
            path = folder / f"tile_{number:04d}{map_tile_extension()}"
            return tiles.folder, direction.folder, number, reference.origin, crs, path

        tasks = tile_tasks(tiles, arguments)
        self.results(f"{direction.stage}-files", write_tile_of_map, tasks, f"{name}: writing maps")
        write_tile_index(folder, crs)
        if pixels is not None and direction.sums.pixels is not None:
            overview = direction.sums.pixels.overview(pixels, reference.origin)
            write_overview(maps, name, overview, kind=kind, crs=crs)

    def _summary(self, reference: TiledReference, sample: ReferenceSummary) -> ReferenceSummary:
        source = reference.stored.source
        return ReferenceSummary(
            points=reference.stored.count,
            points_in_region=reference.inside,
            spacing_median=reference.spacing,
            extent=robust_extent(reference.stored.even - reference.origin),
            crs=source.crs,
            unit=source.unit,
            steps=tuple(reference.stored.quantisation.steps.tolist()),
            normals=sample.normals,
            faces=None,
            block_side=reference.grid.side,
            voxel_side=reference.voxel,
            warnings=(
                *sample.warnings,
                *(Notice("reader", text) for text in reference.stored.warnings[len(source.warnings) :]),
            ),
        )


def _cells(grid: CorrelationGrid) -> CorrelationCells:
    return CorrelationCells(np.zeros(0, np.int64), grid.shape, grid.side)
