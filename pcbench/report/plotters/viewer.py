"""Interactive views of a saved report and of cloud files: candidates and maps by key, colour range, and picking."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.mesh import Mesh
from pcbench.geometry.neighbors import Index
from pcbench.io import read_cloud
from pcbench.io.meshes import holds_mesh, read_mesh
from pcbench.measure.wording import pluralize
from pcbench.report import plotters
from pcbench.report.figures import recorded_figures
from pcbench.report.inputs import SceneFolder
from pcbench.report.plot.maps import label_of
from pcbench.report.plotters.candidates import CandidateMaps
from pcbench.report.plotters.stage import Window
from pcbench.report.read import damage_in_one_line, read_report
from pcbench.scenes import read_scene

NEIGHBORS = 50
"""Number of closest points whose values are summarised for a picked point."""

_FIRST_SCALAR = "plane_distance"
_SLIDER_FACTOR = 4.0  # the slider goes from the first range divided by this to the range times this
_PICK_TOLERANCE = 0.005  # of the window's diagonal
_DIGITS = 6  # of coordinates, counted from the size of the scene
_KEYS = "N: next candidate   M: next map   right click: values of a point   Q: close"

Say = Callable[[str], None]


class ReportViewer:
    """A view of a saved report.

    The key N shows the next candidate, and M the next map. A slider sets the end of the colour range. A right click on
    a point calls `say` with its coordinates, its value and statistics of its neighbours.

    Args:
        folder: the report folder.
        say: called with the lines about a picked point.
        off_screen: whether to render without a window, for `plotter.screenshot`.

    Attributes:
        plotter: the plotter, which is not yet shown.
        name: the candidate shown.
        scalar: the map shown.
    """

    def __init__(self, folder: Path, say: Say, *, off_screen: bool) -> None:
        report, look = read_report(folder), recorded_figures(folder / "settings.json")
        with damage_in_one_line(folder):
            self._maps = CandidateMaps.of_report(report, look.range)
        self._say, self._indices = say, dict[tuple[str, str], Index]()
        self.name = next(iter(self._maps.maps))
        scalars = self._maps.maps[self.name]
        self.scalar = _FIRST_SCALAR if _FIRST_SCALAR in scalars else next(iter(scalars))
        window = Window(off_screen, background=look.background or "dark")
        self._stage = self._maps.stage(self.name, self.scalar, window)
        self.plotter: Any = self._stage.plotter
        self._scale = self._maps.show(self._stage, self.name, self.scalar)
        self._has_window = not off_screen
        if self._has_window:
            self._add_controls()

    def next_candidate(self) -> None:
        """Show the next candidate, with the same map if it has that one."""
        self.name = _after(self.name, list(self._maps.maps))
        if self.scalar not in self._maps.maps[self.name]:
            self.scalar = next(iter(self._maps.maps[self.name]))
        self._show()

    def next_map(self) -> None:
        """Show the next map of the candidate."""
        self.scalar = _after(self.scalar, list(self._maps.maps[self.name]))
        self._show()

    def set_range(self, end: float) -> None:
        """Set the end of the colour range; that of signed values starts at minus this."""
        low = -end if self._scale.signed else 0.0
        mapper = self.plotter.actors["values"].mapper
        mapper.lookup_table.scalar_range = mapper.scalar_range = (low, end)
        self.plotter.render()

    def describe(self, row: int) -> str:
        """Return lines about a point of the map: coordinates, value, and statistics of its neighbours.

        Args:
            row: row of the point in the map.
        """
        shown, unit = self._maps.of(self.name, self.scalar), self._unit
        key = self.name, self.scalar
        if key not in self._indices:
            self._indices[key] = Index(shown.points)
        found = self._indices[key].query(shown.points[[row]], k=min(NEIGHBORS, len(shown.points)))
        values, radius = shown.values[np.ravel(found.indices)], float(np.max(found.distances))
        return "\n".join(
            [
                f"{self.name}, point at {_coordinates(shown.points[row], self._digits)}{unit}",
                f"  {label_of(self.scalar)}: {shown.values[row]:.4g}{unit}",
                f"  {pluralize(len(values), 'closest point')}, within {radius:.3g}{unit}: mean {values.mean():.4g},"
                f" std {values.std():.3g}{unit}, from {values.min():.4g} to {values.max():.4g}{unit}",
            ]
        )

    @property
    def _unit(self) -> str:
        return f" {self._maps.unit}" if self._maps.unit else ""

    @property
    def _digits(self) -> int:
        return _decimals(self._maps.frame.box.high - self._maps.frame.box.low)

    def _show(self) -> None:
        self._scale = self._maps.show(self._stage, self.name, self.scalar)
        if self._has_window:
            self._add_slider()
        self.plotter.render()

    def _add_controls(self) -> None:
        self.plotter.add_key_event("n", self.next_candidate)
        self.plotter.add_key_event("m", self.next_map)
        self._add_slider()
        enable_picking(self.plotter, lambda row: self._say(self.describe(row)))
        add_hint(self.plotter, _KEYS, self._stage.ink)

    def _add_slider(self) -> None:
        """Add the slider for the current map, in place of an earlier one."""
        self.plotter.clear_slider_widgets()
        end = self._scale.high
        self.plotter.add_slider_widget(
            self.set_range,
            (end / _SLIDER_FACTOR, end * _SLIDER_FACTOR),
            value=end,
            title=f"colour range ends at [{self._stage.unit}]",
            pointa=(0.77, 0.08),
            pointb=(0.97, 0.08),
            color=self._stage.ink,
            title_height=0.016,
            fmt="%.3g",
            interaction_event="always",
            style="modern",
        )


def view_file(path: Path, say: Say, warn: Say, *, scene: SceneFolder | None = None, off_screen: bool) -> Any:
    """Return a plotter of a cloud or a mesh; a right click on a point of a cloud says its coordinates and attributes.

    Args:
        path: the file.
        say: called with the lines about a picked point.
        warn: called with the warnings of the readers.
        scene: a scene with cameras in the file's coordinates, which select the view.
        off_screen: whether to render without a window.
    """
    shown: Cloud | Mesh = read_mesh(path, on_warning=warn) if holds_mesh(path) else read_cloud(path, on_warning=warn)
    given = None if scene is None else read_scene(scene.path, cameras=scene.cameras, on_warning=warn)
    plotter = plotters.cloud(shown, scene=given, off_screen=off_screen)
    if isinstance(shown, Cloud) and not off_screen:
        enable_picking(plotter, lambda row: say(describe_point(shown, row)))
    return plotter


def describe_point(cloud: Cloud, row: int) -> str:
    """Return lines about a point of a cloud: coordinates and attributes."""
    low, high = cloud.bounds
    unit = f" {cloud.unit}" if cloud.unit else ""
    lines = [f"point {row:,} at {_coordinates(cloud.points[row], _decimals(high - low))}{unit}"]
    lines += [f"  {name}: {values[row]:.10g}" for name, values in cloud.attributes.items()]
    return "\n".join(lines)


def enable_picking(plotter: Any, picked: Callable[[int], None]) -> None:
    """Call a function with the row of each point that the user clicks on with the right mouse button."""

    def on_pick(_: Any, picker: Any) -> None:
        if picker.GetPointId() >= 0:
            picked(picker.GetPointId())

    plotter.enable_point_picking(
        on_pick, tolerance=_PICK_TOLERANCE, picker="point", show_message=False, use_picker=True, color="#ff40ff"
    )


def add_hint(plotter: Any, text: str, color: str) -> None:
    """Write the keys below the title."""
    plotter.add_text(text, position=(0.015, 0.93), viewport=True, font_size=7, color=color, name="keys")


def _after(current: str, names: Sequence[str]) -> str:
    return names[(names.index(current) + 1) % len(names)]


def _decimals(extent: FloatArray) -> int:
    """Return the decimals of coordinates, so that they resolve about a millionth of the scene's size."""
    return max(0, _DIGITS - math.ceil(math.log10(max(float(extent.max()), 1e-12))))


def _coordinates(point: FloatArray, decimals: int) -> str:
    return ", ".join(f"{value:.{decimals}f}" for value in point)
