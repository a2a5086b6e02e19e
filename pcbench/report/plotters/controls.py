"""Controls of a window: slider, picking of points, and a line that names the keys."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from pcbench.report.plotters.displacements import Displacements
from pcbench.report.plotters.stage import Stage

_EXAGGERATION_RANGE = 4.0  # the slider goes from the first exaggeration divided by this to that times this
_PICK_TOLERANCE = 0.005  # of the window's diagonal


def add_slider(
    stage: Stage, title: str, ends: tuple[float, float], value: float, on_change: Callable[[float], None]
) -> None:
    """Add a slider at the lower right, in place of an earlier one.

    Args:
        stage: the stage.
        title: the title.
        ends: smallest and largest value.
        value: the first value.
        on_change: called with each new value.
    """
    stage.plotter.clear_slider_widgets()
    stage.plotter.add_slider_widget(
        on_change,
        ends,
        value=value,
        title=title,
        pointa=(0.77, 0.08),
        pointb=(0.97, 0.08),
        color=stage.ink,
        title_height=0.016,
        fmt="%.3g",
        interaction_event="always",
        style="modern",
    )


def add_exaggeration(stage: Stage, shown: Displacements, on_change: Callable[[float], None]) -> None:
    """Add a slider for the exaggeration of displacements, in place of an earlier one."""
    first = shown.default_exaggeration(stage)
    ends = first / _EXAGGERATION_RANGE, first * _EXAGGERATION_RANGE
    add_slider(stage, "displacements exaggerated [times]", ends, first, on_change)


def enable_picking(plotter: Any, picked: Callable[[int], None]) -> None:
    """Call a function with the row of each point that the user clicks on with the right mouse button."""

    def on_pick(_: Any, picker: Any) -> None:
        if picker.GetPointId() >= 0:
            picked(picker.GetPointId())

    plotter.enable_point_picking(
        on_pick, tolerance=_PICK_TOLERANCE, picker="point", show_message=False, use_picker=True, color="#ff40ff"
    )


def add_hint(stage: Stage, text: str) -> None:
    """Write the keys below the title."""
    stage.plotter.add_text(text, position=(0.015, 0.93), viewport=True, font_size=7, color=stage.ink, name="keys")
