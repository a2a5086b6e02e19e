"""A measured change in sentences: the answer first, then how far its numbers can be trusted."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from pcbench.geometry.crs import crs_label
from pcbench.measure.dem.along_normals import STEEP_DEG
from pcbench.measure.dem.volumes import AreaChange, EstimatedChange
from pcbench.measure.wording import pluralize, with_unit
from pcbench.report.change.document import ChangeDocument, ChangeRecord, EpochRecord, ErrorRecord, NormalsRecord
from pcbench.report.words import percentage

METHODS = {
    "mean": "the mean of the points in a cell",
    "median": "the median of the points in a cell",
    "lowest": "the lowest point in a cell",
    "tin": "the triangulated points at the centre of a cell",
}
_DIGITS = 3
_LEAST_DECIMAL = 1e-6
"""Largest size that is written with a power of ten."""
_LEAST_SHARE = 1e-3  # of the white error; smaller errors are not named


def decimals_for(largest: float) -> int:
    """Return the number of decimals with which a size has three significant digits; none from 100 on."""
    if not (math.isfinite(largest) and largest > 0):
        return 0
    return max(0, _DIGITS - 1 - math.floor(math.log10(largest)))


def _formatted(value: float, largest: float, *, signed: bool = False) -> str:
    """Return a number with the decimals of the largest of its row, and without the sign of a zero."""
    sign = "+" if signed else ""
    if 0 < largest < _LEAST_DECIMAL:
        return f"{value:{sign}z.{_DIGITS}g}"
    return f"{value:{sign}z,.{decimals_for(largest)}f}"


def measured_text(value: EstimatedChange, *, signed: bool = False, scale: float = 1.0) -> str:
    """Return a value with its interval, such as "+376 [125, 627]"; without an interval, the value alone."""
    sizes = [abs(each) for each in value if math.isfinite(each)]
    largest = scale * max(sizes, default=0.0)
    text = _formatted(scale * value.value, largest, signed=signed)
    if not math.isfinite(value.low):
        return text
    return f"{text} [{_formatted(scale * value.low, largest)}, {_formatted(scale * value.high, largest)}]"


def number_text(value: float, *, signed: bool = False) -> str:
    """Return a number with three significant digits, whole from 100 on."""
    return _formatted(value, abs(value), signed=signed)


def volume_unit(unit: str | None) -> str:
    """Return the unit of volumes, such as "m³"."""
    return f"{unit}³" if unit else "cubic units"


def area_unit(unit: str | None) -> str:
    """Return the unit of areas, such as "m²"."""
    return f"{unit}²" if unit else "square units"


def length_text(value: float, unit: str | None) -> str:
    """Return a length with three significant digits and its unit."""
    return with_unit(f"{value:.3g}", unit)


def area_text(value: float, unit: str | None) -> str:
    """Return an area with its unit."""
    return f"{number_text(value)} {area_unit(unit)}"


def place_text(place: Sequence[float]) -> str:
    """Return a place x, y."""
    return f"({', '.join(f'{value:.1f}' for value in place)})"


def place_mark(number: int) -> str:
    """Return the mark of a place by its number from 1: a letter, because parts have numbers."""
    return chr(ord("A") + number - 1) if number <= 26 else f"A{number}"


def peak(area: AreaChange) -> float:
    """Return the largest change of a cell of an area, with its sign."""
    return area.largest if area.largest >= -area.lowest else area.lowest


def epoch_text(epoch: EpochRecord) -> str:
    """Return the name of an epoch with its date, if the name does not have it."""
    return epoch.name if epoch.date is None or epoch.date in epoch.name else f"{epoch.name} ({epoch.date})"


def answer(document: ChangeDocument) -> Iterator[str]:
    """Yield what changed: the volumes until each later epoch, then what is known of the change until the last one."""
    for change, epoch in zip(document.changes, document.epochs[1:], strict=True):
        yield headline(document, change, epoch)
    yield from _verdicts(document, document.changes[-1])
    if document.trend is not None:
        yield _trend(document)


def headline(document: ChangeDocument, change: ChangeRecord, epoch: EpochRecord) -> str:
    """Return the volumes between the first epoch and a later one in one sentence."""
    whole, unit = change.whole, volume_unit(document.unit)
    volumes = whole.volumes
    mean = measured_text(whole.mean, signed=True)
    return (
        f"Between {epoch_text(document.epochs[0])} and {epoch_text(epoch)}: net"
        f" {_with_unit_inside(volumes.net, unit, signed=True)} over {area_text(whole.area, document.unit)}"
        f" (fill {measured_text(volumes.fill)}, cut {measured_text(volumes.cut)});"
        f" mean {with_unit(mean, document.unit)}."
    )


def _with_unit_inside(value: EstimatedChange, unit: str, *, signed: bool = False) -> str:
    """Return a value with its unit before its interval: "+376 m³ [125, 627]"."""
    number, bracket, interval = measured_text(value, signed=signed).partition(" [")
    return f"{number} {unit}{bracket}{interval}"


def _verdicts(document: ChangeDocument, change: ChangeRecord) -> Iterator[str]:
    net = change.whole.volumes.net
    until = f" until {change.epoch}" if len(document.changes) > 1 else ""
    if net.low <= 0 <= net.high:
        yield f"The net volume{until} cannot be told from zero: its 95 % interval has both signs."
    if change.errors is not None:
        yield from _detections(document, change, change.errors, until)
    if change.along_normals is not None:
        yield _along_normals(document, change)


def _detections(document: ChangeDocument, change: ChangeRecord, errors: ErrorRecord, until: str) -> Iterator[str]:
    """Yield which parts changed, and how much of the area changed beyond the level of detection."""
    whole = change.whole
    if not change.part_count:
        yield f"No part of the area changed{until} by more than its errors explain."
    else:
        largest = change.parts[0]
        verb = "rose" if peak(largest) > 0 else "fell"
        volume = _with_unit_inside(largest.volumes.net, volume_unit(document.unit), signed=True)
        yield (
            f"{pluralize(change.part_count, 'part')} of the area changed{until}. The largest {verb} at"
            f" {place_text(largest.centre)} by {volume} over {area_text(largest.area, document.unit)}, at most"
            f" {length_text(abs(peak(largest)), document.unit)}."
        )
    text = (
        f"{percentage(whole.undetected_share)} of the area changed by less than the level of detection, whose median is"
        f" {length_text(errors.median_level, document.unit)}."
    )
    if change.part_count:  # otherwise the cells beyond it are those with the largest errors
        text += (
            f" The cells beyond it alone have net"
            f" {_with_unit_inside(whole.detected.net, volume_unit(document.unit), signed=True)}"
            f" (fill {measured_text(whole.detected.fill)}, cut {measured_text(whole.detected.cut)})."
        )
    yield text


def _along_normals(document: ChangeDocument, change: ChangeRecord) -> str:
    normals, unit = change.along_normals, document.unit
    assert normals is not None
    if normals.steep_share < 0.01:
        right = "Almost nothing is that steep, so the difference of heights is the one to use."
    else:
        right = (
            "There, and below overhangs, the volume along normals is the right one; elsewhere the difference of heights"
            " is, because it has a value in each cell."
        )
    return (
        f"Along normals: net {_with_unit_inside(normals.volumes.net, volume_unit(unit), signed=True)} over"
        f" {area_text(normals.area, unit)} of surface (in front {measured_text(normals.volumes.fill)}, behind"
        f" {measured_text(normals.volumes.cut)}, by the sign of each place, which errors enlarge)."
        f" {percentage(normals.steep_share)} of the surface is steeper than"
        f" {STEEP_DEG:g} degrees. {right}{_out_of_reach(normals, unit)}"
    )


def _out_of_reach(normals: NormalsRecord, unit: str | None) -> str:
    """Return which surface is in no volume along normals, because a large change may have moved it out of reach."""
    if not normals.void_area > 0:
        return ""
    return (
        f" {area_text(normals.void_area, unit)} of surface have no points of the later epoch within"
        f" {length_text(normals.reach, unit)} along the normal and are in no volume along normals: a change may exceed"
        " this length there."
    )


def _trend(document: ChangeDocument) -> str:
    trend = document.trend
    assert trend is not None
    per = "year" if trend.is_per_year else "epoch"
    rate = f"{number_text(trend.median, signed=True)} {document.unit or 'units'} per {per}"
    return (
        f"Over all {len(document.epochs)} epochs {percentage(trend.rising_share)} of the area rises and"
        f" {percentage(trend.falling_share)} falls by more than 1.96 standard errors; the median trend is {rate}."
    )


def method_sentence(document: ChangeDocument) -> str:
    """Return how the change was measured, in one sentence."""
    settings, grid = document.settings, document.grid
    points = min(epoch.points / epoch.area for epoch in document.epochs) * grid.cell_area
    origin = "as given" if settings["cell"] is not None else "by default"
    cells = (
        f"cells of {length_text(grid.cell, document.unit)} ({origin}; on average {points:.2g} points of the sparsest"
    )
    return (
        f"Heights are {METHODS[settings['surface']]}, in {cells} epoch); volumes are the sums of their differences"
        " times the area of a cell."
    )


def uncertainty_sentence(document: ChangeDocument) -> str:
    """Return what the intervals state, in one sentence."""
    errors = document.changes[-1].errors
    if errors is None:
        return (
            "There is too little terrain without change to estimate the errors, so the values have no intervals, and"
            " fill and cut are sums by the sign of each cell, which errors enlarge."
        )
    source = "named stable terrain" if errors.offset is not None else "terrain without visible change"
    return (
        "Intervals of 95 % follow from white and correlated errors of several ranges, which the"
        f" {source} shows (Rolstad et al. 2009, Hugonnet et al. 2022), propagated to each sum."
    )


def error_sentences(document: ChangeDocument, change: ChangeRecord) -> Iterator[str]:
    """Yield the errors in words."""
    errors, unit = change.errors, document.unit
    if errors is None:
        return
    kinds = [f"{length_text(errors.white, unit)} from cell to cell"]
    kinds += [
        f"{length_text(error.sigma, unit)} over {length_text(error.range, unit)}"
        for error in (errors.short, errors.long)
        if error.sigma > _LEAST_SHARE * errors.white
    ]
    terrain = "the named stable terrain" if errors.offset is not None else "terrain without visible change"
    yield (
        f"Errors of a cell (one standard deviation, {change.epoch}): {', '.join(kinds)}, estimated on"
        f" {area_text(errors.stable_area, unit)} of {terrain}."
    )
    yield _assumption(document, errors)


def _assumption(document: ChangeDocument, errors: ErrorRecord) -> str:
    unit = document.unit
    long = "The data show no error as long as the area"
    if errors.whole.sigma > _LEAST_SHARE * errors.white:
        long = (
            f"An error as long as the area is in the intervals with {length_text(errors.whole.sigma, unit)}, as far as"
            " the data do not exclude it"
        )
    if errors.offset is not None:
        return (
            f"{long}. The mean difference of the stable terrain, {length_text(errors.offset, unit)}, was subtracted,"
            " and its error is in the intervals."
        )
    if errors.datum_sigma > 0:
        return (
            f"{long}. An offset between the epochs is in the intervals with {length_text(errors.datum_sigma, unit)},"
            f" {_datum_source(document)}."
        )
    return (
        f"{long}. An offset in height between the epochs cannot be told from change and is in no interval: name stable"
        " terrain (--stable), or state the offset's standard deviation (--datum-sigma)."
    )


def _datum_source(document: ChangeDocument) -> str:
    """Return where the standard deviation of an offset between the epochs is from."""
    is_lowest = document.settings["surface"] == "lowest"
    sources = ["as different numbers of points make the lowest of them differ"] if is_lowest else []
    if document.settings["datum_sigma"] or not is_lowest:
        sources.append("as given (--datum-sigma)")
    return " and ".join(sources)


def extent_sentences(document: ChangeDocument) -> Iterator[str]:
    """Yield the cells, the voids and the coordinate system in words."""
    yield method_sentence(document)
    for change in document.changes:
        whole = change.whole
        total = whole.area + whole.void_area
        if whole.filled_area:
            yield (
                f"{percentage(whole.filled_area / whole.area)} of the area of {change.epoch} has no points of an epoch"
                " and was filled with the mean difference of the cells around."
            )
        if whole.void_area:
            remedy = "" if document.settings["fill_voids"] else " (--fill-voids fills narrow ones)"
            yield (
                f"{percentage(whole.void_area / total)} of the grid of {change.epoch},"
                f" {area_text(whole.void_area, document.unit)}, has no points of an epoch and is in no volume{remedy}."
            )
    yield system_sentence(document)


def system_sentence(document: ChangeDocument) -> str:
    """Return the coordinate system and the unit in one sentence."""
    crs = "unknown" if document.crs is None else crs_label(document.crs)
    unit = document.unit or "unknown (--unit states it)"
    if document.settings.get("unit") is not None:
        unit += ", as given (--unit) where a cloud states none"
    return f"Coordinate system: {crs}; unit of lengths: {unit}."
