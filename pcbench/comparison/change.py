"""Measure the change between epochs from their files; for `pcbench change`."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import date
from pathlib import Path

import numpy as np

from pcbench.errors import InputError
from pcbench.geometry.polygon_files import read_polygon, read_zones
from pcbench.geometry.region_text import check_polygon_system
from pcbench.geometry.regions import Region, Union
from pcbench.io.las_records import parse_filters
from pcbench.io.pieces.reading import read_piece
from pcbench.io.source import Source
from pcbench.measure.dem.along_normals import STEEP_DEG, NormalVolume, volume_along_normals
from pcbench.measure.dem.covariance import ErrorModel, Mask
from pcbench.measure.dem.difference import DemOfDifference, difference_of
from pcbench.measure.dem.epochs import (
    Epoch,
    check_same_system,
    common_grid,
    date_of,
    epoch_surface,
    open_epoch,
)
from pcbench.measure.dem.grid import HeightGrid
from pcbench.measure.dem.profiles import profile_along
from pcbench.measure.dem.result import AreaHistory, EpochChange
from pcbench.measure.dem.series import place_changes, trend_of, years
from pcbench.measure.dem.settings import ChangeSettings
from pcbench.measure.dem.surface import GridMethod, lowest_offset
from pcbench.measure.dem.volumes import WHOLE_AREA, area_change, part_changes, whole_change
from pcbench.measure.wording import with_unit
from pcbench.progress import ProgressPlan
from pcbench.report.change.document import ChangeDocument
from pcbench.report.change.folder import write_change
from pcbench.report.change.maps import TREND_NAME
from pcbench.report.change.words import volume_unit
from pcbench.report.figures import Figures
from pcbench.report.folder import report_folder
from pcbench.report.names import names_of

_BYTES_PER_NORMAL_POINT = 300
_MIN_STABLE_SHARE = 0.5
_MAX_STEEP_SHARE = 0.02
_MAX_DRIFT_RATIO = 5.0  # of the correlated error over long distances to the error from cell to cell


def open_epochs(
    paths: Sequence[Path],
    settings: ChangeSettings,
    dates: Sequence[date | None] | None = None,
) -> list[tuple[Source, str, date | None]]:
    """Return the sources of epochs with their names and dates, which come from their names if none are given.

    Raises:
        InputError: there are fewer than two, a file does not exist, or the dates are not as many as the epochs.
    """
    if len(paths) < 2:
        raise InputError(f"expected at least two epochs, got {len(paths)}: pcbench change before.laz after.laz")
    if dates is not None and len(dates) != len(paths):
        raise InputError(f"expected {len(paths)} dates, one per epoch, got {len(dates)}")
    filters = parse_filters(settings.classes, settings.returns)
    sources = [Source.open(path, filters) for path in paths]
    days = [date_of(path.name) for path in paths] if dates is None else list(dates)
    return list(zip(sources, names_of(paths, reserved=TREND_NAME), days, strict=True))


def measure_change(
    epochs: Sequence[tuple[Source, str, date | None]],
    settings: ChangeSettings,
    *,
    memory: int,
    step: Callable[[str], None],
) -> AreaHistory:
    """Measure the change from the first epoch to each later one.

    Args:
        epochs: the epochs in their order, see `open_epochs`.
        settings: settings of the measurement.
        memory: bytes that may be used.
        step: called with a short text before each step that takes time.

    Raises:
        InputError: a file is damaged, or the epochs, polygons, lines or cells do not suit.
    """
    reading = [source.reading_seconds for source, _, _ in epochs]
    plan = ProgressPlan(step, [*reading, *reading, *(0.5 + each for each in reading[1:])])
    surveys = []
    for source, name, day in epochs:
        plan(f"reading {source.path}")
        surveys.append(open_epoch(source, name, day, settings.unit))
    check_same_system(surveys)
    grid = common_grid(surveys, settings.cell, memory)
    regions = {} if settings.zones is None else read_zones(settings.zones)
    stable_region = None if settings.stable is None else read_polygon(settings.stable)
    crs = surveys[0].cloud.crs or surveys[-1].cloud.crs
    for file, region in ((settings.zones, Union(tuple(regions.values()))), (settings.stable, stable_region)):
        if file is not None and region is not None:
            check_polygon_system(file, region, crs, surveys[0].low, surveys[0].high)
    zones = _zone_masks(settings.zones, regions, grid)
    stable = None if stable_region is None else _stable_mask(settings.stable, stable_region, grid)
    surfaces = []
    for survey in surveys:
        plan(f"gridding {survey.source.path}")
        surfaces.append(epoch_surface(survey, grid, settings.surface, memory))
    changes = []
    for survey, surface in zip(surveys[1:], surfaces[1:], strict=True):
        plan(f"measuring the change to {survey.name}")
        datum_sigma = settings.datum_sigma
        if settings.surface is GridMethod.LOWEST and stable is None:
            datum_sigma = math.hypot(datum_sigma, lowest_offset(surfaces[0], surface))
        difference = difference_of(
            grid,
            surfaces[0],
            surface,
            named_stable=stable,
            is_filled=settings.fill_voids,
            datum_sigma=datum_sigma,
        )
        if not difference.measured.any():
            raise InputError(
                f"{surveys[0].source.path} and {survey.source.path}: expected cells with points of both epochs, got"
                " none: check that they show the same area, or choose larger cells (--cell)"
            )
        normals = None
        if settings.normals:
            normals = _along_normals(surveys[0], survey, grid, memory, settings.datum_sigma)
        changes.append(
            EpochChange(
                survey,
                difference,
                whole_change(difference),
                tuple(area_change(difference, name, mask) for name, mask in zones.items()),
                tuple(part_changes(difference)),
                normals,
            )
        )
    differences = [change.difference for change in changes]
    times = years([survey.date for survey in surveys])
    return AreaHistory(
        settings=settings,
        epochs=tuple(surveys),
        grid=grid,
        zones=zones,
        zone_regions=regions,
        changes=tuple(changes),
        profiles=tuple(profile_along(line, grid, surfaces, differences) for line in settings.profiles),
        places=tuple(place_changes(settings.points, grid, differences)),
        trend=trend_of(differences, times),
        unit=surveys[0].cloud.unit or surveys[-1].cloud.unit,
        crs=crs,
        warnings=tuple(_warnings(surveys, changes, settings)),
    )


@dataclass(frozen=True, eq=False)
class ChangeOutcome:
    """A measured change as plain values, and why the page or requested pictures are missing, or None."""

    document: ChangeDocument
    without_page: str | None = None
    without_figures: str | None = None


def change_files(
    epochs: Sequence[tuple[Source, str, date | None]],
    settings: ChangeSettings,
    out: Path | None,
    *,
    memory: int,
    figures: Figures | None,
    step: Callable[[str], None],
) -> ChangeOutcome:
    """Measure the change between epochs and write its folder.

    Args:
        epochs: the epochs in their order, see `open_epochs`.
        settings: settings of the measurement.
        out: the output folder; None: write nothing.
        memory: bytes that may be used.
        figures: appearance of the pictures; None: draw none.
        step: called with a short text before each step that takes time.

    Raises:
        PcbenchError, OSError: an input or the output is invalid; nothing was written.
    """
    if out is None:
        return ChangeOutcome(ChangeDocument.of(measure_change(epochs, settings, memory=memory, step=step)))
    inputs = [file for source, _, _ in epochs for file in source.files]
    with report_folder(out, keep=[*inputs, *settings.files]) as folder:
        history = measure_change(epochs, settings, memory=memory, step=step)
        document = ChangeDocument.of(history)
        written = write_change(folder, history, document, figures, step)
    return ChangeOutcome(document, *written)


def _zone_masks(path: Path | None, regions: Mapping[str, Region], grid: HeightGrid) -> dict[str, Mask]:
    """Return the cells of each zone whose centres lie inside.

    Raises:
        InputError: a zone has the name of the whole area, or no cell.
    """
    masks = {}
    for name, region in regions.items():
        mask = _cells_inside(region, grid)
        if name == WHOLE_AREA:
            raise InputError(f"{path}: expected another name than {WHOLE_AREA!r}, which is that of the whole area")
        if not mask.any():
            raise InputError(f"{path}: zone {name!r}: expected a polygon in the area that the epochs share: check it")
        masks[name] = mask
    return masks


def _stable_mask(path: Path | None, region: Region, grid: HeightGrid) -> Mask:
    mask = _cells_inside(region, grid)
    if not mask.any():
        raise InputError(f"{path}: expected stable terrain in the area that the epochs share: check the polygon")
    return mask


def _cells_inside(region: Region, grid: HeightGrid) -> Mask:
    """Return the cells (H, W) whose centres lie inside a region in the plane, row by row to bound the memory."""
    rows = []
    for y in grid.rows_y:
        centres = np.column_stack([grid.columns_x, np.full(grid.shape[1], y), np.zeros(grid.shape[1])])
        rows.append(region.contains(centres))
    return np.array(rows)


def _along_normals(first: Epoch, second: Epoch, grid: HeightGrid, memory: int, datum_sigma: float) -> NormalVolume:
    """Read the points of both epochs in the grid, and measure the volume along normals.

    Raises:
        InputError: the points do not fit into the memory.
    """
    needed = (first.count + second.count) * _BYTES_PER_NORMAL_POINT
    if needed > memory:
        raise InputError(
            f"expected --normals for clouds that fit into --memory, got {first.count + second.count:,} points, which"
            f" need {needed / (1 << 30):.1f} GiB: crop them with pcbench crop, or give more memory"
        )
    points = []
    for epoch in (first, second):
        parts = [read_piece(epoch.cloud, piece).points for piece in epoch.cloud.pieces]
        points.append(np.concatenate([part[grid.surrounds(part)] for part in parts]))
    return volume_along_normals(points[0], points[1], datum_sigma=datum_sigma)


def _warnings(surveys: Sequence[Epoch], changes: Sequence[EpochChange], settings: ChangeSettings) -> list[str]:
    """Return what not to trust."""
    lines = [line for survey in surveys for line in survey.warnings]
    for change in changes:
        difference, name = change.difference, change.epoch.name
        if not difference.dz[difference.measured].any():
            lines.append(f"{name}: all heights are those of {surveys[0].name}: check that it is another survey")
        if difference.model is None:
            terrain, remedy = "terrain without change", "name stable terrain (--stable)"
            if settings.stable is not None:
                terrain, remedy = "named stable terrain", "name more of it"
            lines.append(
                f"{name}: too little {terrain} to estimate the errors, so no value has an interval: choose smaller"
                f" cells (--cell), or {remedy}"
            )
            if difference.offset is not None:
                offset = with_unit(f"{difference.offset:.3g}", surveys[0].cloud.unit)
                lines.append(f"{name}: the mean difference of the named stable terrain, {offset}, was subtracted")
            continue
        is_named, unit = settings.stable is not None, surveys[0].cloud.unit
        lines += _difference_warnings(difference, difference.model, name, unit, is_named=is_named)
        lines += _void_warnings(change, unit)
    days = [survey.date for survey in surveys]
    if len(surveys) > 2 and None not in days and len({*days}) < len(days):
        lines.append("two epochs have one date, so that the trend is per epoch and not per year: check --dates")
    if settings.surface is GridMethod.LOWEST:
        lines.append(
            "the lowest of more points is lower: the intervals have the offset that the numbers of points make, but the"
            " volumes are not corrected: compare epochs of different density by mean"
        )
    return lines


def _void_warnings(change: EpochChange, unit: str | None) -> Iterator[str]:
    """Yield a warning if the interval of the net volume would miss the volume that the voids have."""
    net, void_area = change.whole.volumes.net, change.whole.void_area
    half_width = (net.high - net.low) / 2
    if abs(change.whole.mean.value) * void_area <= half_width:  # usual, and cheap to see
        return
    volume = change.difference.volume_in_voids
    if abs(volume) > half_width:
        yield (
            f"{change.epoch.name}: cells without points of an epoch are in no volume, and would have about"
            f" {with_unit(f'{volume:+.3g}', volume_unit(unit))}, more than the 95 % interval of the net volume allows"
            " for: --fill-voids adds it, or choose larger cells (--cell)"
        )


def _difference_warnings(
    difference: DemOfDifference, model: ErrorModel, name: str, unit: str | None, *, is_named: bool
) -> list[str]:
    lines = []
    measured = int(np.count_nonzero(difference.measured))
    stable = np.count_nonzero(difference.stable) / max(measured, 1)
    alike = np.count_nonzero(difference.stable & (difference.parts > 0)) / max(measured, 1)
    scatter = float(np.sqrt(model.white_scale * np.median(difference.white[difference.stable])))
    if not is_named and alike >= _MIN_STABLE_SHARE:
        lines.append(
            f"{name}: {alike:.0%} of the area changed alike, by {with_unit(f'{model.mean:+.3g}', unit)}, and shows the"
            " errors; an offset between the epochs looks the same: name stable terrain with --stable"
        )
    elif not is_named and model.long.sigma > _MAX_DRIFT_RATIO * scatter:
        lines.append(
            f"{name}: the differences drift by {with_unit(f'{model.long.sigma:.3g}', unit)} over"
            f" {with_unit(f'{model.long.range * difference.grid.cell:.3g}', unit)}, {model.long.sigma / scatter:.0f}"
            " times their scatter, so that gradual change and errors are not told apart: name stable terrain with"
            " --stable"
        )
    elif not is_named and stable < _MIN_STABLE_SHARE:
        lines.append(
            f"{name}: only {stable:.0%} of the area shows no change, so that errors and change are hard to tell apart:"
            " name stable terrain with --stable"
        )
    steep = np.count_nonzero(difference.slopes_deg[difference.measured] > STEEP_DEG) / max(measured, 1)
    if steep > _MAX_STEEP_SHARE:
        lines.append(
            f"{name}: {steep:.0%} of the area is steeper than {STEEP_DEG:g} degrees, where a difference of heights"
            " stretches what happens on a wall: --normals measures along normals"
        )
    return lines
