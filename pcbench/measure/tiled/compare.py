"""Comparison of clouds on disk, tile by tile.

1. Every piece of every cloud is read once and stored as a run along a Morton curve; the reference is cut into tiles.
2. The normals of the reference and its spacing are computed tile by tile.
3. Registration, sampling floors and the test for deformation use samples at full density.
4. The aligned candidate is cut into tiles, and the distances in both directions are measured tile by tile.
5. Exact counts and sums are merged into the same metrics as in memory.

No number depends on the tiles, the workers or the order in which they finish. Each step keeps its results in the
workspace.
"""

from __future__ import annotations

import itertools
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np

from pcbench.errors import InputError, Notice, PcbenchError
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.region_text import as_region
from pcbench.geometry.regions import Box, Region
from pcbench.geometry.sampling import sampling_of_profile
from pcbench.geometry.voxels import robust_bounds, robust_extent
from pcbench.io.contents import FileState, cloud_contents, cloud_files
from pcbench.io.map_tiles import map_tile_extension, write_overview, write_tile_index
from pcbench.io.pieces import CloudOnDisk
from pcbench.measure.comparison import crs_warnings, default_thresholds, differences, record_time
from pcbench.measure.deviation import DeviationMap, Spread
from pcbench.measure.intervals import CorrelationCells, CorrelationGrid
from pcbench.measure.presets import Preset
from pcbench.measure.reference import VOXELS_ALONG, Reference
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
from pcbench.measure.tiled.alignment import (
    NearFit,
    SampleResults,
    assess_samples,
    find_pose,
    known_pose,
    refine_settings,
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
from pcbench.measure.tiled.even import even_points
from pcbench.measure.tiled.inputs import inputs_key, open_input
from pcbench.measure.tiled.lattice import Lattice
from pcbench.measure.tiled.maps import LARGEST_SHARE, MAP_SAMPLE, deviation_map, sample_map, write_tile_of_map
from pcbench.measure.tiled.normals import add_normals, add_wide_normals
from pcbench.measure.tiled.overview import PixelGrid
from pcbench.measure.tiled.presets import crop_tile, presets_of
from pcbench.measure.tiled.ranks import BitHistogram, FileMap, median
from pcbench.measure.tiled.runs import tile_ranges
from pcbench.measure.tiled.settings import TILED_PRESETS, TilingSettings
from pcbench.measure.tiled.spreads import Distribution, spread_of
from pcbench.measure.tiled.stored import StoredCloud, lattice_around, rough_boxes, store_cloud
from pcbench.measure.tiled.tiles import WIDE_NORMALS, TiledCloud, TileSummary, make_tile
from pcbench.registration import Registration, local_origin_of_box
from pcbench.systems import peak_memory
from pcbench.tasks import Task, TaskRunner, Workers
from pcbench.tasks.codec import fingerprint
from pcbench.tasks.results import write_result

T = TypeVar("T")

_REFERENCE = "reference"


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
    paths = {_REFERENCE: reference}
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
        run = _Run(runner, folder, key, contents, settings, tiling, tile_points, maps, report)
        return run.compare(clouds, list(candidates))


@dataclass(frozen=True, eq=False)
class _TiledReference:
    """The reference in tiles, with all that its candidates share.

    Attributes:
        stored: the reference as sorted runs.
        tiles: its tiles, with normals.
        origin: (3,) local origin, which is subtracted from all coordinates.
        region: measured region in local coordinates; None: everything.
        inside: number of its points inside the region.
        spacing: median point spacing.
        thresholds: distance thresholds of the F-score.
        grid: correlation cells of the intervals.
        voxel, corner: side and origin (3,) of the voxels of area weighting.
        complete: the reference in memory if all clouds are small: no samples are needed. None otherwise.
    """

    stored: StoredCloud
    tiles: TiledCloud
    origin: FloatArray
    region: Region | None
    inside: int
    spacing: float
    thresholds: tuple[float, ...]
    grid: CorrelationGrid
    voxel: float
    corner: FloatArray
    complete: Reference | None


class _ComparedCandidate(NamedTuple):
    """A candidate with the results of its comparison, the reference's sample in short, and the number of its tiles."""

    candidate: Candidate
    measurement: Measurement
    sample: ReferenceSummary
    tiles: int


@dataclass(frozen=True, eq=False)
class _Run:
    """The steps of one comparison.

    Attributes:
        runner: runs the tasks of all steps.
        folder: folder of intermediate files, with one folder per cloud.
        key: identifies the inputs and settings; stored results of another key are not used.
        contents: state of each file of the clouds.
        settings: settings of the comparison.
        tiling: settings of the tiles.
        tile_points: largest number of points of a tile.
        maps: folder for the maps of all points; None: none are written.
        report: progress callback.
    """

    runner: TaskRunner
    folder: Path
    key: str
    contents: Mapping[Path, FileState]
    settings: Settings
    tiling: TilingSettings
    tile_points: int
    maps: Path | None
    report: Callable[[str], None]

    def compare(self, clouds: Mapping[str, CloudOnDisk], names: Sequence[str]) -> CandidateComparisons:
        """Compare the candidates, which have these names, with the reference; it is the first of the clouds."""
        pose = known_pose(self.settings)
        boxes = rough_boxes(clouds, self.runner, self.key)
        poses = dict.fromkeys(boxes, pose) | {_REFERENCE: None}
        lattice = lattice_around(boxes, poses)
        stored = {name: self._store(name, cloud, replace(lattice, pose=poses[name])) for name, cloud in clouds.items()}
        are_small = all(cloud.count <= windows.MAX_SAMPLE for cloud in stored.values())
        timings: dict[str, float] = {}
        with record_time(timings, "reference"):
            reference = self._prepare(stored[_REFERENCE], are_small=are_small)
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

    def _prepare(self, cloud: StoredCloud, *, are_small: bool) -> _TiledReference:
        """Cut the reference into tiles, compute its normals and its spacing, and prepare its sample."""
        if cloud.count < 3:
            raise InputError(
                f"{cloud.source.path}: expected at least 3 points in the reference, got {cloud.count}: omit --tiles"
            )
        origin = local_origin_of_box(cloud.low, cloud.high, cloud.even)
        crop = self.settings.crop
        if isinstance(crop, str) and crop.strip().lower() == "reference":
            crop = Box(cloud.low, cloud.high)
        given = as_region(crop, cloud.thinned)
        region = None if given is None else given.shifted(origin)
        summaries = self._make_tiles(_REFERENCE, cloud, origin, None, region)
        tiles = TiledCloud.of(self.folder / _REFERENCE / "tiles", summaries)
        inside = sum(summary.inside for summary in summaries)
        self._check_inside(inside, cloud, "the reference's")
        local = cloud.even - origin
        measured = local if region is None else local[region.contains(local)]
        if region is not None and len(local) < cloud.count:
            measured = even_points(cloud.runs, origin, region, self.runner, f"{_REFERENCE}-inside", self.key)
        spacing, tiles = self._add_normals(tiles)
        return _TiledReference(
            stored=cloud,
            tiles=tiles,
            origin=origin,
            region=region,
            inside=inside,
            spacing=spacing,
            thresholds=self._thresholds(spacing),
            grid=CorrelationGrid.covering(*robust_bounds(local)),
            voxel=robust_extent(measured) / VOXELS_ALONG or 1.0,
            corner=np.min([summary.lowest_inside for summary in summaries], axis=0),
            complete=Reference.prepare(windows.complete_cloud(cloud), self.settings) if are_small else None,
        )

    def _make_tiles(
        self,
        name: str,
        cloud: StoredCloud,
        origin: FloatArray,
        registration: Registration | None,
        region: Region | None,
    ) -> list[TileSummary]:
        folder = self.folder / name / "tiles"
        folder.mkdir(parents=True, exist_ok=True)
        pose = None if registration is None else registration.T_local
        tasks = []
        for number, codes in enumerate(tile_ranges(cloud.runs, self.tile_points)):
            arguments = (cloud.runs.overlapping(codes), number, codes, origin, pose, region, folder)
            tasks.append(Task(f"{number:06d}", arguments, self.tile_points))
        return list(self._results(f"{name}-tiles", make_tile, tasks, f"cutting {cloud.source.path} into tiles"))

    def _thresholds(self, spacing: float) -> tuple[float, ...]:
        """Return the thresholds of the F-score; raises an InputError if distances up to them are not searched."""
        found, limit = self.settings.thresholds or default_thresholds(spacing), self.tiling.max_distance
        if limit is not None and found and max(found) > limit:
            raise InputError(
                f"expected a maximum distance of at least {max(found):.4g}, the largest threshold of the F-score, got"
                f" {limit:g}: use --max-distance {1.01 * max(found):.3g}, or smaller --thresholds"
            )
        return found

    def _add_normals(self, tiles: TiledCloud) -> tuple[float, TiledCloud]:
        """Compute the normals of all tiles, and return the spacing of the points, and the tiles with their normals."""
        count = int(tiles.counts.sum())
        file, k = self.folder / "reference.tiles", min(self.settings.normal_neighbors, count)
        write_result(file, self.key, tiles)
        tasks = _tile_tasks(tiles, lambda number: (file, self.key, number, k))
        found = self._results("normals", add_normals, tasks, "computing normals of the reference")
        histogram = BitHistogram.merge(found)
        files = [tiles.file(number, "spacings") for number in tiles.occupied]
        nearest = median(files, histogram, map_files=self._file_map("spacing")) if histogram.count else 0.0
        profile = np.concatenate([tiles.load(number, "profile") for number in tiles.occupied])
        sampling = sampling_of_profile(nearest, profile, count)
        wide = min(sampling.plane_neighbors(self.settings.normal_neighbors), count)
        if wide > k:
            tasks = _tile_tasks(tiles, lambda number: (file, self.key, number, wide))
            for _ in self._results("wide-normals", add_wide_normals, tasks, "computing normals between scan lines"):
                pass
            tiles = replace(tiles, normals=WIDE_NORMALS)
        return sampling.spacing, tiles

    def _compare_one(self, reference: _TiledReference, stage: str, name: str, cloud: StoredCloud) -> _ComparedCandidate:
        """Register and measure a candidate."""
        timings: dict[str, float] = {}
        with record_time(timings, "registration"):
            sample = self._register(reference, stage, name, cloud)
        with record_time(timings, "matching"):
            summaries = self._make_tiles(stage, cloud, reference.origin, sample.registration, reference.region)
            inside = sum(summary.inside for summary in summaries)
            self._check_inside(inside, cloud, f"{name}'s")
            pair = self._pair(
                reference, stage, TiledCloud.of(self.folder / stage / "tiles", summaries), sample.registration
            )
            directions = forth, back = self._measure_tiles(pair, stage, name, reference.region)
        with record_time(timings, "metrics"):
            spreads = [self._spreads(direction) for direction in directions]
            to_reference, to_candidate = (
                found.sums.totals.summary(
                    cells=pair.grid.number, floors=floors, spreads=spread, origin=reference.origin
                )
                for found, floors, spread in zip(directions, sample.floors, spreads, strict=True)
            )
            measurement = measure(to_reference, to_candidate, pair.thresholds, cells=_cells(pair.grid))
        with record_time(timings, "maps"):
            deviation = self._map(forth, spreads[0], reference.origin, with_planes=forth.sums.totals.has_planes)
            completeness = self._map(back, spreads[1], reference.origin, with_planes=False)
            if self.maps is not None:
                self.maps.mkdir(parents=True, exist_ok=True)
                self._write_map(self.maps, name, "distance", forth, reference, pair.pixels)
                self._write_map(self.maps, name, "completeness", back, reference, pair.pixels)
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
            deformation=sample.deformation,
            timings_s=timings,
            peak_rss_bytes=peak_memory(),
            steps=tuple(cloud.thinned.quantisation.steps.tolist()),
            warnings=tuple(warnings),
            offset=sample.offset,
            censored={} if self.tiling.max_distance is None else censored,
        )
        return _ComparedCandidate(candidate, measurement, sample.reference, len(summaries))

    def _register(self, reference: _TiledReference, stage: str, name: str, cloud: StoredCloud) -> SampleResults:
        """Register a candidate: small clouds as they are, larger ones thinned, then in windows at full density."""
        if reference.complete is not None:
            self.report(f"{name}: registering")
            complete = windows.complete_cloud(cloud)
            return assess_samples(reference.complete, complete, name, self.settings, reference.origin, is_complete=True)
        self.report(f"{name}: registering thinned clouds")
        stored, thinned = reference.stored, cloud.thinned
        pose = find_pose(stored.thinned, thinned, name, self.settings)
        places = pose.apply(cloud.even)
        region = None if reference.region is None else reference.region.shifted(-reference.origin)
        if region is not None and (inside := region.contains(places)).any():
            places = places[inside]
        chosen = windows.Windows.of(stored, places, cloud.count)
        step = windows.thinning_step(cloud, chosen, pose)
        sample = windows.candidate_in_windows(cloud, chosen, pose, step, self.runner, f"{stage}-sample", self.key)
        self.report(f"{name}: registering")
        settings = replace(refine_settings(self.settings, pose), crop="none")
        if sample is None:  # the candidate has few points, or does not overlap the reference
            prepared = Reference.prepare(stored.thinned, settings)
            found = assess_samples(prepared, thinned, name, settings, reference.origin, is_complete=False)
            forth, back = found.floors
            return replace(found, floors=(dict.fromkeys(forth), dict.fromkeys(back)))
        sampled, aligned = windows.reference_in_windows(stored, chosen), pose.apply(sample.points)
        # The region may be smaller than a window, and few windows may have no points in their inner parts.
        measured = len(sample)
        for limit in (None, region):
            inner = windows.WindowRegion(chosen, limit, np.zeros(3))
            number = int(np.count_nonzero(inner.contains(aligned)))
            if inner.contains(sampled.points).any() and number:
                settings, measured = replace(settings, crop=inner), number
        prepared = Reference.prepare(sampled, settings)
        found = assess_samples(prepared, sample, name, settings, reference.origin, is_complete=False)
        forth, back = found.floors
        if measured < windows.MIN_CANDIDATE_POINTS:  # a mean of so few distances says nothing
            forth = dict.fromkeys(forth)
        if step > 1 or len(sample) < windows.MIN_CANDIDATE_POINTS * len(chosen.ranges):
            # The floors r→c are those of the candidate's density, which the sample does not have.
            back = dict.fromkeys(back)
        return replace(found, floors=(forth, back))

    def _pair(
        self, reference: _TiledReference, stage: str, candidate: TiledCloud, registration: Registration
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
            tasks = _tile_tasks(queries, lambda number: (file, key, number, region))
            found = self._results(f"{stage}-{way}", function, tasks, title)
            return MeasuredDirection(f"{stage}-{way}", queries, folder, DistanceSums.merge(found))

        return (
            measured("forth", measure_candidate_tile, pair.candidate, pair.forth, f"{name}: measuring c→r"),
            measured("back", measure_reference_tile, pair.reference, pair.back, f"{name}: measuring r→c"),
        )

    def _presets(
        self,
        reference: _TiledReference,
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
                reference=self._crop(_REFERENCE, pair.reference, reference.region),
                candidate=self._crop(stage, pair.candidate, reference.region),
                forth=pair.forth / "cropped",
                back=pair.back / "cropped",
                pixels=None,
            )
            directions = self._measure_tiles(cropped, f"{stage}-cropped", f"{name}, presets", None)
        forth, back = (direction.sums.totals for direction in directions)
        return dict(presets_of(forth, back, pair.thresholds, names))

    def _crop(self, stage: str, tiles: TiledCloud, region: Region) -> TiledCloud:
        """Cut tiles at the region."""
        folder = self.folder / stage / "cropped"
        folder.mkdir(parents=True, exist_ok=True)
        tasks = _tile_tasks(tiles, lambda number: (tiles.folder, number, region, folder))
        summaries = self._results(f"{stage}-crop", crop_tile, tasks, "cutting at the region")
        found = {tile.number: tile for tile in summaries}
        every = (found.get(number) or TileSummary.empty(number) for number in range(len(tiles)))
        return replace(TiledCloud.of(folder, every), normals=tiles.normals)

    def _spreads(self, direction: MeasuredDirection) -> dict[str, Spread]:
        """Return the summary statistics of the distances to points and to planes, by the names of their columns."""
        totals = direction.sums.totals

        def spread(name: str, found: Distribution) -> Spread:
            return spread_of(direction.files(name), found, map_files=self._file_map(f"{direction.stage}-{name}"))

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
        tasks = _tile_tasks(tiles, lambda number: (tiles.folder, direction.folder, number, step, least))
        parts = self._results(f"{direction.stage}-map", sample_map, tasks, "sampling the map")
        return deviation_map(parts, count, step, spreads, origin, with_planes=with_planes)

    def _write_map(
        self,
        maps: Path,
        name: str,
        kind: str,
        direction: MeasuredDirection,
        reference: _TiledReference,
        pixels: PixelGrid | None,
    ) -> None:
        """Write a map of all points, its index and its overview; see `write_overview` for its name and kind."""
        folder, tiles, crs = maps / f"{name}_{kind}", direction.queries, reference.stored.source.crs
        folder.mkdir(exist_ok=True)

        def arguments(number: int) -> tuple[Any, ...]:
            path = folder / f"tile_{number:04d}{map_tile_extension()}"
            return tiles.folder, direction.folder, number, reference.origin, crs, path

        tasks = _tile_tasks(tiles, arguments)
        self._results(f"{direction.stage}-files", write_tile_of_map, tasks, f"{name}: writing maps")
        write_tile_index(folder, crs)
        if pixels is not None and direction.sums.pixels is not None:
            overview = direction.sums.pixels.overview(pixels, reference.origin)
            write_overview(maps, name, overview, kind=kind, crs=crs)

    def _summary(self, reference: _TiledReference, sample: ReferenceSummary) -> ReferenceSummary:
        source = reference.stored.source
        return ReferenceSummary(
            points=reference.stored.count,
            points_in_region=reference.inside,
            spacing_median=reference.spacing,
            extent=robust_extent(reference.stored.even - reference.origin),
            crs=source.crs,
            unit=source.unit,
            steps=tuple(reference.stored.thinned.quantisation.steps.tolist()),
            normals=sample.normals,
            faces=None,
            block_side=reference.grid.side,
            voxel_side=reference.voxel,
            warnings=(
                *sample.warnings,
                *(Notice("reader", text) for text in reference.stored.warnings[len(source.warnings) :]),
            ),
        )

    def _check_inside(self, inside: int, cloud: StoredCloud, owner: str) -> None:
        """Raise an InputError if no point of a cloud is inside the region."""
        if inside == 0:
            crop = self.settings.crop
            text = crop if isinstance(crop, str) else crop.text
            corners = zip("xyz", cloud.low, cloud.high, strict=True)
            extent = ", ".join(f"{axis} {low:,.6g} to {high:,.6g}" for axis, low, high in corners)
            raise InputError(
                f"the crop {text!r} leaves none of {owner} {cloud.count:,} points ({extent}): check its numbers, the"
                " coordinate system and the unit"
            )

    def _results(self, stage: str, function: Callable[..., T], tasks: Sequence[Task], title: str) -> Iterator[T]:
        """Run tasks, and return an iterator that loads their results one at a time."""
        results = self.runner.run(stage, function, tasks, key=self.key, title=title)
        return (found for _, found in results)

    def _file_map(self, stage: str) -> FileMap:
        """Return a function that distributes calls for many files as tasks, and repeats none of them."""
        passes = itertools.count()

        def map_files(function: Callable[[Path], T], files: Sequence[Path]) -> Iterable[T]:
            if len(files) == 1:
                return map(function, files)
            tasks = [Task(f"{number:06d}", (file,), file.stat().st_size / 8) for number, file in enumerate(files)]
            key = f"{self.key}{fingerprint(getattr(function, 'keywords', {}))}"  # of a `partial`
            results = self.runner.run(f"{stage}-{next(passes)}", function, tasks, key=key, title="percentiles")
            return (found for _, found in results)

        return map_files


def _tile_tasks(tiles: TiledCloud, arguments: Callable[[int], tuple[Any, ...]]) -> list[Task]:
    """Return a task for each tile with points; `arguments` returns those of the tile with a number."""
    return [Task(f"{number:06d}", arguments(number), int(tiles.counts[number])) for number in tiles.occupied]


def _cells(grid: CorrelationGrid) -> CorrelationCells:
    return CorrelationCells(np.zeros(0, np.int64), grid.shape, grid.side)
