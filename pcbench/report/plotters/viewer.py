"""Interactive views of a saved report, a folder of `pcbench deform` and cloud files: keys, sliders, and picking."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pcbench.errors import InputError
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.crs import check_lengths
from pcbench.geometry.neighbors import Index
from pcbench.io import read_cloud
from pcbench.io.source import Source
from pcbench.measure.wording import pluralize, with_unit
from pcbench.report import plotters
from pcbench.report.figures import recorded_figures
from pcbench.report.plot.maps import frame
from pcbench.report.plotters.candidates import CandidateMaps
from pcbench.report.plotters.controls import add_exaggeration, add_hint, add_slider, enable_picking
from pcbench.report.plotters.displacements import Displacements
from pcbench.report.plotters.stage import Stage, Window
from pcbench.report.read import damage_in_one_line, read_deformation, read_report
from pcbench.report.scalars import scalar_of
from pcbench.report.viewing import SceneFolder, viewing_cameras
from pcbench.scenes import read_scene

NO_DISPLACEMENTS = "no deformation was found, so there are no displacements"

NEIGHBORS = 50
"""Number of closest points whose values are summarised for a picked point."""

_FIRST_SCALAR = "plane_distance"
_SLIDER_FACTOR = 4.0  # the slider goes from the first range divided by this to the range times this
_DIGITS = 6  # of coordinates, counted from the size of the scene
_KEYS = "N: next candidate   M: next map   D: displacements   L: lighting   right click: values of a point   Q: close"

Say = Callable[[str], None]


class ReportViewer:
    """A view of a saved report.

    The key N shows the next candidate, M the next map, D its displacements as arrows, and L switches the lighting. A
    slider sets the end of the colour range, or the exaggeration of the arrows. A right click on a point of a map calls
    `say` with its coordinates, its value and statistics of its neighbours.

    Args:
        folder: the report folder.
        say: called with the lines about a picked point.
        off_screen: whether to render without a window, for `plotter.screenshot`.

    Attributes:
        plotter: the plotter, which is not yet shown.
        name: the candidate shown.
        scalar: the map shown, or shown before the displacements.
        shows_displacements: whether displacements are shown instead of the map.
    """

    def __init__(self, folder: Path, say: Say, *, off_screen: bool) -> None:
        report, look = read_report(folder), recorded_figures(folder / "settings.json")
        with damage_in_one_line(folder):
            self._maps = CandidateMaps.of_report(report, look.range)
            self._displacements = {
                candidate.name: Displacements.of_field(candidate.name, candidate.deviation.points, candidate.field)
                for candidate in report.candidates
            }
        self._say, self._indices = say, dict[tuple[str, str], Index]()
        self.name, self.shows_displacements = next(iter(self._maps.maps)), False
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
        """Show the next candidate, with the same map if it has that one, or its displacements if it has some."""
        self.name = _after(self.name, list(self._maps.maps))
        if self.scalar not in self._maps.maps[self.name]:
            self.scalar = next(iter(self._maps.maps[self.name]))
        self.shows_displacements &= self._displacements[self.name] is not None
        self._show()

    def next_map(self) -> None:
        """Show the next map of the candidate."""
        self.scalar, self.shows_displacements = _after(self.scalar, list(self._maps.maps[self.name])), False
        self._show()

    def switch_displacements(self) -> None:
        """Show the candidate's displacements instead of its map, or the map again; say so if there are none."""
        if self._displacements[self.name] is None:
            self._say(f"{self.name}: {NO_DISPLACEMENTS}")
            return
        self.shows_displacements = not self.shows_displacements
        self._show()

    def switch_lighting(self) -> None:
        """Switch the lighting of the points off or on."""
        assert self._stage.lighting is not None
        self._stage.lighting.enabled = not self._stage.lighting.enabled
        self.plotter.render()

    def set_range(self, end: float) -> None:
        """Set the end of the colour range; that of signed values starts at minus this."""
        low = -end if self._scale.signed else 0.0
        mapper = self.plotter.actors["values"].mapper
        mapper.lookup_table.scalar_range = mapper.scalar_range = (low, end)
        self.plotter.render()

    def set_exaggeration(self, factor: float) -> None:
        """Set the exaggeration of the displacements."""
        shown = self._displacements[self.name]
        assert shown is not None
        shown.show(self._stage, factor)
        self.plotter.render()

    def describe(self, row: int) -> str:
        """Return lines about a point of the map: coordinates, value, and statistics of its neighbours.

        Args:
            row: row of the point in the map.
        """
        shown, unit = self._maps.of(self.name, self.scalar), self._maps.unit
        key = self.name, self.scalar
        if key not in self._indices:
            self._indices[key] = Index(shown.points)
        closest = self._indices[key].query(shown.points[[row]], k=min(NEIGHBORS, len(shown.points)))
        values, radius = shown.values[np.ravel(closest.indices)], float(np.max(closest.distances))
        place = with_unit(_coordinates(shown.points[row], self._digits), unit)
        value, reach = (with_unit(text, unit) for text in (f"{shown.values[row]:.4g}", f"{radius:.3g}"))
        deviation, highest = (with_unit(text, unit) for text in (f"{values.std():.3g}", f"{values.max():.4g}"))
        return "\n".join(
            [
                f"{self.name}, point at {place}",
                f"  {scalar_of(self.scalar).label}: {value}",
                f"  {pluralize(len(values), 'closest point')}, within {reach}: mean {values.mean():.4g},"
                f" std {deviation}, from {values.min():.4g} to {highest}",
            ]
        )

    @property
    def _arrows(self) -> Displacements | None:
        """The displacements, if they are shown."""
        return self._displacements[self.name] if self.shows_displacements else None

    @property
    def _digits(self) -> int:
        return _decimals(self._maps.frame.box.high - self._maps.frame.box.low)

    def _show(self) -> None:
        self.plotter.remove_actor("arrows" if self._arrows is None else "values", reset_camera=False, render=False)
        if self._arrows is None:
            self._scale = self._maps.show(self._stage, self.name, self.scalar)
        else:
            self._arrows.show(self._stage)
        if self._has_window:
            self._add_slider()
        self.plotter.render()

    def _add_controls(self) -> None:
        keys = {"n": self.next_candidate, "m": self.next_map, "d": self.switch_displacements, "l": self.switch_lighting}
        for key, action in keys.items():
            self.plotter.add_key_event(key, action)
        self._add_slider()
        enable_picking(self.plotter, self._pick)
        add_hint(self._stage, _KEYS)

    def _pick(self, row: int) -> None:
        if not self.shows_displacements:
            self._say(self.describe(row))

    def _add_slider(self) -> None:
        """Add the slider for the current map or displacements, in place of an earlier one."""
        if self._arrows is not None:
            add_exaggeration(self._stage, self._arrows, self.set_exaggeration)
            return
        end, title = self._scale.high, f"colour range ends at [{self._stage.unit}]"
        add_slider(self._stage, title, (end / _SLIDER_FACTOR, end * _SLIDER_FACTOR), end, self.set_range)


