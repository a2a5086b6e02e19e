"""Pictures of a deformation: growth, cross-validation of models, local changes, and displacement arrows."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.deformation import Deformation, Growth, Trend
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cloud import Cloud
from pcbench.report.colors import BLUE, VERMILION, Range
from pcbench.report.figures import ink, rgb
from pcbench.report.plot.maps import Framing
from pcbench.report.plot.panels import compose, new_figure, save
from pcbench.report.plot.rounding import axis_title, round_length, round_origin
from pcbench.report.plot.splats import splat
from pcbench.report.plot.views import AxisBox, Viewpoint
from pcbench.report.words import interval_text, printable

_GREY = "#777777"
_MIN_CONTRAST_SHARE = 0.12  # of the contrast, for a tile without a residual
_ARROW_SHARE = 0.07  # length of the arrow at the 95th percentile, as a share of the scene's size


def evidence(
    deformation: Deformation, field: Cloud, title: str, framing: Framing, path: Path, axes: tuple[str, str] = ("x", "y")
) -> bool:
    """Draw growth with distance and height, cross-validation and local changes, as far as they exist.

    Args:
        deformation: the verdict.
        field: the cells with their displacements.
        title: title of the picture.
        framing: unit and appearance of the picture.
        path: the file to write.
        axes: names of the horizontal axes.

    Returns:
        Whether there was anything to draw.
    """
    unit = framing.unit
    displayed = _DisplayUnit.of(deformation, unit)
    growth = deformation.growth or Growth(None, None)
    panels: list[Callable[[Any], None]] = []
    for trend, along in (
        (growth.with_distance, "horizontal distance from the centre"),
        (growth.with_height, "height above the lowest cell"),
    ):
        if trend is not None and len(trend.profile) > 1:
            panels.append(partial(_growth, trend=trend, label=f"{along} [{unit}]", displayed=displayed))
    growth_panels = len(panels)
    if deformation.rungs:
        panels.append(partial(_cross_validation, deformation=deformation, displayed=displayed))
    tested = np.isfinite(np.asarray(field.attributes["local"], np.float64))
    if tested.any():
        cells, ground = field.select(tested), framing.look.ground("white")
        panels.append(partial(_changes, deformation=deformation, field=cells, unit=unit, displayed=displayed,
                              ground=ground, names=axes))  # fmt: skip
    if not panels:
        return False
    columns = min(len(panels), 2)
    rows = -(-len(panels) // columns)
    width, height = 6.8 * columns, 0.9 + 4.2 * rows
    figure = new_figure(width, height, dpi=110)
    figure.suptitle(printable(title), fontsize=13, y=1 - 0.22 / height, va="center")
    figure.subplots_adjust(left=1.02 / width, right=1 - 0.3 / width, top=1 - 0.75 / height,
                           bottom=(1.0 if growth_panels else 0.65) / height, hspace=0.28, wspace=0.22)  # fmt: skip
    plots = [figure.add_subplot(rows, columns, number + 1) for number in range(len(panels))]
    for axis, panel in zip(plots, panels, strict=True):
        panel(axis)
        axis.spines[["top", "right"]].set_visible(False)
    if growth_panels:
        handles = plots[0].get_legend_handles_labels()
        figure.legend(*handles, loc="lower center", bbox_to_anchor=(0.5, 0.02 / height), ncols=3, frameon=False)
    save(figure, path)
    return True


def arrows(cloud: Cloud, field: Cloud, title: str, framing: Framing, path: Path) -> bool:
    """Draw exaggerated displacements over the aligned candidate.

    Args:
        cloud: the aligned candidate.
        field: the cells with their displacements.
        title: title of the picture.
        framing: frame, unit and appearance of the picture.
        path: the file to write.

    Returns:
        Whether the chosen model has displacements.
    """
    frame, unit, look = framing
    vectors = displacement_vectors(field)
    lengths = np.linalg.norm(vectors, axis=1)
    inside = frame.box.holds(field.points) & (lengths > 0)
    if not inside.any():
        return False
    typical = float(np.percentile(lengths[inside], 95))
    exaggeration = round_exaggeration(typical, frame.box)
    vectors = vectors[inside]
    tails = field.points[inside] - frame.box.center
    scale = Range(-typical, typical, "blue: below the reference, red: above it", signed=True)
    colors = scale.colors(vectors[:, 2]) / 255
    ground = rgb(look.ground("dark"))
    # The cloud is only background for the arrows: between the background colour and a middle grey.
    faint = np.broadcast_to(np.rint(0.7 * ground + 0.3 * 138).astype(np.uint8), cloud.points.shape)
    centered = cloud.points - frame.box.center

    def image(view: Viewpoint, window: FloatArray, pixels: tuple[int, int]) -> NDArray[np.uint8]:
        return splat(centered, faint, view, window, pixels, ground)

    def over(axis: Any, view: Viewpoint, placed: Callable[[FloatArray], FloatArray], factor: float) -> None:
        flat = view.axes[:2].T
        (x, y), (u, v) = placed(tails @ flat).T, exaggeration * factor * (vectors @ flat).T
        # A visible shaft with a distinct head.
        style = {"units": "inches", "width": 0.016, "headwidth": 4, "headlength": 5, "headaxislength": 4.5}
        axis.scatter(x, y, s=14, c=colors, linewidths=0)  # an arrow towards the viewer has no length
        axis.quiver(x, y, u, v, color=colors, angles="xy", scale_units="xy", scale=1, minlength=0, **style)

    title = f"{title}; displacements exaggerated {exaggeration:g} times"
    label = f"vertical displacement [{unit}]"
    compose(image, frame, title, unit, path, look, scale=scale, label=label, over=over)
    return True


def round_exaggeration(typical: float, box: AxisBox) -> float:
    """Return the factor for displacements of a typical length, round so that readers can easily divide by it."""
    return round_length(_ARROW_SHARE * float(np.linalg.norm(box.high - box.low)) / typical)


def displacement_vectors(field: Cloud) -> FloatArray:
    """Return the displacements (N, 3) of the cells in a report's NAME_deformation.ply.

    Raises:
        KeyError: the file lacks an attribute.
    """
    return np.stack([np.asarray(field.attributes[f"displacement_{axis}"], np.float64) for axis in "xyz"], axis=1)


class _DisplayUnit(NamedTuple):
    """The unit of displacements in a picture: its name, and the factor from the clouds' unit."""

    factor: float
    name: str

    @classmethod
    def of(cls, deformation: Deformation, unit: str) -> _DisplayUnit:
        """Return the clouds' unit, or millimetres for small displacements in metres."""
        is_small = unit == "m" and (deformation.remaining_rms or 1.0) < 0.5
        return cls(1000.0, "mm") if is_small else cls(1.0, unit)


