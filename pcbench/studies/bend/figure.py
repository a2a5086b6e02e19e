"""The picture of `pcbench experiment bend`: displacement by distance, deformation by lens error, and maps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import mode
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from pcbench.extras import require
from pcbench.report.colors import ranges, robust_maximum
from pcbench.report.figures import Figures
from pcbench.report.plot import Drawer, Picture
from pcbench.report.plot.panels import save
from pcbench.scratch import atomic_write
from pcbench.studies.bend.results import KIND, BendStudy, SolutionResult, measured_bends
from pcbench.studies.frame.canvas import GREY, blank_figure, draw_profile, open_frame, plain_log_ticks

_COLORS = (
    "#000000",
    "#0072b2",
    "#d55e00",
    "#e69f00",
    "#009e73",
    "#56b4e9",
    "#cc79a7",
    "#7a5195",
    "#8c564b",
    "#999999",
    "#b5a000",
)
_MAP_COLUMNS = 6
_SMALL_BEND_SHARE = 0.1
_MAX_ZOOM_SHARE = 0.5  # of the largest displacement drawn: small deformations have a separate panel below it


# Draws the picture of an experiment's folder.
PICTURES = Drawer(f"{__name__}:pictures", (KIND.document,), KIND.schema)


def pictures(folder: Path, look: Figures) -> dict[str, Picture]:
    """Return the picture of a folder that `pcbench experiment bend` wrote."""
    study = KIND.read(folder)

    def draw(path: Path) -> bool:
        draw_bend(study, path)
        return True

    return {"bend": Picture(draw)}


def draw_bend(study: BendStudy, path: Path) -> None:
    """Draw the results of an experiment.

    It shows vertical displacement against distance with the band of noise, the deformation against the error of the
    intrinsics, and one map per solution.

    Args:
        study: results to draw.
        path: file to write; its extension is the format.

    Raises:
        MissingExtra: matplotlib is not installed.
        OSError: the file cannot be written.
    """
    require("matplotlib.figure")
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    unit = study.unit or "units"
    rows = [row for row in study.rows if row.cells]
    colors = {row.name: _COLORS[k % len(_COLORS)] for k, row in enumerate(rows)}
    map_rows = -(-len(rows) // _MAP_COLUMNS)
    figure = blank_figure((15, 5.8 + 2.7 * map_rows))
    parts: Any = figure.subfigures(2, 1, height_ratios=[5.8, max(2.7 * map_rows, 0.1)])
    upper, lower = parts
    sizes = {row.name: bend.rms or 0.0 for row, bend in measured_bends(rows)}
    small = [row for row in rows if sizes.get(row.name, 0.0) <= _SMALL_BEND_SHARE * max(sizes.values(), default=0.0)]
    has_zoom = bool(small) and _highest(small) <= _MAX_ZOOM_SHARE * _highest(rows)
    growth_axis, *zoom_axes, size_axis = upper.subplots(1, 3 if has_zoom else 2)
    _draw_growth(growth_axis, rows, colors, unit, "Displacement by distance: means over rings; shaded: noise alone")
    for axis in zoom_axes:
        _draw_growth(
            axis, small, colors, unit, f"Zoom: deformations below {100 * _SMALL_BEND_SHARE:.0f} % of the largest"
        )
    _draw_sizes(size_axis, rows, colors, unit)
    if rows:
        upper.legend(
            *growth_axis.get_legend_handles_labels(), loc="outside lower center", ncols=5, frameon=False, fontsize=8
        )
        heights = [np.array(row.cells, dtype=np.float64)[:, 3] for row in rows]
        highest = {row.name: robust_maximum(z[np.isfinite(z)]) for row, z in zip(rows, heights, strict=True)}
        # All maps share one scale, the most common range. Maps of much larger deformations saturate.
        limit = mode(scale.high for scale in ranges(highest).values())
        axes = np.atleast_1d(lower.subplots(map_rows, _MAP_COLUMNS, sharex=True, sharey=True)).ravel()
        for axis, row, z in zip(axes, rows, heights, strict=False):
            cells = np.array(row.cells, dtype=np.float64)
            order = np.argsort(np.abs(z))
            axis.scatter(*cells[order, :2].T, c=z[order], cmap="coolwarm", vmin=-limit, vmax=limit, s=26, marker="s")
            axis.set_title(row.name, fontsize=9, color=colors[row.name])
            axis.set_aspect("equal")
            axis.tick_params(labelsize=7)
            open_frame(axis)
        for axis in axes[len(rows) :]:
            axis.axis("off")
        scale = ScalarMappable(Normalize(-limit, limit), "coolwarm")
        bar = lower.colorbar(scale, ax=list(axes), extend="both", aspect=30, pad=0.01)
        bar.set_label(f"vertical displacement [{unit}]")
        lower.supxlabel(f"x [{unit}]", fontsize=9)
        lower.supylabel(f"y [{unit}]", fontsize=9)
    with TemporaryDirectory() as folder:
        picture = Path(folder) / path.name
        save(figure, picture)
        with atomic_write(path) as file:
            file.write(picture.read_bytes())


def _highest(rows: Sequence[SolutionResult]) -> float:
    """Return the end of the axis of displacements: the largest mean or noise of the solutions' rings."""
    growths = [row.truth.growth.with_distance for row in rows if row.truth is not None and row.truth.growth is not None]
    places = [place for growth in growths if growth is not None for place in growth.profile]
    return max((max(abs(place.mean), place.null) for place in places), default=0.0)


