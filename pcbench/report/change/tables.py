"""Tables of a measured change: for the terminal, for pages, and volumes.csv."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from pcbench.measure.dem.volumes import AreaChange, EstimatedChange
from pcbench.report.change.document import ChangeDocument, ChangeRecord
from pcbench.report.change.words import (
    epoch_text,
    measured_text,
    number_text,
    peak,
    place_text,
)
from pcbench.report.markup import csv_text
from pcbench.report.words import UNKNOWN, columns, pad, percentage

MOST_PARTS = 10
"""Largest number of parts in a table to read; volumes.csv has all."""
CSV, WHOLE = "volumes.csv", "whole area"
_CSV_VALUES = ("net", "fill", "cut", "mean", "detected_net", "detected_fill", "detected_cut")
_CSV_HEADER = (
    *("epoch", "date", "kind", "name", "x", "y", "area", "void_area", "filled_area"),
    *(f"{name}{end}" for name in _CSV_VALUES for end in ("", "_low", "_high")),
    *("fill_by_sign", "cut_by_sign", "largest", "lowest", "below_lod", "unit"),
)


def volume_rows(document: ChangeDocument, change: ChangeRecord) -> list[list[str]]:
    """Return the header and the rows of the table of volumes: the whole area, the zones, and the largest parts."""
    head = ["", *_heads(document, net=3, fill=0, cut=0, area=2, mean=1, peak=0), "below LoD", "centre"]
    rows = [head, _row(WHOLE, change.whole)]
    rows += [_row(zone.name, zone) for zone in change.zones]
    rows += [_row(part.name, part) for part in change.parts[:MOST_PARTS]]
    return rows


def _heads(document: ChangeDocument, **powers: int) -> list[str]:
    """Return titles of columns with the power of the unit, if it is known and the power is not 0."""
    marks = {1: "", 2: "²", 3: "³"}
    unit = document.unit
    return [f"{name} [{unit}{marks[power]}]" if unit and power else name for name, power in powers.items()]


def _row(name: str, area: AreaChange) -> list[str]:
    return [
        name,
        measured_text(area.volumes.net, signed=True),
        measured_text(area.volumes.fill),
        measured_text(area.volumes.cut),
        number_text(area.area),
        number_text(area.mean.value, signed=True),
        number_text(peak(area), signed=True),
        UNKNOWN if area.mean.low != area.mean.low else percentage(area.undetected_share),
        place_text(area.centre),
    ]


def short_rows(document: ChangeDocument, change: ChangeRecord, most: int = 6) -> list[list[str]]:
    """Return a table of volumes for a sheet: fewer columns, and at most `most` parts."""
    rows = [["", *_heads(document, net=3, fill=0, cut=0, area=2, peak=1)]]
    areas = [(WHOLE, change.whole), *((each.name, each) for each in (*change.zones, *change.parts[:most]))]
    for name, area in areas:
        full = _row(name, area)
        rows.append([*full[:5], full[6]])
    return rows


def epoch_rows(document: ChangeDocument) -> list[list[str]]:
    """Return the table of epochs."""
    rows = [["epoch", "date", "file", "points", *_heads(document, area=2), "points per cell"]]
    for epoch in document.epochs:
        density = epoch.points / epoch.area * document.cell_area
        row = [epoch.name, epoch.date or UNKNOWN, epoch.path, f"{epoch.points:,}", number_text(epoch.area)]
        rows.append([*row, number_text(density)])
    return rows


def series_rows(document: ChangeDocument) -> list[list[str]]:
    """Return the table of volumes and of places against time; only the header with two epochs and no places."""
    places = [place_text(each.place) for each in document.places]
    heads = _heads(document, net=3, fill=0, cut=0, **dict.fromkeys(places, 1))
    rows = [[f"since {epoch_text(document.epochs[0])}", *heads]]
    for number, (change, epoch) in enumerate(zip(document.changes, document.epochs[1:], strict=True)):
        volumes = change.whole.volumes
        values = [measured_text(volumes.net, signed=True), measured_text(volumes.fill), measured_text(volumes.cut)]
        places = [_place_change(each.changes[number]) for each in document.places]
        rows.append([epoch_text(epoch), *values, *places])
    return rows


def _place_change(change: EstimatedChange) -> str:
    return UNKNOWN if change.value != change.value else measured_text(change, signed=True)


def error_rows(document: ChangeDocument, change: ChangeRecord) -> list[list[str]]:
    """Return the table of the spread of stable cells by slope and by number of points."""
    errors = change.errors
    assert errors is not None
    rows = [["stable cells", "cells", *_heads(document, **{"spread (NMAD)": 1}), "factor of the white error"]]
    for bins, name in ((errors.by_slope, "slope {:g} to {:g}°"), (errors.by_count, "{:g} to {:g} points")):
        for each in bins:
            label = name.format(each.low, min(each.high, 90) if bins is errors.by_slope else each.high - 1)
            if each.high > 1e8:
                label = f"{each.low:g} points or more"
            rows.append([label, f"{each.cells:,}", number_text(each.nmad), number_text(each.factor)])
    return rows


def text_table(rows: Sequence[Sequence[str]]) -> Iterator[str]:
    """Yield the lines of a table: the first column to the left, the others to the right."""
    widths = [max(columns(row[k]) for row in rows) for k in range(len(rows[0]))]
    for row in rows:
        yield "  ".join(pad(cell, width, right=k > 0) for k, (cell, width) in enumerate(zip(row, widths, strict=True)))


def volumes_csv(document: ChangeDocument) -> str:
    """Return volumes.csv: a row for each area and later epoch."""
    return csv_text(_CSV_HEADER, _csv_rows(document))


def _csv_rows(document: ChangeDocument) -> Iterator[list[str | float | None]]:
    for change, epoch in zip(document.changes, document.epochs[1:], strict=True):
        areas = [("all", change.whole), *(("zone", zone) for zone in change.zones)]
        for kind, area in [*areas, *(("part", part) for part in change.parts)]:
            values = [area.volumes.net, area.volumes.fill, area.volumes.cut, area.mean]
            values += [area.detected.net, area.detected.fill, area.detected.cut]
            row: list[str | float | None] = [change.epoch, epoch.date, kind, area.name, *area.centre]
            row += [area.area, area.void_area, area.filled_area]
            row += [None if end != end else end for value in values for end in value]
            row += [*area.by_sign, area.largest, area.lowest, area.undetected_share, document.unit]
            yield row
