"""The plan view of a change: changes of height over a shaded relief, with parts, zones, profiles and places."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray
from pcbench.report.change.document import ChangeDocument
from pcbench.report.change.layers import PlanLayers
from pcbench.report.change.words import place_mark
from pcbench.report.colors import Range
from pcbench.report.figures import rgb
from pcbench.report.plot.plan_marks import draw_north_arrow, draw_scale_bar, left_of_arrow, paper
from pcbench.report.plot.rounding import axis_title, round_origin

_OUTLINE, _ZONE, _PROFILE = "#111111", "#8e24aa", "#00695c"
_MOST_NUMBERS = 12


def draw_plan(
    axis: Any, document: ChangeDocument, layers: PlanLayers, scale: Range, *, ground: str = "#ffffff"
) -> None:
    """Draw the plan view into axes.

    Args:
        axis: the axes.
        document: the change, for its zones, profiles, places and unit.
        layers: its rasters.
        scale: colour range of the changes.
        ground: colour of voids.
    """
    axis.imshow(change_image(layers, scale, ground), extent=layers.extent, interpolation="nearest", origin="upper")
    _outline(axis, layers)
    for rings in document.zone_rings.values():
        for ring in rings:
            corners = np.array([*ring, ring[0]])
            axis.plot(*corners.T, color=_ZONE, linewidth=1.5, path_effects=paper())
    for name, rings in document.zone_rings.items():
        corners = np.array(rings[0])
        middle = 0.5 * (corners.min(axis=0) + corners.max(axis=0))
        top = corners[:, 1].max()
        axis.annotate(
            name, (middle[0], top), (0, -2), textcoords="offset points", color=_ZONE, fontsize=8, ha="center", va="top",
            fontweight="bold", path_effects=paper(), parse_math=False, clip_on=True,
        )  # fmt: skip
    for number, profile in enumerate(document.profiles, 1):
        x, y = (np.array(profile.line[k::2]) for k in (0, 1))
        axis.plot(x, y, color=_PROFILE, linewidth=1.6, path_effects=paper())
        axis.annotate(
            f"P{number}", (x[0], y[0]), (0, 4), textcoords="offset points", color=_PROFILE, fontsize=8.5,
            fontweight="bold", ha="center", path_effects=paper(), clip_on=True,
        )  # fmt: skip
    for number, place in enumerate(document.places, 1):
        axis.plot(*place.place, marker="^", color=_OUTLINE, markersize=6, markeredgecolor="white", linestyle="none")
        axis.annotate(
            place_mark(number), place.place, (5, 4), textcoords="offset points", fontsize=8, color=_OUTLINE,
            path_effects=paper(), clip_on=True,
        )  # fmt: skip
    _numbers(axis, document, layers)
    axis.set(xlim=(layers.west, layers.east), ylim=(layers.south, layers.north), aspect="equal")
    _coordinates(axis, document.unit, layers)
    draw_scale_bar(axis, document.unit)
    draw_north_arrow(axis)


def change_image(layers: PlanLayers, scale: Range, ground: str) -> NDArray[np.uint8]:
    """Return the picture (H, W, 3): significant changes in colour, others as grey relief, voids as the ground."""
    shade = (0.55 + 0.45 * layers.shade)[..., None]
    grey = (255 * (0.56 + 0.4 * layers.shade))[..., None].repeat(3, axis=2)
    colors = scale.colors(np.nan_to_num(layers.dz).ravel()).reshape(*layers.dz.shape, 3)
    image = np.where(layers.significant[..., None], colors * (0.6 + 0.4 * shade), grey)
    voids = ~np.isfinite(layers.dz)
    image[voids] = rgb(ground)
    result: NDArray[np.uint8] = np.rint(image).astype(np.uint8)
    return result


def _outline(axis: Any, layers: PlanLayers) -> None:
    """Draw the borders of the changed parts along the borders of pixels."""
    parts, measured = np.pad(layers.parts, 1), np.pad(np.isfinite(layers.dz), 1, constant_values=True)
    sides = [(slice(None, -1), slice(1, -1)), (slice(1, None), slice(1, -1))]
    for along, (first, second) in enumerate((sides, [(columns, rows) for rows, columns in sides])):
        rows, columns = np.nonzero((parts[first] != parts[second]) & measured[first] & measured[second])
        x, y = layers.west + columns * layers.pixel, layers.north - rows * layers.pixel
        step = layers.pixel
        ends = ((x, x + step), (y, y)) if along == 0 else ((x, x), (y, y - step))
        segments = np.stack([np.stack(ends[0], axis=1), np.stack(ends[1], axis=1)], axis=2)
        _add_segments(axis, segments)


def _add_segments(axis: Any, segments: FloatArray) -> None:
    from matplotlib.collections import LineCollection

    axis.add_collection(LineCollection(list(segments), colors=_OUTLINE, linewidths=0.8, capstyle="projecting"))


def _numbers(axis: Any, document: ChangeDocument, layers: PlanLayers) -> None:
    """Write the numbers of the largest parts at a cell inside each, nearest to its centre."""
    for number in range(1, _MOST_NUMBERS + 1):
        rows, columns = np.nonzero(layers.parts == number)
        if not len(rows):
            continue
        nearest = int(np.argmin((rows - rows.mean()) ** 2 + (columns - columns.mean()) ** 2))
        x = layers.west + (columns[nearest] + 0.5) * layers.pixel
        y = layers.north - (rows[nearest] + 0.5) * layers.pixel
        text_x = left_of_arrow((x, y), layers.extent)
        axis.text(
            text_x, y, str(number), fontsize=9, fontweight="bold", color=_OUTLINE,
            ha="right" if text_x < x else "center", va="center", path_effects=paper(), clip_on=True,
        )  # fmt: skip


def _coordinates(axis: Any, unit: str | None, layers: PlanLayers) -> None:
    """Label the axes with coordinates, less a round origin if they are large."""
    from matplotlib.ticker import FuncFormatter, MaxNLocator

    low, high = np.array([layers.west, layers.south]), np.array([layers.east, layers.north])
    origin = round_origin(low, high)
    for side, name, start in ((axis.xaxis, "x", origin[0]), (axis.yaxis, "y", origin[1])):
        side.set_major_locator(MaxNLocator(6, steps=(1, 2, 5, 10)))
        side.set_major_formatter(FuncFormatter(lambda value, _, start=start: f"{value - start:,.10g}"))
        side.set_label_text(axis_title(name, float(start), unit), fontsize=9)
    axis.tick_params(labelsize=8, direction="out", length=3)
    for label in axis.get_yticklabels():
        label.set(rotation=90, va="center")
    axis.grid(color="#000000", alpha=0.13, linewidth=0.5)


def draw_raster(
    axis: Any, values: FloatArray, layers: PlanLayers, scale: Range, unit: str | None, *, ground: str = "#ffffff"
) -> None:
    """Draw a raster of positive values in colours into axes."""
    image = scale.colors(np.nan_to_num(values).ravel()).reshape(*values.shape, 3)
    image[~np.isfinite(values)] = rgb(ground)
    axis.imshow(image, extent=layers.extent, interpolation="nearest", origin="upper")
    axis.set(aspect="equal")
    _coordinates(axis, unit, layers)


def color_bar(axis: Any, scale: Range, label: str, *, level: float | None = None) -> None:
    """Draw the bar of a colour range into axes, with the median level of detection in grey."""
    steps = scale.colors(np.linspace(scale.low, scale.high, 256))[::-1, None]
    axis.imshow(steps, extent=(0, 1, scale.low, scale.high), aspect="auto", interpolation="nearest")
    if level is not None and scale.signed:
        shown = min(level, scale.high)
        axis.axhspan(-shown, shown, color="#c4c4c4", lw=0)
    axis.set_xticks([])
    axis.yaxis.tick_right()
    axis.yaxis.set_label_position("right")
    axis.tick_params(labelsize=8)
    axis.set_ylabel(label, fontsize=9)