def view_deformation(folder: Path, warn: Say, *, scene: SceneFolder | None = None, off_screen: bool) -> Any:
    """Return a plotter of the displacements in a folder of `pcbench deform`, with a slider for their exaggeration.

    Args:
        folder: the folder.
        warn: called with the warnings of the scene's reader.
        scene: a scene with cameras in the reference's coordinates, which select the view.
        off_screen: whether to render without a window.

    Raises:
        InputError: a file is damaged, no deformation was found, or the scene cannot be used.
    """
    verdict, look = read_deformation(folder), recorded_figures(folder / "settings.json")
    with damage_in_one_line(folder):
        field = folder / "deformation.ply"
        cloud = read_cloud(folder / "aligned.ply", on_warning=lambda _: None)
        places = read_cloud(field, on_warning=lambda _: None) if field.is_file() else None
        arrows = Displacements.of_field(f"candidate, {verdict.model} model", cloud.points, places)
    if arrows is None:
        cloud_file = folder / "aligned.ply"
        raise InputError(f"{folder}: {NO_DISPLACEMENTS}; `pcbench view {cloud_file}` shows the cloud")
    cameras = None if scene is None else viewing_cameras(scene, cloud, warn)
    window = Window(off_screen, background=look.background or "dark")
    stage = Stage(frame(None, {"": cloud}, cameras), cloud.unit, window)
    arrows.show(stage)
    if not off_screen:

        def set_exaggeration(factor: float) -> None:
            arrows.show(stage, factor)
            stage.plotter.render()

        add_exaggeration(stage, arrows, set_exaggeration)
    return stage.plotter


def view_file(path: Path, say: Say, warn: Say, *, scene: SceneFolder | None = None, off_screen: bool) -> Any:
    """Return a plotter of a cloud or a mesh; a right click on a point of a cloud says its coordinates and attributes.

    Args:
        path: the file.
        say: called with the lines about a picked point.
        warn: called with the warnings of the readers.
        scene: a scene with cameras in the file's coordinates, which select the view.
        off_screen: whether to render without a window.

    Raises:
        InputError: the file cannot be read, or its coordinates are no lengths. The message starts with the path.
    """
    shown = Source.open(path).read(warn)
    check_lengths(shown, str(path))
    viewed = None if scene is None else read_scene(scene.path, cameras=scene.cameras, on_warning=warn)
    plotter = plotters.cloud(shown, scene=viewed, off_screen=off_screen)
    if isinstance(shown, Cloud) and not off_screen:
        enable_picking(plotter, lambda row: say(describe_point(shown, row)))
    return plotter


def describe_point(cloud: Cloud, row: int) -> str:
    """Return lines about a point of a cloud: coordinates and attributes."""
    low, high = cloud.bounds
    place = with_unit(_coordinates(cloud.points[row], _decimals(high - low)), cloud.unit)
    lines = [f"point {row:,} at {place}"]
    lines += [f"  {name}: {values[row]:.10g}" for name, values in cloud.attributes.items()]
    return "\n".join(lines)


def _after(current: str, names: Sequence[str]) -> str:
    return names[(names.index(current) + 1) % len(names)]


def _decimals(extent: FloatArray) -> int:
    """Return the decimals of coordinates, so that they resolve about a millionth of the scene's size."""
    return max(0, _DIGITS - math.ceil(math.log10(max(float(extent.max()), 1e-12))))


def _coordinates(point: FloatArray, decimals: int) -> str:
    return ", ".join(f"{value:.{decimals}f}" for value in point)
