"""Charts of a change: volumes of areas, profiles of the epochs, and values against time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from pcbench.geometry.arrays import FloatArray
from pcbench.measure.dem.volumes import AreaChange, EstimatedChange
from pcbench.report.change.document import ChangeDocument, ChangeRecord
from pcbench.report.change.words import epoch_text, place_mark, place_text, volume_unit
from pcbench.report.colors import BLUE, GREEN, ORANGE, PURPLE, SERIES, VERMILION
from pcbench.report.words import printable, shorten_name

_GREY = "#777777"
_FILL, _CUT = "#c8373a", "#4a62d0"  # as on the maps


def draw_volumes(axis: Any, document: ChangeDocument, change: ChangeRecord, *, most: int) -> None:
    """Draw fill, cut and net of zones and of the largest parts as bars with intervals, the first area at the top."""
    areas: list[AreaChange] = [*change.zones, *change.parts][:most]
    for row, area in enumerate(areas):
        fill, cut, net = area.volumes.fill, area.volumes.cut, area.volumes.net
        axis.barh(row, fill.value, height=0.62, color=_FILL, alpha=0.65, label="fill" if not row else None)
        axis.barh(row, -cut.value, height=0.62, color=_CUT, alpha=0.65, label="cut" if not row else None)
        _error_bar(axis, row, net, "net, 95 % interval" if not row else None)
    axis.axvline(0, color=_GREY, linewidth=0.8)
    axis.set_yticks(range(len(areas)), [shorten_name(area.name, 18) for area in areas], fontsize=9, parse_math=False)
    axis.set_ylim(len(areas) - 0.4, -0.6)
    axis.set_xlabel(f"volume [{volume_unit(document.unit)}]", fontsize=9)
    axis.xaxis.set_major_formatter(lambda value, _: f"{value:,.6g}".replace("-", "−"))
    axis.tick_params(labelsize=9)
    axis.margins(x=0.08)
    axis.grid(axis="x", alpha=0.3)
    axis.spines[["top", "right", "left"]].set_visible(False)
    axis.tick_params(axis="y", length=0)
    axis.legend(fontsize=8.5, frameon=False, loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3, borderaxespad=0.1)


def _error_bar(axis: Any, row: int, value: EstimatedChange, label: str | None) -> None:
    ends = [[0.0], [0.0]] if value.low != value.low else [[value.value - value.low], [value.high - value.value]]
    style = {"color": "#111111", "marker": "D", "markersize": 4, "capsize": 3, "linewidth": 1.3, "linestyle": "none"}
    axis.errorbar([value.value], [row], xerr=ends, label=label, **style)


def draw_profile(axes: Sequence[Any], document: ChangeDocument, number: int) -> None:
    """Draw the heights of all epochs along a line, and below their changes with the band of the level of detection."""
    profile = document.profiles[number - 1]
    unit = f" [{document.unit}]" if document.unit else ""
    distances = np.array(profile.distances)
    heights, levels = np.array(profile.heights), np.array(profile.levels)
    above, below = axes
    for epoch, row, color in zip(document.epochs, heights, _colors(len(heights)), strict=True):
        above.plot(distances, row, color=color, linewidth=1.6, label=printable(epoch_text(epoch)))
    above.set_ylabel(f"height{unit}", fontsize=9)
    above.set_title(f"Profile P{number}", fontsize=11)
    for text in above.legend(fontsize=8.5, frameon=False, loc="best").get_texts():
        text.set_parse_math(False)
    band = np.fmax.reduce(levels)
    below.fill_between(distances, -band, band, color=_GREY, alpha=0.25, linewidth=0, label="level of detection")
    for row, color in zip(heights[1:] - heights[0], _colors(len(heights))[1:], strict=True):
        below.plot(distances, row, color=color, linewidth=1.4)
    below.axhline(0, color=_GREY, linewidth=0.8)
    below.set_ylabel(f"change{unit}", fontsize=9)
    below.set_xlabel(f"distance along the line{unit}", fontsize=9)
    below.legend(fontsize=8.5, frameon=False, loc="best")
    for axis in axes:
        _plain(axis)
        axis.margins(x=0)


def series_panels(document: ChangeDocument) -> int:
    """Return the number of panels of the series: volumes, and places if there are any."""
    return 2 if document.places else 1


def draw_series(axes: Sequence[Any], document: ChangeDocument) -> None:
    """Draw volumes and the changes of places against time, with 95 % intervals."""
    times = _times(document)
    wholes = [change.whole.volumes for change in document.changes]
    volumes = [
        ("net", [each.net for each in wholes], "#111111"),
        ("fill", [each.fill for each in wholes], _FILL),
        ("cut", [each.cut for each in wholes], _CUT),
    ]
    for number, (name, values, color) in enumerate(volumes):
        _line(axes[0], times, values, color, name, number - 1)
    axes[0].set_ylabel(f"volume [{volume_unit(document.unit)}]", fontsize=9)
    if document.places:
        unit = f" [{document.unit}]" if document.unit else ""
        middle = 0.5 * (len(document.places) - 1)
        for number, place in enumerate(document.places):
            name = f"{place_mark(number + 1)} at {place_text(place.place)}"
            _line(axes[1], times, place.changes, SERIES[number % len(SERIES)], name, number - middle)
        axes[1].set_ylabel(f"change of height{unit}", fontsize=9)
    for axis in axes:
        axis.axhline(0, color=_GREY, linewidth=0.8)
        axis.legend(fontsize=8.5, frameon=False, loc="best")
        _plain(axis)
    last = axes[-1]
    names = [shorten_name(epoch.date or epoch.name, 14) for epoch in document.epochs]
    last.set_xticks(times, names, fontsize=9, parse_math=False)
    last.set_xlabel("epoch" if document.years is None else "date", fontsize=9)


def _line(axis: Any, times: FloatArray, values: Sequence[EstimatedChange], color: str, name: str, place: float) -> None:
    """Draw values from the first epoch on, at which they are zero; error bars side by side do not cover each other."""
    y = np.array([0.0, *(value.value for value in values)])
    low, high = (np.array([0.0, *(value[k] for value in values)]) for k in (1, 2))
    bars = np.nan_to_num(np.stack([y - low, high - y]))
    at_times = times + place * 0.006 * (times[-1] - times[0])
    axis.errorbar(at_times, y, bars, color=color, marker="o", markersize=4.5, capsize=3, linewidth=1.5, label=name)


def _times(document: ChangeDocument) -> FloatArray:
    if document.years is None:
        return np.arange(float(len(document.epochs)))
    start = document.epochs[0].date
    assert start is not None
    return float(start[:4]) + np.array(document.years)


def _colors(count: int) -> list[str]:
    """Return a colour per epoch: grey for the first, the palette for the others."""
    palette = (VERMILION, BLUE, GREEN, ORANGE, PURPLE)
    return [_GREY, *(palette[k % len(palette)] for k in range(count - 1))]


def _plain(axis: Any) -> None:
    axis.tick_params(labelsize=8.5)
    axis.yaxis.set_major_formatter(lambda value, _: f"{value:,.8g}".replace("-", "−"))
    axis.grid(alpha=0.3)
    axis.spines[["top", "right"]].set_visible(False)
