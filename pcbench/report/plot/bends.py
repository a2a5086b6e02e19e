"""Pictures of a deformation: how it grows, which model explains it, where something changed, and which way it goes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from pcbench.deformation import Deformation, Growth, Trend
from pcbench.geometry.cloud import Cloud
from pcbench.report.plot.maps import framed_panels

_BLUE, _RED, _GREY = "#0072b2", "#d55e00", "#777777"  # after Okabe and Ito
_ARROW = 0.1  # of the scene: how long the 95th percentile of the arrows is drawn


def evidence(bend: Deformation, field: Cloud, title: str, unit: str, path: Path) -> bool:
    """Growth with distance and height, the models' cross-validation, and the map of local changes."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 9), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(title, fontsize=13)
    (near, high), (score, place) = figure.subplots(2, 2)
    factor, short = _readable(bend, unit)
    growth = bend.growth or Growth(None, None)
    _growth(near, growth.with_distance, "horizontal distance from the centre", unit, factor, short)
    _growth(high, growth.with_height, "height above the lowest place", unit, factor, short)
    _rungs(score, bend, factor, short)
    _changes(place, bend, field, unit, factor, short)
    for axis in (near, high, score, place):
        axis.spines[["top", "right"]].set_visible(False)
    figure.savefig(path)
    return True


