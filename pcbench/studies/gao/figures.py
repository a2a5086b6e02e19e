"""Pictures of the experiment: camera rings, accuracy against completeness, and trends of displacement."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pcbench.deformation import Trend
from pcbench.geometry.arrays import FloatArray
from pcbench.report.figures import Figures
from pcbench.report.plot import Drawer, Picture
from pcbench.report.plot.panels import DPI, save
from pcbench.studies.frame.canvas import GREY, canvas, draw_profile, handles_by_label, plain_log_ticks
from pcbench.studies.gao.plan import FIELD, MEANS, MVS, SPARSE, SURFACE
from pcbench.studies.gao.results import KIND, TRUTH, GaoStudy, SceneResult, references

# Draws the pictures of an experiment's folder.
PICTURES = Drawer(f"{__name__}:pictures", (KIND.document,), KIND.schema)

_UNKNOWN_UNIT = "units of the cameras"
_CAMERAS_ALONE = "effect of solved cameras alone"
_COLORS = {
    SPARSE: "#0072b2",
    MVS: "#009e73",
    MEANS: "#d55e00",
    SURFACE: "#cc79a7",
    FIELD: "#e69f00",
    _CAMERAS_ALONE: "#444444",
}  # palette of Okabe and Ito
_MARKERS = {SPARSE: "o", MVS: "s", MEANS: "^", SURFACE: "D", FIELD: "v"}
_MIN_ELEVATION_SHARE = 0.4  # height of the elevation, as a share of its width
_CAMERA_COLOR, _FOCUS_COLOR = "#0072b2", "#d55e00"
_MARKER_AREA = 120
_IN_MARKER = {
    "xytext": (0, -0.7), "textcoords": "offset points", "ha": "center", "va": "center",
    "fontsize": 7, "fontweight": "bold", "color": "white", "zorder": 4,
}  # fmt: skip
_THIN_LINE = {"color": GREY, "alpha": 0.25, "linewidth": 0.8}


def pictures(folder: Path, look: Figures) -> dict[str, Picture]:
    """Return the pictures of a folder that `pcbench experiment gao` wrote."""
    study = KIND.read(folder)
    nothing = "no cloud was measured"
    return {
        "rings": Picture(lambda path: draw_rings(study.scenes, path)),
        "directions": Picture(lambda path: draw_directions(study, path), nothing),
        "growth": Picture(lambda path: draw_growth(study, path), nothing),
    }


def draw_rings(scenes: Sequence[SceneResult], path: Path) -> bool:
    """Draw camera positions from above and from the side, with their common focus and the measured region.

    Each scene has one row.
    """
    figure, axes = canvas(len(scenes), 2, (6.6, 4.6), dpi=DPI)
    for (above, side), scene in zip(axes, scenes, strict=True):
        positions = np.array(scene.positions)
        place = None if scene.looked_at is None else np.array(scene.looked_at)
        centre = positions.mean(axis=0) if place is None else place
        across = np.linalg.norm(positions[:, :2] - centre[:2], axis=1)
        unit = scene.unit or _UNKNOWN_UNIT
        turn = np.linspace(0, 2 * np.pi, 181)
        if place is not None:
            for radius in _ring_radii(across):
                above.plot(centre[0] + radius * np.cos(turn), centre[1] + radius * np.sin(turn), **_THIN_LINE)
            for position, out in zip(positions, across, strict=True):
                above.plot(*np.stack([position, centre])[:, :2].T, **_THIN_LINE)
                side.plot([out, 0], [position[2], centre[2]], **_THIN_LINE)
        if (measured := _parse_sphere(scene.region)) is not None:
            *middle, radius = measured
            style = {"color": _FOCUS_COLOR, "linestyle": "--", "linewidth": 1.2}
            above.plot(middle[0] + radius * np.cos(turn), middle[1] + radius * np.sin(turn), **style)
            label = f"measured: within {radius:.0f} {unit}"
            half = np.linspace(-np.pi / 2, np.pi / 2, 91)
            side.plot(radius * np.cos(half), middle[2] + radius * np.sin(half), label=label, **style)
        if place is not None:
            focus_text = ", ".join(f"{value + 0.0:.1f}".replace("-0.0", "0.0") for value in place)
            mark = {"color": _FOCUS_COLOR, "markersize": 14, "markeredgewidth": 2, "linestyle": "none"}
            above.plot(*place[:2], "+", **mark)
            side.plot(0, place[2], "+", label=f"focus: ({focus_text}) {unit}", **mark)
        above.scatter(*positions[:, :2].T, s=22, color=_CAMERA_COLOR, zorder=3)
        label = f"{len(positions)} cameras" + ("" if place is not None else ", which look at no common point")
        side.scatter(across, positions[:, 2], s=22, color=_CAMERA_COLOR, zorder=3, label=label)
        above.set(xlabel=f"x [{unit}]", ylabel=f"y [{unit}]", aspect="equal")
        origin = "middle of the cameras" if place is None else "focus"
        side.set(xlabel=f"horizontal distance from the {origin} [{unit}]", ylabel=f"height [{unit}]", aspect="equal")
        above.set_title(f"{scene.name}, from above", fontsize=11, loc="left")
        side.set_title("elevation: all cameras rotated into one half-plane", fontsize=11, loc="left")
        side.set_xlim(left=-0.03 * float(across.max() or 1.0))
        if np.ptp(side.get_ylim()) < (least := _MIN_ELEVATION_SHARE * float(across.max())):  # a level flight
            middle_height = float(np.mean(side.get_ylim()))
            side.set_ylim(middle_height - 0.5 * least, middle_height + 0.5 * least)
        side.legend(frameon=False, fontsize=9, loc="best")
    save(figure, path)
    return True


def draw_directions(study: GaoStudy, path: Path) -> bool:
    """Draw RMS distances in both directions, one panel per reference, with numbers of the scenes in the markers.

    A line connects the sparse cloud of a scene with its splats' centres and their surface.
    """
    columns = _references(study)
    if not columns:
        return False
    figure, axes = canvas(1, len(columns), (6.4, 5.0), dpi=DPI, share=True)
    unit = study.unit or _UNKNOWN_UNIT
    for axis, reference in zip(axes[0], columns, strict=True):
        for number, scene in enumerate(study.scenes, 1):
            places = {}
            for cloud in scene.clouds:
                evaluation = cloud.evaluation(reference)
                if evaluation is not None and evaluation.c2r_rms and evaluation.r2c_rms:
                    places[cloud.name] = evaluation.c2r_rms, evaluation.r2c_rms
                    look = {"color": _COLORS[cloud.name], "marker": _MARKERS[cloud.name]}
                    axis.scatter(*places[cloud.name], s=_MARKER_AREA, label=cloud.name, zorder=3, **look)
            way = [places[name] for name in (SPARSE, MEANS, SURFACE) if name in places]
            if way:
                axis.plot(*zip(*way, strict=True), **_THIN_LINE)
            for place in places.values() if len(study.scenes) > 1 else ():
                axis.annotate(str(number), place, **_IN_MARKER)
        axis.set(xscale="log", yscale="log")
        axis.set_xlabel(f"accuracy: cloud to {reference}, RMS [{unit}]")
        axis.set_ylabel(f"completeness: {reference} to cloud, RMS [{unit}]")
        axis.set_title(f"against {reference}", fontsize=11, loc="left")
        axis.grid(alpha=0.25, which="both")
        axis.margins(0.15)
        axis.tick_params(labelbottom=True, labelleft=True)
    for axis in axes.ravel():
        plain_log_ticks(axis.xaxis)
        plain_log_ticks(axis.yaxis)
    numbers = "numbers are scenes; " if len(study.scenes) > 1 else ""
    _legend(figure, axes, f"lower left is better; {numbers}lines connect sparse, splats' centres and their surface")
    save(figure, path)
    return True


def draw_growth(study: GaoStudy, path: Path) -> bool:
    """Draw vertical displacement by distance and by height against each reference, one row per scene."""
    along = {"with_distance": "distance from the centre", "with_height": "height above the lowest point"}
    columns = [(reference, which) for reference in _references(study) for which in along]
    if not columns:
        return False
    figure, axes = canvas(len(study.scenes), len(columns), (4.6, 3.6), dpi=DPI)
    drawn = False
    for line, scene in zip(axes, study.scenes, strict=True):
        unit = scene.unit or _UNKNOWN_UNIT
        for axis, (reference, which) in zip(line, columns, strict=True):
            for cloud in scene.clouds:
                evaluation = cloud.evaluation(reference)
                growth = None if evaluation is None or evaluation.deformation is None else evaluation.deformation.growth
                trend: Trend | None = None if growth is None else getattr(growth, which)
                if trend is not None:
                    draw_profile(axis, trend, _COLORS[cloud.name], cloud.name)
                    drawn = True
            if reference == TRUTH and scene.cameras is not None and scene.cameras.surface is not None:
                alone = getattr(scene.cameras.surface, which)
                axis.plot(
                    *zip(*alone, strict=True), color=_COLORS[_CAMERAS_ALONE], linestyle="--", label=_CAMERAS_ALONE
                )
            axis.axhline(0, color=GREY, linewidth=0.8)
            axis.set(xlabel=f"{along[which]} [{unit}]", ylabel=f"vertical displacement [{unit}]")
            axis.set_title(f"{scene.name}, against {reference}", fontsize=11, loc="left")
            axis.grid(alpha=0.25)
    _legend(figure, axes, "bands: 95 % range of noise alone")
    save(figure, path)
    return drawn


def _references(study: GaoStudy) -> list[str]:
    """Return the references of at least one scene."""
    return [name for name in (MVS, TRUTH) if any(name in references(scene) for scene in study.scenes)]


def _ring_radii(across: FloatArray) -> list[float]:
    """Return the radii that several cameras share; empty if cameras are not on circles."""
    radii, counts = np.unique(across.round(1), return_counts=True)
    shared = radii[counts > 1]
    return [float(radius) for radius in shared] if counts[counts > 1].sum() > 0.8 * len(across) else []


def _parse_sphere(region: str) -> list[float] | None:
    """Return centre and radius of a spherical region, else None."""
    kind, _, numbers = region.partition(":")
    return [float(word) for word in numbers.split(",")] if kind == "sphere" else None


def _legend(figure: Any, axes: Any, note: str = "") -> None:
    """Draw one legend entry per cloud, below all panels."""
    named = handles_by_label(axes.ravel())
    ordered = {name: named[name] for name in _COLORS if name in named}
    if ordered:
        title = {"title": note, "title_fontsize": 9} if note else {}
        figure.legend(ordered.values(), ordered.keys(), loc="outside lower center", ncols=5, frameon=False, **title)
