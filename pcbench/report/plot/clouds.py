"""A picture of one cloud, in its own colours, coloured by height, or by one of its attributes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from pcbench.errors import InputError
from pcbench.extras import require
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cloud import Cloud
from pcbench.measure.wording import pluralize
from pcbench.report.colors import Range, height_range, ranges_of
from pcbench.report.figures import Figures
from pcbench.report.plot import maps
from pcbench.report.plot.classes import classes_of
from pcbench.report.plot.panels import drawing_style
from pcbench.report.read import UNKNOWN_UNIT
from pcbench.report.scalars import SCALARS, scalar_of
from pcbench.report.viewing import ViewingCameras
from pcbench.scratch import atomic_write

_MIN_ZERO_RATIO = 0.5  # of the lowest to the highest value: above, the colours do not start at zero


def draw_cloud(
    name: str,
    cloud: Cloud,
    path: Path,
    look: Figures,
    *,
    scalar: str | None = None,
    cameras: ViewingCameras | None = None,
) -> None:
    """Draw a cloud from three viewpoints that suit it.

    Args:
        name: name of the cloud, for the title.
        cloud: the cloud.
        path: the file to write; its extension is the format.
        look: appearance of the picture.
        scalar: attribute that colours the points; points without a finite value are grey. None: the cloud's own
            colours, or its heights if it has none.
        cameras: cameras that photographed the cloud, which select the views.

    Raises:
        InputError: the cloud has no such attribute, or no finite value of it.
        MissingExtra: matplotlib is not installed.
        OSError: the file cannot be written.
    """
    require("matplotlib.figure")
    values = None if scalar is None else attribute_values(cloud, scalar)
    if cameras is not None:
        rotation, cameras = cameras.upright()
        cloud = cloud if rotation is None else cloud.transformed(rotation)
    unit = cloud.unit or UNKNOWN_UNIT
    framing = maps.Framing(maps.frame(None, {name: cloud}, cameras), unit, look)
    with TemporaryDirectory() as folder, drawing_style(look):
        picture = Path(folder) / f"picture{path.suffix.lower()}"
        if scalar is None or values is None:
            maps.draw_own_colors(name, cloud, framing, picture)
        else:
            label = scalar_of(scalar).label + (f" [{unit}]" if scalar in SCALARS else "")
            title = f"{name} ({pluralize(int(np.isfinite(values).sum()), 'point')})"
            scenery = maps.Scenery(cloud.points, framing)
            is_integer = np.issubdtype(cloud.attributes[scalar].dtype, np.integer)
            classes = classes_of(scalar, values, is_integer=is_integer) if look.range is None else None
            scale = classes or _range(values, look.range)
            maps.draw_coloured_cloud(cloud, values, title, scale, label, scenery, picture)
        with atomic_write(path) as file:
            file.write(picture.read_bytes())


def attribute_values(cloud: Cloud, name: str) -> FloatArray:
    """Return an attribute (N,) of a cloud, of which some values are finite.

    Raises:
        InputError: the cloud has no such attribute, or it has no finite value.
    """
    if name not in cloud.attributes:
        names = ", ".join(cloud.attributes) or "none"
        raise InputError(f"expected an attribute of the cloud, got {name!r}; it has: {names}")
    values = np.asarray(cloud.attributes[name], np.float64)
    if not np.isfinite(values).any():
        raise InputError(f"expected finite values of {name!r}, got none")
    return values


def _range(values: FloatArray, end: float | None) -> Range:
    """Return the colour range of an attribute: that of distances, or the inner 99 % of values far from zero."""
    finite = values[np.isfinite(values)]
    if not finite.any():
        return Range(0.0, end or 1.0, "all values are 0", is_closed=True)
    low, high = np.percentile(finite, [0.5, 99.5])
    if end is None and low > _MIN_ZERO_RATIO * high:
        scale = replace(height_range(finite), note="inner 99 %")
    else:
        scale = ranges_of({"": values}, end=end)[""]
    if scale.low <= finite.min() and finite.max() <= scale.high:
        scale = replace(scale, note="" if end is None else scale.note, is_closed=True)
    return scale