def arrows(cloud: Cloud, field: Cloud, title: str, unit: str, path: Path) -> bool:
    """Displacements, exaggerated, over the aligned candidate; False where the chosen model has none."""
    import pyvista

    vectors = np.stack([np.asarray(field.attributes[f"displacement_{k}"], np.float64) for k in "xyz"], axis=1)
    lengths = np.linalg.norm(vectors, axis=1)
    low, high = np.percentile(cloud.points, [0.5, 99.5], axis=0)
    inside = ((field.points >= low - 1e-9) & (field.points <= high + 1e-9)).all(axis=1) & (lengths > 0)
    if not inside.any():
        return False
    typical = float(np.percentile(lengths[inside], 95))
    # A round factor, so that a reader can divide by it.
    wanted = _ARROW * float(np.linalg.norm(high - low)) / typical
    step = 10.0 ** np.floor(np.log10(wanted))
    exaggeration = float(step * max(m for m in (1, 2, 5) if m * step <= wanted))
    center = (low + high) / 2
    places, vectors = field.points[inside] - center, vectors[inside] * exaggeration
    # What sinks is drawn above the surface too, with its head on it: the ground would hide it.
    tails = np.where(vectors[:, 2:] < 0, places - vectors, places)
    glyphs = pyvista.PolyData(tails.astype(np.float32))
    glyphs["vectors"] = vectors.astype(np.float32)
    glyphs["length"] = np.linalg.norm(vectors, axis=1).astype(np.float32)
    glyphs["vertical"] = (vectors[:, 2] / exaggeration).astype(np.float32)
    arrow = pyvista.Arrow(tip_length=0.35, tip_radius=0.14, shaft_radius=0.05)
    drawn = glyphs.glyph(orient="vectors", scale="length", geom=arrow)
    ground = pyvista.PolyData((cloud.points[:: max(1, len(cloud) // 150_000)] - center).astype(np.float32))

    def populate(plotter: Any) -> None:
        plotter.add_mesh(ground, color="#8a9099", style="points", point_size=2.0, opacity=0.25, lighting=False)
        plotter.add_mesh(drawn, scalars="vertical", cmap="coolwarm", clim=(-typical, typical), show_scalar_bar=False)

    half = (high - low) / 2 + np.percentile(np.abs(vectors), 99, axis=0)
    title = f"{title}; displacements {exaggeration:g} times as long as they are"
    framed_panels(populate, half, title, path, (-typical, typical), f"vertical part of the displacement [{unit}]")
    return True


def _readable(bend: Deformation, unit: str) -> tuple[float, str]:
    """Factor and name of the unit for small displacements: millimetres where metres are known."""
    return (1000.0, "mm") if unit == "m" and (bend.remaining_rms or 1.0) < 0.5 else (1.0, unit)


def _growth(axis: Any, trend: Trend | None, along: str, unit: str, factor: float, short: str) -> None:
    axis.set_xlabel(f"{along} [{unit}]")
    axis.set_ylabel(f"vertical displacement [{short}]")
    axis.axhline(0, color=_GREY, linewidth=0.8)
    if trend is None:
        axis.text(0.5, 0.5, "not enough surface to tell", transform=axis.transAxes, ha="center", color=_GREY)
        return
    x = np.array([row.at for row in trend.profile])
    mean = factor * np.array([row.mean for row in trend.profile])
    low, high = factor * np.array([row.ci for row in trend.profile]).T
    null = factor * np.array([row.null for row in trend.profile])
    axis.fill_between(x, -null, null, color=_GREY, alpha=0.3, linewidth=0, label="noise alone (95 %)")
    axis.fill_between(x, low, high, color=_BLUE, alpha=0.25, linewidth=0, label="95 % over blocks")
    axis.plot(x, mean, color=_BLUE, marker="o", markersize=4, linewidth=1.6, label="mean of the candidate")
    bounds = trend.ci
    scale = 1000.0  # per 1000 units: mm per m, or thousandths
    text = f"slope {scale * trend.slope:.3g} [{scale * bounds[0]:.3g}, {scale * bounds[1]:.3g}] ‰"
    axis.set_title(text, fontsize=10, loc="left")
    axis.legend(framealpha=0.9, edgecolor="none", fontsize=9)
    axis.grid(alpha=0.25)


def _rungs(axis: Any, bend: Deformation, factor: float, short: str) -> None:
    score = np.sqrt([rung.cv_score for rung in bend.rungs])
    error = np.array([rung.cv_se for rung in bend.rungs]) / np.maximum(2 * score, 1e-300)
    place = np.arange(len(bend.rungs))
    axis.errorbar(place, factor * score, factor * error, color=_BLUE, marker="o", capsize=4, linewidth=1.4)
    chosen = [rung.model for rung in bend.rungs].index(bend.model)
    axis.plot(
        chosen, factor * score[chosen], "o", color=_RED, markersize=11, fillstyle="none", markeredgewidth=2,
        label="chosen",
    )  # fmt: skip
    axis.set_xticks(place, [f"{rung.model}\n{rung.parameters}" for rung in bend.rungs])
    axis.set_xlabel("model, parameters")
    axis.set_ylabel(f"residual of tiles left out, RMS [{short}]")
    axis.set_title("cross-validation, ± standard error", fontsize=10, loc="left")
    axis.legend(framealpha=0.9, edgecolor="none", fontsize=9)
    axis.grid(alpha=0.25)


def _changes(axis: Any, bend: Deformation, field: Cloud, unit: str, factor: float, short: str) -> None:
    tested = np.asarray(field.attributes["pairs"]) >= 20
    if not tested.any():
        return
    field = field.select(tested)
    local = factor * np.asarray(field.attributes["local"], np.float64)
    changed = np.asarray(field.attributes["changed"]) > 0
    x, y = (field.points[:, :2] - np.floor(field.points[:, :2].min(axis=0))).T
    order = np.argsort(local)
    limit = float(np.percentile(local, 98)) or 1.0
    dots = axis.scatter(x[order], y[order], c=local[order], s=26, marker="s", cmap="Greys", vmin=0, vmax=limit)
    axis.scatter(x[changed], y[changed], s=80, marker="s", facecolors="none", edgecolors=_RED, linewidths=1.8)
    axis.figure.colorbar(dots, ax=axis, label=f"left by the largest model [{short}]", shrink=0.9)
    axis.set_aspect("equal")
    axis.set_xlabel(f"x [{unit}]")
    axis.set_ylabel(f"y [{unit}]")
    if bend.local is None:
        return
    axis.set_title(
        f"local changes: {bend.local.tiles_changed} of {bend.local.tiles_tested} tiles (red, FDR {bend.local.fdr:.0%})",
        fontsize=10,
        loc="left",
    )
