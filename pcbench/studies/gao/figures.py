"""Pictures of the experiment: camera rings, both directions against both references, and how displacements grow."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pcbench.deformation import Deformation, Trend
from pcbench.report.figures import Figures
from pcbench.report.plot import Drawer, Picture
from pcbench.report.plot.panels import DPI, save
from pcbench.studies.gao.plan import MEANS, MVS, SPARSE, SURFACE
from pcbench.studies.gao.results import TRUTH, Against, SceneResult, Study, read_study, references

# Draws the pictures of the folder of an experiment.
PICTURES = Drawer(f"{__name__}:pictures", ("gao.md",))

_COLORS = {SPARSE: "#0072b2", MVS: "#009e73", MEANS: "#d55e00", SURFACE: "#cc79a7"}  # Okabe and Ito
_SHAPES = {SPARSE: "o", MVS: "s", MEANS: "^", SURFACE: "D"}
_GREY, _CAMERA, _PLACE = "#777777", "#0072b2", "#d55e00"


def pictures(folder: Path, look: Figures) -> dict[str, Picture]:
    """The pictures of a folder that `pcbench experiment gao` wrote."""
    study = read_study(folder)
    nothing = "no cloud was measured"
    return {
        "rings": Picture(lambda path: rings(study.scenes, path)),
        "directions": Picture(lambda path: directions(study, path), nothing),
        "growth": Picture(lambda path: growth(study, path), nothing),
    }


def rings(scenes: Sequence[SceneResult], path: Path) -> bool:
    """Where cameras stand, from above and from the side, with the place that they look at; a row a scene."""
    figure, axes = _canvas(len(scenes), 2, (6.2, 4.4))
    for (above, side), scene in zip(axes, scenes, strict=True):
        positions = np.array(scene.positions)
        place = None if scene.looked_at is None else np.array(scene.looked_at)
        centre = positions.mean(axis=0) if place is None else place
        across = np.linalg.norm(positions[:, :2] - centre[:2], axis=1)
        unit = scene.unit or "units of the cameras"
        if place is not None:
            for position, out in zip(positions, across, strict=True):
                above.plot(*np.stack([position, place])[:, :2].T, color=_GREY, alpha=0.18, linewidth=0.8)
                side.plot([out, 0], [position[2], place[2]], color=_GREY, alpha=0.18, linewidth=0.8)
            text = f"looked at: ({', '.join(f'{value:.1f}' for value in place)}) {unit}"
            above.plot(*place[:2], "+", color=_PLACE, markersize=14, markeredgewidth=2)
            side.plot(0, place[2], "+", color=_PLACE, markersize=14, markeredgewidth=2, label=text, linestyle="none")
        above.scatter(*positions[:, :2].T, s=22, color=_CAMERA, zorder=3)
        side.scatter(across, positions[:, 2], s=22, color=_CAMERA, zorder=3, label=f"{len(positions)} cameras")
        above.set(xlabel=f"x [{unit}]", ylabel=f"y [{unit}]", aspect="equal")
        side.set(xlabel=f"horizontal distance from there [{unit}]", ylabel=f"height [{unit}]", aspect="equal")
        above.set_title(f"{scene.name}, from above", fontsize=11, loc="left")
        side.set_title("elevation: all turned into one half-plane", fontsize=11, loc="left")
        side.set_xlim(left=-0.03 * float(across.max() or 1.0))
        side.legend(frameon=False, fontsize=9, loc="upper left")
    save(figure, path)
    return True


def directions(study: Study, path: Path) -> bool:
    """Root mean square distances from the cloud to the reference and back, a column a scene, a row a reference."""
    rows = [name for name in (MVS, TRUTH) if any(name in references(scene) for scene in study.scenes)]
    if not rows:
        return False
    figure, axes = _canvas(len(rows), len(study.scenes), (5.0, 4.2), share=True)
    for line, reference in zip(axes, rows, strict=True):
        for axis, scene in zip(line, study.scenes, strict=True):
            for cloud in scene.clouds:
                of = cloud.held(reference)
                if of is not None and of.forth_rms and of.back_rms:
                    look = {"color": _COLORS[cloud.name], "marker": _SHAPES[cloud.name]}
                    axis.scatter(of.forth_rms, of.back_rms, s=90, label=cloud.name, zorder=3, **look)
            axis.set(xscale="log", yscale="log")
            unit = scene.unit or "unit"
            axis.set_xlabel(f"accuracy: cloud to {reference}, RMS [{unit}]")
            axis.set_ylabel(f"completeness: {reference} to cloud, RMS [{unit}]")
            axis.set_title(f"{scene.name}, against {reference}", fontsize=11, loc="left")
            axis.grid(alpha=0.25, which="both")
    _plain_ticks(axes)
    _legend(figure, axes)
    save(figure, path)
    return True


def growth(study: Study, path: Path) -> bool:
    """Vertical displacement with distance and with height, against each reference, a column a scene."""
    kinds: list[tuple[str, str, Callable[[Deformation], Trend | None]]] = []
    for reference in (MVS, TRUTH):
        if any(reference in references(scene) for scene in study.scenes):
            kinds.append((reference, "horizontal distance from the centre", lambda bend: _trend(bend, "with_distance")))
            kinds.append((reference, "height above the lowest place", lambda bend: _trend(bend, "with_height")))
    if not kinds:
        return False
    figure, axes = _canvas(len(kinds), len(study.scenes), (5.0, 3.2))
    drawn = False
    for line, (reference, along, trend_of) in zip(axes, kinds, strict=True):
        for axis, scene in zip(line, study.scenes, strict=True):
            unit = scene.unit or "unit"
            for cloud in scene.clouds:
                of: Against | None = cloud.held(reference)
                trend = None if of is None or of.deformation is None else trend_of(of.deformation)
                if trend is not None:
                    _profile(axis, trend, _COLORS[cloud.name], cloud.name)
                    drawn = True
            axis.axhline(0, color=_GREY, linewidth=0.8)
            axis.set(xlabel=f"{along} [{unit}]", ylabel=f"vertical displacement [{unit}]")
            axis.set_title(f"{scene.name}, against {reference}", fontsize=11, loc="left")
            axis.grid(alpha=0.25)
    _legend(figure, axes, "bands: what noise alone would do in 95 % of all cases")
    save(figure, path)
    return drawn


def _trend(bend: Deformation, which: str) -> Trend | None:
    trend: Trend | None = None if bend.growth is None else getattr(bend.growth, which)
    return trend


def _profile(axis: Any, trend: Trend, color: str, name: str) -> None:
    at, mean, null = (np.array([getattr(row, key) for row in trend.profile]) for key in ("at", "mean", "null"))
    axis.fill_between(at, -null, null, color=color, alpha=0.1, linewidth=0)
    axis.plot(at, mean, color=color, marker="o", markersize=3.5, linewidth=1.6, label=name)


def _canvas(rows: int, columns: int, size: tuple[float, float], *, share: bool = False) -> tuple[Any, Any]:
    """A figure and its axes (rows, columns)."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    shape = (max(2, columns) * size[0], rows * size[1] + 0.6)
    figure = Figure(figsize=shape, dpi=DPI, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(rows, columns, squeeze=False, sharex=share, sharey=share)
    for axis in axes.ravel():
        axis.spines[["top", "right"]].set_visible(False)
    return figure, axes


def _plain_ticks(axes: Any) -> None:
    """Lengths as people write them, on logarithmic axes that may hold less than a decade."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    for axis in axes.ravel():
        for scale in (axis.xaxis, axis.yaxis):
            scale.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            scale.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
            scale.set_minor_formatter(NullFormatter())


def _legend(figure: Any, axes: Any, note: str = "") -> None:
    """Each cloud once, below all panels."""
    named: dict[str, Any] = {}
    for axis in axes.ravel():
        handles, labels = axis.get_legend_handles_labels()
        named |= dict(zip(labels, handles, strict=True))
    ordered = {name: named[name] for name in _COLORS if name in named}
    if ordered:
        title = {"title": note, "title_fontsize": 9} if note else {}
        figure.legend(ordered.values(), ordered.keys(), loc="outside lower center", ncols=4, frameon=False, **title)
