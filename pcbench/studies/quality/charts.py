"""The pictures of `pcbench quality`: maps of density, thickness and voids in plan view."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from pcbench.extras import require
from pcbench.geometry.arrays import FloatArray
from pcbench.measure.quality.density import PlanMap
from pcbench.measure.quality.quality import QualityMaps
from pcbench.report.colors import BLUE, VERMILION
from pcbench.report.figures import Figures, ink
from pcbench.report.plot import Drawer, Picture
from pcbench.report.plot.panels import drawing_style
from pcbench.report.plot.plan_marks import DARK, draw_north_arrow, draw_scale_bar, left_of_arrow, paper
from pcbench.studies.frame.canvas import (
    blank_figure,
    chart_pictures,
    delete_former_charts,
    plain_log_ticks,
    save_charts,
)
from pcbench.studies.quality.maps import read_maps
from pcbench.studies.quality.results import KIND, MAPS, MeasuredCloud, QualityStudy

# Draws the pictures of a study's folder.
PICTURES = Drawer(f"{__name__}:pictures", (KIND.document,))

_MAP_SIDE = 7.0  # of the longer side, in inches
_MAX_ASPECT = 3.0
_RANGE = (2, 98)  # percentiles of the values that the colours show
_MAX_LINEAR_RATIO = 20.0  # of the ends of the range, above which the colours are logarithmic
_MAX_NUMBERED = 20  # voids and double walls with numbers
_NUMBER_ROOM = 0.25  # for a number, in inches


def pictures(folder: Path, look: Figures) -> dict[str, Picture]:
    """Return the pictures of a folder that `pcbench quality` wrote."""
    study = KIND.read(folder)
    return chart_pictures(lambda: _charts(folder, look, study), look)


def draw_charts(folder: Path, look: Figures, study: QualityStudy) -> list[Path]:
    """Draw the pictures of a study's folder, and return the files.

    Raises:
        MissingExtra: matplotlib is not installed.
        OSError: a file cannot be read or written.
    """
    require("matplotlib.figure")
    with drawing_style(look):
        files = save_charts(folder, _charts(folder, look, study))
    delete_former_charts(folder, files)
    return files


def _charts(folder: Path, look: Figures, study: QualityStudy) -> Iterator[tuple[str, Any]]:
    """Yield the maps of all clouds; the same map of two clouds has one colour range."""
    dark = ink(look.ground("white"))
    maps = [read_maps(folder / MAPS, cloud.name) for cloud in study.clouds]
    for kind in ("density", "thickness"):
        plans: list[PlanMap | None] = [getattr(plan, kind) for plan in maps]
        values = [plan.values[np.isfinite(plan.values)] for plan in plans if plan is not None]
        if not values:
            continue
        low, high = np.percentile(np.concatenate(values), _RANGE).tolist()
        for cloud, plan in zip(study.clouds, plans, strict=True):
            if plan is not None:
                yield f"{kind}_{cloud.name}", _map(plan, cloud, kind, (low, high), dark)
    for cloud, plans_of in zip(study.clouds, maps, strict=True):
        if (cloud.voids or cloud.water_voids) and plans_of.voids is not None:
            yield f"voids_{cloud.name}", _void_map(plans_of, cloud)


def _map(plan: PlanMap, cloud: MeasuredCloud, kind: str, limits: tuple[float, float], dark: str) -> Any:
    from matplotlib.colors import LogNorm, Normalize

    unit = cloud.unit or "units"
    labels = {"density": f"points per {unit}²", "thickness": f"thickness [{unit}]"}
    figure, axis = _frame(plan, cloud)
    low, high = limits
    norm: Any = Normalize(low, high)
    if low > 0 and high > _MAX_LINEAR_RATIO * low:
        norm = LogNorm(low, high)
    west, east, south, north = plan.extent
    image = axis.imshow(
        plan.values,
        cmap="viridis" if kind == "density" else "magma",
        norm=norm,
        extent=(west, east, south, north),
        interpolation="nearest",
    )
    bar = figure.colorbar(image, ax=axis, extend="both", aspect=30, pad=0.02)
    bar.set_label(labels[kind])
    if isinstance(norm, LogNorm):
        plain_log_ticks(bar.ax.yaxis)
    if kind == "thickness" and cloud.double_walls:
        places = np.array([wall.centre for wall in cloud.double_walls[:_MAX_NUMBERED]])
        axis.plot(places[:, 0], places[:, 1], "o", color=dark, fillstyle="none", markersize=9, label="double wall")
        _number(axis, plan, places[:, :2], cloud)
        figure.legend(loc="outside lower center", frameon=False, fontsize=9)
    _finish(axis, plan, cloud)
    return figure


def _void_map(maps: QualityMaps, cloud: MeasuredCloud) -> Any:
    """Draw the voids on the density in grey, with their numbers."""
    from matplotlib.colors import ListedColormap

    plan = maps.voids
    assert plan is not None
    figure, axis = _frame(plan, cloud)
    if maps.density is not None:
        ground = maps.density.values
        west, east, south, north = maps.density.extent
        high = float(np.nanpercentile(ground, _RANGE[1]))
        axis.imshow(
            ground, cmap="Greys", vmin=0, vmax=1.6 * high, extent=(west, east, south, north), interpolation="nearest"
        )
    west, east, south, north = plan.extent
    shown = np.where(plan.values > 0, plan.values, np.nan)
    colors = ListedColormap([VERMILION, BLUE])
    axis.imshow(shown, cmap=colors, vmin=0.5, vmax=2.5, extent=(west, east, south, north), interpolation="nearest")
    _number(axis, plan, np.array([(void.x, void.y) for void in cloud.voids[:_MAX_NUMBERED]]).reshape(-1, 2), cloud)
    _finish(axis, plan, cloud)
    return figure


def _number(axis: Any, plan: PlanMap, places: FloatArray, cloud: MeasuredCloud) -> None:
    """Write numbers beside places (N, 2), from the first on, where they cover neither an earlier one nor the arrow."""
    west, east, south, north = plan.extent
    size = np.array([east - west, north - south])
    room = _NUMBER_ROOM * size.max() / _MAP_SIDE
    written = np.empty((0, 2))
    for number, place in enumerate(places, 1):
        if (abs(written - place) < room).all(axis=1).any():
            continue
        written = np.vstack([written, place])
        at_side = place > np.array([east, north]) - room  # right and upper: the number is on the other side
        if cloud.crs is not None and (x := left_of_arrow(place, plan.extent)) < place[0]:
            place, at_side[0] = np.array([x, place[1]]), True
        side, height = ("right" if at_side[0] else "left"), ("top" if at_side[1] else "bottom")
        axis.annotate(
            str(number), place, xytext=(-6 if at_side[0] else 6, -5 if at_side[1] else 5), textcoords="offset points",
            ha=side, va=height, fontsize=8.5, color=DARK, path_effects=paper(),
        )  # fmt: skip


def _frame(plan: PlanMap, cloud: MeasuredCloud) -> tuple[Any, Any]:
    west, east, south, north = plan.extent
    size = np.array([east - west, north - south])
    sides = np.clip(size / size.max(), 1 / _MAX_ASPECT, 1.0) * _MAP_SIDE
    figure = blank_figure((float(sides[0]) + 1.9, float(sides[1]) + 1.0))
    axis = figure.subplots()
    axis.set_facecolor("none")
    unit, is_oriented = cloud.unit or "units", cloud.crs is not None
    axis.set_xlabel(f"x{' (east)' if is_oriented else ''} [{unit}]")
    axis.set_ylabel(f"y{' (north)' if is_oriented else ''} [{unit}]")
    return figure, axis


def _finish(axis: Any, plan: PlanMap, cloud: MeasuredCloud) -> None:
    west, east, south, north = plan.extent
    axis.set(xlim=(west, east), ylim=(south, north), aspect="equal")
    axis.ticklabel_format(useOffset=False, style="plain")
    axis.tick_params(labelsize=8)
    axis.locator_params(nbins=5)
    draw_scale_bar(axis, cloud.unit or "units")
    if cloud.crs is not None:
        draw_north_arrow(axis)