def _growth(axis: Any, trend: Trend, label: str, displayed: _DisplayUnit) -> None:
    axis.set_xlabel(label)
    axis.set_ylabel(f"vertical displacement [{displayed.name}]")
    axis.axhline(0, color=_GREY, linewidth=0.8)
    x = np.array([row.at for row in trend.profile])
    mean = displayed.factor * np.array([row.mean for row in trend.profile])
    low, high = displayed.factor * np.array([row.ci for row in trend.profile]).T
    null = displayed.factor * np.array([row.null for row in trend.profile])
    axis.fill_between(x, -null, null, color=_GREY, alpha=0.3, linewidth=0, label="noise alone (95 %)")
    axis.fill_between(x, low, high, color=BLUE, alpha=0.25, linewidth=0, label="95 % interval")
    axis.plot(x, mean, color=BLUE, marker="o", markersize=4, linewidth=1.6, label="mean of the candidate")
    interval = interval_text(1000.0 * np.array(trend.ci))  # in thousandths: mm per m
    text = f"slope {1000.0 * trend.slope:.3g} {interval} ‰"
    axis.set_title(text, fontsize=10, loc="left")
    axis.grid(alpha=0.25)


def _cross_validation(axis: Any, deformation: Deformation, displayed: _DisplayUnit) -> None:
    rungs, factor = deformation.rungs, displayed.factor
    score = np.sqrt([row.cv_score for row in rungs])
    error = np.array([row.cv_se for row in rungs]) / np.maximum(2 * score, 1e-300)
    position = np.arange(len(rungs))
    axis.errorbar(position, factor * score, factor * error, color=BLUE, marker="o", capsize=4, linewidth=1.4)
    chosen = [row.model for row in rungs].index(deformation.model)
    axis.plot(chosen, factor * score[chosen], "o", color=VERMILION, markersize=11, fillstyle="none", markeredgewidth=2)
    axis.set_xticks(position, [f"{row.model}\n{row.parameters}" for row in rungs])
    axis.set_xlabel("model, parameters")
    axis.set_ylabel(f"residual of held-out tiles, RMS [{displayed.name}]")
    axis.set_title("cross-validation, ± standard error; the chosen model is circled", fontsize=10, loc="left")
    axis.grid(alpha=0.25)


def _changes(
    axis: Any,
    deformation: Deformation,
    field: Cloud,
    unit: str,
    displayed: _DisplayUnit,
    ground: str,
    names: tuple[str, str],
) -> None:
    from matplotlib.colors import LinearSegmentedColormap, to_rgb

    local = displayed.factor * np.asarray(field.attributes["local"], np.float64)
    changed = np.asarray(field.attributes["changed"]) > 0
    origin = round_origin(field.points[:, :2].min(axis=0), field.points[:, :2].max(axis=0))
    x, y = (field.points[:, :2] - origin).T
    order = np.argsort(local)
    limit = float(np.percentile(local, 98)) or 1.0
    background, foreground = (np.array(to_rgb(color)) for color in (ground, ink(ground)))
    # All tiles are visible on the background, and the largest residuals have the highest contrast.
    faintest = background + _MIN_CONTRAST_SHARE * (foreground - background)
    cmap = LinearSegmentedColormap.from_list("changes", [faintest, foreground])
    dots = axis.scatter(x[order], y[order], c=local[order], s=26, marker="s", cmap=cmap, vmin=0, vmax=limit)
    axis.scatter(x[changed], y[changed], s=80, marker="s", facecolors="none", edgecolors=VERMILION, linewidths=1.8)
    axis.figure.colorbar(dots, ax=axis, label=f"residual of the largest model [{displayed.name}]", shrink=0.9)
    axis.set_aspect("equal")
    axis.set_xlabel(axis_title(names[0], origin[0], unit))
    axis.set_ylabel(axis_title(names[1], origin[1], unit))
    if (changes := deformation.local) is None:
        return
    axis.set_title(
        f"tiles off the model: {changes.tiles_changed} of {changes.tiles_tested} (orange; false discovery rate"
        f" {100 * changes.fdr:g} %)",
        fontsize=10,
        loc="left",
    )