def _draw_growth(axis: Any, rows: Sequence[SolutionResult], colors: Mapping[str, str], unit: str, title: str) -> None:
    axis.axhline(0, color=GREY, linewidth=0.8)
    for row in rows:
        growth = None if row.truth is None or row.truth.growth is None else row.truth.growth.with_distance
        if growth is None:
            continue
        draw_profile(axis, growth, colors[row.name], row.name)
    axis.set_xlabel(f"horizontal distance from the centre [{unit}]")
    axis.set_ylabel(f"vertical displacement against the truth [{unit}]")
    axis.set_title(title, fontsize=10, loc="left")
    axis.grid(alpha=0.25)
    open_frame(axis)


def _draw_sizes(axis: Any, rows: Sequence[SolutionResult], colors: Mapping[str, str], unit: str) -> None:
    """Draw deformation against the error of the intrinsics with 95 % intervals; hollow markers: not significant.

    The axes are logarithmic: zeros are at their left and lower ends.
    """
    points = [
        (row.lens_error_px, bend.rms, bend.ci, bend, row)
        for row, bend in measured_bends(rows)
        if row.lens_error_px is not None and bend.rms is not None and bend.ci is not None
    ]
    min_error = 0.5 * min((error for error, *_ in points if error > 1e-3), default=0.01)
    min_rms = 0.3 * min((rms for _, rms, *_ in points if rms > 0), default=0.01)
    for error, rms, (low, high), bend, row in points:
        height = max(rms, min_rms)
        axis.errorbar(
            max(error, min_error), height, [[height - max(low, min_rms)], [high - height]],
            color=colors[row.name], marker="s" if row.factors["control"] == "True" else "o", markersize=8,
            markerfacecolor=None if bend.is_bent else "white", capsize=3,
        )  # fmt: skip
    axis.set_xscale("log")
    axis.set_yscale("log")
    plain_log_ticks(axis.xaxis)
    plain_log_ticks(axis.yaxis)
    axis.set_xlabel("lens error, RMS [px]; at the left: no error")
    axis.set_ylabel(f"deformation beyond affine, RMS [{unit}]; at the bottom: 0")
    axis.set_title("By lens error (hollow: noise; squares: control points)", fontsize=10, loc="left")
    axis.grid(alpha=0.25, which="both")
    open_frame(axis)
