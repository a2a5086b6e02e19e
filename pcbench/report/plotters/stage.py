"""A `pyvista.Plotter` with the appearance of a report's pictures: frame, colours, axes with their unit, colour bar."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from pcbench.errors import InputError
from pcbench.extras import require
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.mesh import Mesh
from pcbench.measure.wording import with_unit
from pcbench.opengl import check_opengl, select_opengl
from pcbench.report.colors import Range
from pcbench.report.figures import WINDOW_SIZE, Figures, ink, rgb
from pcbench.report.plot.rounding import axis_title, round_origin
from pcbench.report.plot.views import Frame, oblique_view
from pcbench.report.plotters.axes import FONT_PX, Layout, lay_out
from pcbench.report.plotters.lighting import Lighting
from pcbench.report.read import UNKNOWN_UNIT
from pcbench.report.words import printable

_SIDE_PX, _TOP_PX, _BOTTOM_PX = 48, 60, 132  # around frame and axes, for title and colour bar
_MAX_MARGIN_SHARES = (0.1, 0.15, 0.3)  # of a small window
_BAR_PX = (24, 72)  # distance of the colour bar from the lower edge, and its height with labels and title
_COLORS = 256  # entries of a lookup table
_LINE_INK_SHARE = 0.6  # of ink in the colour of lines; the rest is background
_TITLE_SIZE, _MIN_TITLE_SIZE = 11, 5  # in points
_TITLE_CHARACTER_PX = 12.4  # mean width of a character of the title's full size
_TITLE_PX = 36  # from the upper edge to the lower edge of the title
_DOT_SHARE = 0.8  # of the mean distance between points if they covered the window evenly
_MIN_DOT_PX, _MAX_DOT_PX = 2.0, 6.0
_GHOST_POINTS = 40_000  # more translucent points would add up to an opaque layer
_GHOST_OPACITY, _GHOST_DOT_PX = 0.25, 2.0
_MAX_SIZE_PX = 16_384
_PALE = [138, 138, 138]


class Window(NamedTuple):
    """A window, or the picture that is rendered without one.

    Attributes:
        off_screen: whether to render without a window; None: as pyvista is set up.
        size: width and height in pixels.
        background: background colour, see `Figures`.
        lighting: whether points have eye-dome lighting.
    """

    off_screen: bool | None = None
    size: tuple[int, int] = WINDOW_SIZE
    background: str = "dark"
    lighting: bool = True


class Stage:
    """A plotter with a frame and a local origin.

    OpenGL computes in float32, which has steps of half a metre at the northings of UTM. Points are therefore moved to
    a local origin of round coordinates, which the titles of the axes name.

    Args:
        frame: the frame of the scene; its cameras select the view.
        unit: unit of lengths.
        window: the window.
        axes: names of the axes.

    Attributes:
        plotter: the plotter, which is not yet shown.
        origin: (3,) the local origin.
        frame: the frame.
        unit: unit of lengths, or words for an unknown one.
        ink: colour of text on the background.
        lighting: lighting of the points; None if the window has none.

    Raises:
        MissingExtra: pyvista is not installed.
        NoFiguresError: there is neither a display nor EGL nor OSMesa.
    """

    def __init__(
        self, frame: Frame, unit: str | None, window: Window, axes: tuple[str, str, str] = ("x", "y", "z")
    ) -> None:
        _check_size(window.size)
        ground = Figures(window.background).ground("dark")
        check_opengl()  # before VTK, which pyvista imports
        select_opengl()
        self._pyvista = require("pyvista")
        self.plotter = self._pyvista.Plotter(
            off_screen=window.off_screen, window_size=list(window.size), title="pcbench"
        )
        self.plotter.set_background(ground)
        self.ink = ink(ground)
        self._line_color = _mixed(self.ink, ground, _LINE_INK_SHARE)
        self.unit, self._known_unit, self.frame, self._size = unit or UNKNOWN_UNIT, unit, frame, window.size
        self.lighting = Lighting(self.plotter) if window.lighting else None
        self.origin, self._view = round_origin(frame.box.low, frame.box.high), oblique_view(frame.cameras)
        self._place_camera(self._add_axes(axes))

    def add_points(self, points: FloatArray, name: str, *, lit: bool = False, **options: Any) -> Any:
        """Add points (N, 3) as round dots, and return the actor.

        Args:
            points: (N, 3) in the clouds' coordinates.
            name: name of the actor, which replaces an earlier one of that name.
            lit: whether the points have the window's lighting. Translucent ones cannot.
            options: arguments of `pyvista.Plotter.add_mesh`; `scalars` are (N,) values or (N, 3) colours.
        """
        local = (points - self.origin).astype(np.float32)
        inside = max(int(np.count_nonzero(self.frame.box.holds(points))), 1)
        dot = float(np.clip(_DOT_SHARE * np.sqrt(self._size[0] * self._size[1] / inside), _MIN_DOT_PX, _MAX_DOT_PX))
        actor = self.plotter.add_mesh(
            self._pyvista.PolyData(local),
            style="points",
            name=name,
            render_points_as_spheres=True,
            lighting=False,  # light from a direction would change the colours, which show values
            interpolate_before_map=False,  # there is nothing between points; VTK 9.4 fails with it and the lighting
            show_scalar_bar=False,
            reset_camera=False,
            render=False,
            **{"point_size": dot, "pickable": False, **options},
        )
        if lit and self.lighting is not None:
            self.lighting.add(actor)
        return actor

    def add_surface(self, mesh: Mesh, name: str, **options: Any) -> Any:
        """Add a mesh with light from the camera, and return the actor."""
        surface = mesh.shifted(self.origin).to_pyvista()
        return self.plotter.add_mesh(surface, name=name, reset_camera=False, pickable=False, **options)

    def add_ghost(self, shown: FloatArray | Mesh) -> Any:
        """Add points (N, 3) or a mesh as a pale, translucent ghost, and return the actor."""
        style: dict[str, Any] = {"color": _PALE, "opacity": _GHOST_OPACITY}
        if isinstance(shown, Mesh):
            return self.add_surface(shown, "ghost", **style)
        thinned = shown[:: -(-len(shown) // _GHOST_POINTS)]
        return self.add_points(thinned, "ghost", point_size=_GHOST_DOT_PX, **style)

    def add_values(self, points: FloatArray, values: FloatArray, scale: Range, name: str = "values") -> Any:
        """Add points (N, 3) coloured by finite values (N,), which a mouse click can pick, and return the actor."""
        style = {"scalars": values, "cmap": self.lookup_table(scale), "clim": (scale.low, scale.high)}
        return self.add_points(points, name, lit=True, pickable=True, **style)

    def add_arrows(self, tails: FloatArray, vectors: FloatArray, values: FloatArray, scale: Range) -> Any:
        """Add arrows from tails (N, 3) along vectors (N, 3), coloured by values (N,), and return the actor."""
        data = self._pyvista.PolyData((tails - self.origin).astype(np.float32))
        data["vectors"], data["values"] = vectors, values
        arrows = data.glyph(orient="vectors", scale="vectors", geom=self._pyvista.Arrow(shaft_resolution=8))
        return self.plotter.add_mesh(
            arrows,
            scalars="values",
            cmap=self.lookup_table(scale),
            clim=(scale.low, scale.high),
            name="arrows",
            interpolate_before_map=False,  # an arrow has one value
            lighting=False,
            show_scalar_bar=False,
            reset_camera=False,
            render=False,
            pickable=False,
        )

    def add_lines(self, lines: Sequence[FloatArray], name: str, color: str) -> Any:
        """Add lines, each through points (K, 3), and return the actor."""
        return self._add_local_lines([line - self.origin for line in lines], name, color=color, line_width=2)

    def lookup_table(self, scale: Range) -> Any:
        """Return the colours of a range as a `pyvista.LookupTable`."""
        middles = scale.low + (np.arange(_COLORS) + 0.5) * (scale.high - scale.low) / _COLORS
        opaque = np.full((_COLORS, 1), 255, np.uint8)
        values = np.concatenate([scale.colors(middles), opaque], axis=1)
        return self._pyvista.LookupTable(values=values, scalar_range=(scale.low, scale.high))

    def add_bar(self, actor: Any, label: str) -> None:
        """Add the colour bar of an actor, with its label and the unit; it replaces an earlier one."""
        for title in [*self.plotter.scalar_bars.keys()]:
            self.plotter.remove_scalar_bar(title, render=False)
        bar = self.plotter.add_scalar_bar(
            title=f"{label} [{self.unit}]\n",
            mapper=actor.mapper,
            vertical=False,
            position_x=0.27,
            position_y=_BAR_PX[0] / self._size[1],
            width=0.46,
            height=_BAR_PX[1] / self._size[1],
            n_labels=5,
            fmt=f"%.{_digits(*actor.mapper.scalar_range)}g",
            color=self.ink,
            title_font_size=16,
            label_font_size=14,
            unconstrained_font_size=True,
            render=False,
        )
        bar.GetLabelTextProperty().SetJustificationToCentered()  # else VTK centres them from the second rendering on

    def with_unit(self, length: float) -> str:
        """Return a length with three digits and the unit, if that is known."""
        return with_unit(f"{length:.3g}", self._known_unit)

    def write_title(self, text: str) -> None:
        """Write the title at the upper edge, smaller if it is long; it replaces an earlier one."""
        title = printable(text)
        fitting = _TITLE_SIZE * 0.97 * self._size[0] / (_TITLE_CHARACTER_PX * max(len(title), 1))
        self.plotter.add_text(
            title,
            position=(0.015, 1 - _TITLE_PX / self._size[1]),
            viewport=True,
            font_size=int(np.clip(fitting, _MIN_TITLE_SIZE, _TITLE_SIZE)),
            color=self.ink,
            name="title",
            render=False,
        )

    def _add_axes(self, names: tuple[str, str, str]) -> Layout:
        """Add axes along edges of the frame's box, and return their layout."""
        titles = [axis_title(name, start, self._known_unit) for name, start in zip(names, self.origin, strict=True)]
        low, high = self.frame.box.low - self.origin, self.frame.box.high - self.origin
        side, top, bottom = self._margins
        layout = lay_out(low, high, titles, self._view, np.array(self._size) - [2 * side, top + bottom])
        lines = [axis.ends for axis in layout.axes] + [tick for axis in layout.axes for tick in axis.ticks]
        self._add_local_lines(lines, "axes", color=self._line_color)
        for number, axis in enumerate(layout.axes):
            texts = (*axis.labels, axis.title)  # with the same alignment
            self.plotter.add_point_labels(
                np.stack([text.place for text in texts]),
                [text.text for text in texts],
                name=f"axis labels {number}",
                show_points=False,
                shape=None,
                always_visible=True,
                text_color=self.ink,
                font_size=FONT_PX,
                bold=False,
                justification_horizontal=axis.title.horizontal,
                justification_vertical=axis.title.vertical,
                reset_camera=False,
            )
        x, y, z = names
        self.plotter.add_axes(color=self.ink, line_width=3, xlabel=x, ylabel=y, zlabel=z)
        return layout

    def _add_local_lines(self, lines: Sequence[FloatArray], name: str, **options: Any) -> Any:
        """Add lines, each through points (K, 3) relative to the origin."""
        starts = np.cumsum([0, *map(len, lines)])
        cells = [[len(line), *range(start, start + len(line))] for line, start in zip(lines, starts[:-1], strict=True)]
        data = self._pyvista.PolyData(np.concatenate(lines).astype(np.float32), lines=np.concatenate(cells))
        return self.plotter.add_mesh(data, name=name, pickable=False, reset_camera=False, lighting=False, **options)

    @property
    def _margins(self) -> FloatArray:
        """Pixels beside, above and below frame and axes."""
        width, height = self._size
        margins: FloatArray = np.minimum(
            (_SIDE_PX, _TOP_PX, _BOTTOM_PX), np.multiply(_MAX_MARGIN_SHARES, (width, height, height))
        )
        return margins

    def _place_camera(self, layout: Layout) -> None:
        """Show the frame's box with its axes, with parallel projection as in the pictures."""
        right, up, toward = self._view.axes
        visible = layout.pixel * self._size[1]  # height of the whole window
        _, top, bottom = self._margins
        x, y = layout.middle - [0, 0.5 * (bottom - top) * layout.pixel]
        focus = x * right + y * up + (self.frame.box.center - self.origin) @ toward * toward
        camera = self.plotter.camera
        camera.parallel_projection = True
        camera.focal_point, camera.position = focus.tolist(), (focus + 2 * visible * toward).tolist()
        camera.up, camera.parallel_scale = self._view.up, 0.5 * visible
        self.plotter.camera_set = True


def _check_size(size: Any) -> None:
    try:
        is_valid = len(size) == 2 and all(int(pixels) == pixels and 1 <= pixels <= _MAX_SIZE_PX for pixels in size)
    except (TypeError, ValueError, OverflowError):
        is_valid = False
    if not is_valid:
        raise InputError(f"expected the window size as two whole numbers from 1 to {_MAX_SIZE_PX}, got {size!r}")


def _mixed(one: str, other: str, share: float) -> str:
    """Return the colour #rrggbb that has a share of one colour and the rest of another."""
    mixed = np.rint(share * rgb(one) + (1 - share) * rgb(other)).astype(int)
    return "#" + "".join(f"{value:02x}" for value in mixed)


def _digits(low: float, high: float) -> int:
    """Return the significant digits that distinguish the labels of a bar from `low` to `high`."""
    largest, step = max(abs(low), abs(high)), (high - low) / 4
    return 3 if not step > 0 else max(3, math.ceil(math.log10(largest / step)) + 2)
