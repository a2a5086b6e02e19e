"""Overviews: the mean distance of all points per pixel of a raster, as seen from above."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pcbench.io.map_tiles import MapOverview
from pcbench.measure.wording import pluralize
from pcbench.report.colors import ranges_of
from pcbench.report.figures import Figures
from pcbench.report.plot.panels import new_figure, save

_WIDTH, _MIN_HEIGHT, _MAX_HEIGHT = 11.0, 4.0, 11.0  # of the picture, in inches
_MIN_PIXEL_POINTS = 8.0  # points per pixel on average: most pixels between the points of a sparse cloud would be empty
_MIN_PIXELS = 100  # along the shorter side
_BAR_WIDTH = 1.6  # of the colour bar and the labels of both axes


def draw_overview(
    overview: MapOverview, title: str, label: str, unit: str, spacing: float, path: Path, look: Figures
) -> bool:
    """Draw an overview with coordinates along its edges and a colour bar.

    Args:
        overview: the raster.
        title: title of the picture.
        label: label of the distances.
        unit: unit of lengths.
        spacing: median spacing of the reference, the least end of the colour range.
        path: the file to write.
        look: appearance of the picture.

    Returns:
        False if no pixel has points.
    """
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import ListedColormap, Normalize

    if not overview.count.any():
        return False
    while min(overview.count.shape) > _MIN_PIXELS and overview.count[overview.count > 0].mean() < _MIN_PIXEL_POINTS:
        overview = overview.halved()
    is_known = np.isfinite(overview.mean)
    rows, columns = (np.flatnonzero(is_known.any(axis=axis)) for axis in (1, 0))
    window = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    means, has_points, pixel = overview.mean[window], is_known[window], overview.pixel
    height, width = means.shape
    values = means[has_points]
    scale = ranges_of({"": values}, spacing=spacing, end=look.range)[""]
    west, north = overview.west + pixel * columns[0], overview.north - pixel * rows[0]
    image = np.zeros((height, width, 4), np.uint8)
    image[has_points] = np.column_stack([scale.colors(values), np.full(len(values), 255)])

    inches = np.clip((_WIDTH - _BAR_WIDTH) * height / width + 1.2, _MIN_HEIGHT, _MAX_HEIGHT)
    figure = new_figure(_WIDTH, float(inches), layout="constrained")
    axes = figure.subplots()
    axes.imshow(image, extent=(west, west + pixel * width, north - pixel * height, north), interpolation="antialiased")
    axes.set_aspect("equal")
    axes.ticklabel_format(useOffset=False, style="plain")
    axes.locator_params(nbins=6)
    axes.set_xlabel(f"x [{unit}]")
    axes.set_ylabel(f"y [{unit}]")
    points = pluralize(int(overview.count.sum()), "point")
    axes.set_title(f"{title} ({points}, pixels of {pixel:.3g} {unit})", fontsize=11)
    axes.set_facecolor(look.ground("dark"))  # large distances are light
    colors = scale.colors(np.linspace(scale.low, scale.high, 256)) / 255
    bar = ScalarMappable(Normalize(scale.low, scale.high), ListedColormap(colors))
    beyond = bool((values > scale.high).any())
    note = f"mean {label} [{unit}]\n{scale.note}; dark: no points"
    place = axes.inset_axes((1.02, 0, 0.03, 1))
    figure.colorbar(bar, cax=place, label=note, extend="max" if beyond else "neither")
    save(figure, path)
    return True
