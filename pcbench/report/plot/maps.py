"""Deviation maps: every cloud from the same three viewpoints, with one colour scale for all candidates."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import wrap
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cloud import Cloud
from pcbench.report.colors import color_limit

LABELS = {
    "distance": "distance to the nearest reference point",
    "plane_distance": "signed distance to the reference's tangent plane",
    "mesh_distance": "distance to the reference mesh",
    "poisson_distance": "distance to the reference's Poisson mesh",
    "m3c2_distance": "M3C2 distance along the reference's normal",
}
_GROUND = (0.11, 0.12, 0.14)  # dark: the light middle of a diverging map stays visible
_INK = "#e8e8e6"
_PANEL = (900, 760)  # pixels
_SEQUENTIAL, _DIVERGING = "turbo", "coolwarm"


@dataclass(frozen=True)
class View:
    """A parallel camera: where it stands as a direction from the centre, and what is up."""

    title: str
    direction: tuple[float, float, float]
    up: tuple[float, float, float]


VIEWS = (
    View("from above", (0, 0, 1), (0, 1, 0)),
    View("from the south-west", (-1, -1, 1.1), (0, 0, 1)),
    View("from the north-east", (1, 1, 1.1), (0, 0, 1)),
)


@dataclass(frozen=True)
class Limits:
    """Of the colour scale; signed scales are symmetric about zero."""

    low: float
    high: float

    @property
    def signed(self) -> bool:
        return self.low < 0


def limits(values: Sequence[FloatArray]) -> Limits:
    """Common limits of all candidates: the largest of their 95th percentiles of |value|; strays do not decide."""
    high = color_limit(values)
    signed = any(bool((v < 0).any()) for v in values)
    return Limits(-high if signed else 0.0, high)


def deviation(clouds: Mapping[str, Cloud], name: str, scalar: str, scale: Limits, label: str, path: Path) -> bool:
    """One candidate coloured by one of its scalars."""
    cloud = clouds[name]
    values = np.asarray(cloud.attributes[scalar], dtype=np.float64)
    known = np.isfinite(values)
    points, values = cloud.points[known], values[known]
    # Large deviations are drawn last, on top: they are what one looks for.
    order = np.argsort(np.abs(values), kind="stable")
    images = _render(points[order], values[order], frame(clouds.values()), scale=scale)
    noun = "core points" if scalar.startswith("m3c2") else "points"
    _compose(images, f"{name} ({len(cloud):,} {noun})", path, scale=scale, label=label)
    return True


def reference(cloud: Cloud | None, clouds: Mapping[str, Cloud], path: Path) -> bool:
    """The reference in its own colours, or by height; False where its file has gone."""
    if cloud is None:
        return False
    box = frame(clouds.values())
    flat = 0.05 * (box[1] - box[0])[:2]  # a little beyond the candidates, but not out of the picture
    shown = ((cloud.points[:, :2] >= box[0][:2] - flat) & (cloud.points[:, :2] <= box[1][:2] + flat)).all(axis=1)
    total, cloud = len(cloud), cloud.select(np.flatnonzero(shown)) if shown.any() else cloud
    colors = cloud.colors
    images = _render(cloud.points, cloud.points[:, 2] if colors is None else colors, box, scale=None)
    note = "" if colors is not None else ", coloured by height"
    _compose(images, f"reference ({total:,} points{note})", path)
    return True


def frame(clouds: Any) -> tuple[FloatArray, FloatArray]:
    """Corners of the box that all pictures show: the inner 99 % of every candidate along each axis."""
    boxes = [np.percentile(cloud.points, [0.5, 99.5], axis=0) for cloud in clouds]
    return np.min([box[0] for box in boxes], axis=0), np.max([box[1] for box in boxes], axis=0)


def framed_panels(
    populate: Callable[[Any], None],
    half: FloatArray,
    title: str,
    path: Path,
    ends: tuple[float, float],
    label: str,
) -> None:
    """What `populate` adds to a plotter about the origin, within a box of half extents (3,), from all viewpoints."""
    import pyvista

    plotter = pyvista.Plotter(off_screen=True, window_size=list(_PANEL))
    plotter.set_background(_GROUND)
    populate(plotter)
    _compose(_shoot(plotter, half), title, path, scale=Limits(*ends), label=label)


def _render(
    points: FloatArray, colors: NDArray[Any], box: tuple[FloatArray, FloatArray], *, scale: Limits | None
) -> list[NDArray[np.uint8]]:
    import pyvista

    center = (box[0] + box[1]) / 2
    # VTK draws in float32: what it gets has to be small.
    data = pyvista.PolyData((points - center).astype(np.float32))
    data["colors"] = colors
    plotter = pyvista.Plotter(off_screen=True, window_size=list(_PANEL))
    plotter.set_background(_GROUND)
    size = float(np.clip(1.3 * np.sqrt(_PANEL[0] * _PANEL[1] / len(points)), 2.0 if scale else 3.0, 9.0))
    options: dict[str, Any] = {"rgb": True} if colors.ndim == 2 else {"cmap": _SEQUENTIAL, "show_scalar_bar": False}
    if scale is not None:
        options |= {"cmap": _DIVERGING if scale.signed else _SEQUENTIAL, "clim": (scale.low, scale.high)}
    plotter.add_mesh(data, scalars="colors", style="points", point_size=size, lighting=False, **options)
    # Shading by depth shows shapes, but it darkens colours, and single points altogether: no map may have it.
    if scale is None and len(points) > 200_000:
        plotter.enable_eye_dome_lighting()
    return _shoot(plotter, (box[1] - box[0]) / 2)


def _shoot(plotter: Any, half: FloatArray) -> list[NDArray[np.uint8]]:
    """The scene about the origin from all viewpoints; closes the plotter."""
    plotter.enable_parallel_projection()
    images = []
    for view in VIEWS:
        toward = np.array(view.direction) / np.linalg.norm(view.direction)
        right = np.cross(view.up, toward)
        right /= np.linalg.norm(right)
        above = np.cross(toward, right)
        # The box's half extents seen along the picture's axes: the whole box fits, with a margin.
        wide, high = float(np.abs(right) @ half), float(np.abs(above) @ half)
        plotter.camera.position = tuple(toward * 4 * float(np.linalg.norm(half)))
        plotter.camera.focal_point = (0, 0, 0)
        plotter.camera.up = view.up
        plotter.camera.parallel_scale = 1.1 * max(high, wide * _PANEL[1] / _PANEL[0], 1e-12)
        plotter.renderer.ResetCameraClippingRange()
        plotter.render()
        images.append(np.asarray(plotter.screenshot(return_img=True)))
    plotter.close()
    return images


def _compose(
    images: list[NDArray[np.uint8]], title: str, path: Path, *, scale: Limits | None = None, label: str = ""
) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    layout = ConstrainedLayoutEngine(w_pad=0.02, h_pad=0.04, wspace=0.01)
    figure = Figure(figsize=(15, 5.0), dpi=120, facecolor=_GROUND, layout=layout)
    FigureCanvasAgg(figure)
    figure.suptitle(title, color=_INK, fontsize=14)
    axes = figure.subplots(1, len(images))
    for axis, image, view in zip(axes, images, VIEWS, strict=True):
        axis.imshow(image)
        axis.set_title(view.title, color=_INK, fontsize=11)
        axis.axis("off")
    if scale is not None:
        colors = ScalarMappable(Normalize(scale.low, scale.high), _DIVERGING if scale.signed else _SEQUENTIAL)
        extend = "both" if scale.signed else "max"
        bar = figure.colorbar(colors, ax=axes, extend=extend, shrink=0.85, aspect=25, pad=0.01)
        bar.set_label("\n".join(wrap(label, 44)), color=_INK, fontsize=11)
        bar.ax.tick_params(colors=_INK)
        bar.outline.set_edgecolor(_INK)
    figure.savefig(path, facecolor=_GROUND)
