"""The reference in tiles, with all that its candidates share: its normals, its spacing and its sampling."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pcbench.errors import InputError
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.region_text import as_region
from pcbench.geometry.regions import Box, Region
from pcbench.geometry.sampling import Sampling, sampling_of, sampling_of_profile
from pcbench.geometry.voxels import robust_bounds, robust_extent
from pcbench.measure.intervals import CorrelationGrid
from pcbench.measure.reference import VOXELS_ALONG, Reference
from pcbench.measure.tiled import windows
from pcbench.measure.tiled.assessment import AlignedCloud
from pcbench.measure.tiled.even import Picker, PlacedRuns, even_points
from pcbench.measure.tiled.nearby import TiledIndex
from pcbench.measure.tiled.normals import MIN_PLANE_POINTS, add_normals, add_wide_normals
from pcbench.measure.tiled.ranks import BitHistogram, median
from pcbench.measure.tiled.steps import REFERENCE, Steps, tile_tasks
from pcbench.measure.tiled.stored import StoredCloud
from pcbench.measure.tiled.tiles import WIDE_NORMALS, TiledCloud
from pcbench.registration import local_origin_of_box
from pcbench.tasks.results import write_result


@dataclass(frozen=True, eq=False)
class TiledReference:
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
        sampling: sampling of an even sample of its points, as of a surface in memory.
        complete: the reference in memory if all clouds are small: it is registered as it is. None otherwise.
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
    sampling: Sampling
    complete: Reference | None

    def aligned(self, steps: Steps, stage: str) -> AlignedCloud:
        """Return the reference for its assessment with a candidate, which has its own stages."""
        return AlignedCloud(
            self.stored,
            self.tiles,
            self.origin,
            None,
            self.region,
            steps.runner,
            f"{stage}-reference",
            steps.key,
            steps.folder / f"{stage}-reference.tiles",
            steps.settings.normal_neighbors,
            self.sampling,
        )


def prepare_reference(steps: Steps, cloud: StoredCloud, *, are_small: bool) -> TiledReference:
    """Cut the reference into tiles, compute its normals and its spacing, and prepare its sample."""
    origin = local_origin_of_box(cloud.low, cloud.high, cloud.even)
    crop = steps.settings.crop
    if isinstance(crop, str) and crop.strip().lower() == "reference":
        crop = Box(cloud.low, cloud.high)
    given = as_region(crop, cloud.thinned)
    region = None if given is None else given.shifted(origin)
    summaries = steps.make_tiles(REFERENCE, cloud, origin, None, region)
    tiles = TiledCloud.of(steps.folder / REFERENCE / "tiles", summaries)
    inside = sum(summary.inside for summary in summaries)
    steps.check_inside(inside, cloud, "the reference's")
    local = cloud.even - origin
    measured = local if region is None else local[region.contains(local)]
    if region is not None and len(local) < cloud.count:
        measured = even_points(
            Picker.of(PlacedRuns(cloud.runs, origin, None, region), steps.runner, f"{REFERENCE}-inside", steps.key)
        )
    spacing, tiles = _add_normals(steps, tiles)
    profile = np.concatenate([tiles.load(number, "profile") for number in tiles.occupied])
    index = TiledIndex(tiles, steps.folder / "sampling.tiles", steps.runner, f"{REFERENCE}-sampling", steps.key)
    return TiledReference(
        stored=cloud,
        tiles=tiles,
        origin=origin,
        region=region,
        inside=inside,
        spacing=spacing,
        thresholds=_thresholds(steps, spacing),
        grid=CorrelationGrid.covering(*robust_bounds(local)),
        voxel=robust_extent(measured) / VOXELS_ALONG or 1.0,
        corner=np.min([summary.lowest_inside for summary in summaries], axis=0),
        sampling=sampling_of(index, profile=profile),
        complete=Reference.prepare(windows.complete_cloud(cloud), steps.settings) if are_small else None,
    )


def _thresholds(steps: Steps, spacing: float) -> tuple[float, ...]:
    """Return the thresholds of the F-score; raises an InputError if distances up to them are not searched."""
    thresholds, limit = steps.settings.thresholds_for(spacing), steps.tiling.max_distance
    if limit is not None and thresholds and max(thresholds) > limit:
        raise InputError(
            f"expected a maximum distance of at least {max(thresholds):.4g}, the largest threshold of the F-score, got"
            f" {limit:g}: use --max-distance {1.01 * max(thresholds):.3g}, or smaller --thresholds"
        )
    return thresholds


def _add_normals(steps: Steps, tiles: TiledCloud) -> tuple[float, TiledCloud]:
    """Compute the normals of all tiles, and return the spacing of the points, and the tiles with their normals."""
    count = int(tiles.counts.sum())
    file, k = steps.folder / "reference.tiles", min(steps.settings.normal_neighbors, count)
    write_result(file, steps.key, tiles)
    tasks = tile_tasks(tiles, lambda number: (file, steps.key, number, k))
    histograms = steps.results("normals", add_normals, tasks, "computing normals of the reference")
    histogram = BitHistogram.merge(histograms)
    files = [tiles.file(number, "spacings") for number in tiles.occupied]
    nearest = median(files, histogram, map_files=steps.file_map("spacing")) if histogram.count else 0.0
    if count < MIN_PLANE_POINTS:
        return nearest, tiles
    profile = np.concatenate([tiles.load(number, "profile") for number in tiles.occupied])
    sampling = sampling_of_profile(nearest, profile, count)
    wide = min(sampling.plane_neighbors(steps.settings.normal_neighbors), count)
    if wide > k:
        tasks = tile_tasks(tiles, lambda number: (file, steps.key, number, wide))
        for _ in steps.results("wide-normals", add_wide_normals, tasks, "computing normals between scan lines"):
            pass
        tiles = replace(tiles, normals=WIDE_NORMALS)
    return sampling.spacing, tiles
