"""A section through the place of the largest deviations, with both clouds in it.

It is vertical, or perpendicular to a wall: a wall that lies on its back is cut like a town.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from textwrap import fill
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.transform import Similarity
from pcbench.geometry.voxels import cells
from pcbench.report.colors import Range
from pcbench.report.figures import Figures, ink
from pcbench.report.plot.panels import new_figure, save
from pcbench.report.plot.views import AxisBox, scene_axes, thin_out
from pcbench.report.viewing import ViewingCameras
from pcbench.report.words import printable

_CELLS_ALONG = 40  # cells along the scene's diagonal in which deviations are compared
_MIN_CELL_POINTS = 8
_REACH_SHARE = 0.05  # of the diagonal: points farther outside the reference's box are not a place of the scene
_LENGTH_SHARE = 0.25  # of the scene's diagonal, for the length of the section
_MIN_SPACINGS, _MAX_THICKNESS_SHARE = 2.0, 0.02  # bounds of the slice's thickness; the latter of the diagonal
_MIN_SLICE_POINTS, _MIN_OWN_POINTS = 400, 40  # of both clouds and of the candidate; a slice with fewer is made thicker
_DIRECTIONS_DEG = (0, 45, 90, 135)
_WALL_DIRECTIONS_DEG = (0, 90)  # horizontal and vertical
_EXAGGERATIONS = (1, 2, 5, 10, 20)
_MIN_HEIGHT_RATIO = 0.12  # of the drawn height to the length, before heights are exaggerated
_SECTION_INCHES, _MARGIN_INCHES = 9.2, 1.4  # length of the drawn section, and space above and below it
_REFERENCE_GREY, _LINE_COLOR = "#8f959c", "#ff7f2a"


class Section(NamedTuple):
    """A slice of both clouds along their third axis, which is up, or normal to a wall.

    Attributes:
        center: (3,) the place.
        direction: (2,) direction along the section in the plane of the first two axes.
        ends: (2,) positions of its ends along it, from the place.
        thickness: thickness of the slice.
        rows: (M,) rows of the candidate's points in it.
        reference_rows: (K,) rows of the reference's points in it.
    """

    center: FloatArray
    direction: FloatArray
    ends: FloatArray
    thickness: float
    rows: NDArray[np.int64]
    reference_rows: NDArray[np.int64]

    @property
    def length(self) -> float:
        """Length of the section."""
        return float(self.ends[1] - self.ends[0])

    @property
    def size(self) -> int:
        """Number of points of both clouds."""
        return len(self.rows) + len(self.reference_rows)

    def positions(self, points: FloatArray) -> FloatArray:
        """Return positions (N, 2) of points (N, 3) in the section: along it, and along the third axis."""
        return np.column_stack([(points[:, :2] - self.center[:2]) @ self.direction, points[:, 2]])

    @classmethod
    def through_worst_place(
        cls,
        points: FloatArray,
        values: FloatArray,
        reference: FloatArray,
        spacing: float,
        directions_deg: Sequence[float] = _DIRECTIONS_DEG,
    ) -> Section | None:
        """Return the section through the cell with the largest median deviation; None if no cell has enough points.

        Args:
            points: (N, 3) points of the candidate.
            values: (N,) deviations.
            reference: (K, 3) points of the reference.
            spacing: spacing of the reference.
            directions_deg: angles of the sections to choose from, anticlockwise from the first axis.
        """
        box = AxisBox.around(reference)
        diagonal = float(np.linalg.norm(box.high - box.low))
        reach = _REACH_SHARE * diagonal
        inside = np.flatnonzero(AxisBox(box.low - reach, box.high + reach).holds(points) & np.isfinite(values))
        if not len(inside) or not diagonal > 0:
            return None
        grid = cells(points[inside], diagonal / _CELLS_ALONG, box.low)
        order = np.lexsort((np.abs(values[inside]), grid.of_point))
        starts = np.searchsorted(grid.of_point[order], np.arange(len(grid.first) + 1))
        counts = np.diff(starts)
        medians = np.where(
            counts >= _MIN_CELL_POINTS, np.abs(values[inside])[order[starts[:-1] + counts // 2]], -np.inf
        )
        worst = int(medians.argmax())
        if not np.isfinite(medians[worst]):
            return None
        center = points[inside[grid.of_point == worst]].mean(axis=0)
        length, thickness = _LENGTH_SHARE * diagonal, max(_MIN_SPACINGS * spacing, 1e-6 * diagonal)
        near = [_rows_around(cloud, center, length) for cloud in (points, reference)]
        while True:
            slices = [
                cls._slice(center, angle, box, length, thickness, points, reference, near) for angle in directions_deg
            ]
            best = max(slices, key=lambda section: section.size)
            if best.size >= _MIN_SLICE_POINTS and len(best.rows) >= _MIN_OWN_POINTS:
                return best
            if thickness >= _MAX_THICKNESS_SHARE * diagonal:
                return best
            thickness *= 1.5

    @classmethod
    def _slice(
        cls,
        center: FloatArray,
        angle: float,
        box: AxisBox,
        length: float,
        thickness: float,
        points: FloatArray,
        reference: FloatArray,
        near: Sequence[NDArray[np.int64]],
    ) -> Section:
        direction = np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle))])
        ends = _ends(center[:2], direction, box, length)
        rows_inside = []
        for cloud, rows in zip((points, reference), near, strict=True):
            from_center = cloud[rows, :2] - center[:2]
            across = from_center @ np.array([-direction[1], direction[0]])
            along = from_center @ direction
            is_inside = (np.abs(across) <= 0.5 * thickness) & (along >= ends[0]) & (along <= ends[1])
            rows_inside.append(rows[is_inside])
        return cls(center, direction, ends, thickness, *rows_inside)


def _ends(center: FloatArray, direction: FloatArray, box: AxisBox, length: float) -> FloatArray:
    """Return the ends (2,) of a line of a length through a place (2,), moved along it to stay inside a box."""
    with np.errstate(divide="ignore"):
        borders = np.where(
            np.abs(direction) > 1e-9, (np.stack([box.low, box.high])[:, :2] - center) / direction, [[-np.inf], [np.inf]]
        )
    low, high = borders.min(axis=0).max(), borders.max(axis=0).min()
    start = max(low, min(-0.5 * length, high - length))
    return np.array([start, min(start + length, high)])


def _rows_around(points: FloatArray, center: FloatArray, length: float) -> NDArray[np.int64]:
    """Return the rows of points (N, 3) in the square around a place that contains all sections of a length."""
    return np.flatnonzero((np.abs(points[:, :2] - center[:2]) <= length).all(axis=1))


def draw_section(
    points: FloatArray, values: FloatArray, reference: FloatArray, spacing: float, title: str, scale: Range,
    label: str, unit: str, path: Path, look: Figures, rotation: Similarity | None = None,
    cameras: ViewingCameras | None = None,
) -> bool:  # fmt: skip
    """Draw the section through the place of the largest deviations, beside its position on a map.

    Args:
        points: (N, 3) points of the candidate.
        values: (N,) deviations, which colour them.
        reference: (K, 3) points of the reference.
        spacing: spacing of the reference.
        title: first part of the title.
        scale: the colour range.
        label: label of the colour bar.
        unit: unit of lengths.
        path: the file to write.
        look: appearance of the picture.
        rotation: rotation from the clouds' coordinates to those of the points, for the coordinates in the picture.
        cameras: the cameras that photographed the scene, in the coordinates of the points.

    Returns:
        Whether there was enough to draw.
    """
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import LinearSegmentedColormap, Normalize

    axes = scene_axes(reference, cameras)
    turned = axes.rows if axes.is_wall else np.eye(3)
    origin = np.array([0, 0, np.median(reference @ turned[2])]) if axes.is_wall else np.zeros(3)
    points, reference = points @ turned.T - origin, reference @ turned.T - origin
    directions = _WALL_DIRECTIONS_DEG if axes.is_wall else _DIRECTIONS_DEG
    section = Section.through_worst_place(points, values, reference, spacing, directions)
    if section is None:
        return False
    height_name = axes.names[2] if axes.is_wall else "height"
    candidate_positions = section.positions(points[section.rows])
    reference_positions = section.positions(reference[section.reference_rows])
    low, high = np.percentile(np.concatenate([candidate_positions[:, 1], reference_positions[:, 1]]), [0.2, 99.8])
    margin = max(0.08 * (high - low), 0.01 * section.length)
    low, high = low - margin, high + margin
    factor = next(
        (f for f in _EXAGGERATIONS if f * (high - low) >= _MIN_HEIGHT_RATIO * section.length), _EXAGGERATIONS[-1]
    )
    ground = look.ground("dark")
    color = ink(ground)
    height = float(np.clip(_SECTION_INCHES * factor * (high - low) / section.length, 1.6, 6.0)) + _MARGIN_INCHES
    figure = new_figure(13.6, height, facecolor=ground, layout="constrained")
    grid = figure.add_gridspec(1, 2, width_ratios=(4.2, 1))
    along, above = figure.add_subplot(grid[0]), figure.add_subplot(grid[1])
    along.scatter(*reference_positions.T, s=7, c=_REFERENCE_GREY, linewidths=0)
    order = np.argsort(np.abs(values[section.rows]))  # large deviations on top
    along.scatter(*candidate_positions[order].T, s=14, c=scale.colors(values[section.rows][order]) / 255, linewidths=0)
    along.set(xlim=tuple(section.ends), ylim=(low, high), aspect=factor, facecolor=ground)
    place = (section.center + origin) @ turned
    if rotation is not None:
        place = rotation.inverse().apply(place[None])[0]
    elif not axes.is_wall:
        place = place[:2]
    components = (f"{axis} = {value:,.1f}" for axis, value in zip("xyz", place, strict=False))
    coordinates = ", ".join(components).replace("-", "−")
    along.set_xlabel(f"along the section, from A; 0 is at {coordinates} [{unit}]")
    along.set_ylabel(f"{height_name} [{unit}]" + (f"\n× {factor}" if factor > 1 else ""))
    map_points = thin_out(reference)
    box = AxisBox.around(reference)
    above.scatter(map_points[:, 0], map_points[:, 1], s=0.4, c=_REFERENCE_GREY, linewidths=0)
    ends = section.center[:2] + np.outer(section.ends, section.direction)
    above.plot(*ends.T, color=_LINE_COLOR, linewidth=2.5, solid_capstyle="butt")
    style: dict[str, Any] = {"color": _LINE_COLOR, "fontsize": 11, "fontweight": "bold", "ha": "center", "va": "center"}
    above.annotate("A", ends[0], tuple(-10 * section.direction), textcoords="offset points", **style)
    above.set(xlim=(box.low[0], box.high[0]), ylim=(box.low[1], box.high[1]), aspect="equal", facecolor=ground)
    above.set_xticks([])
    above.set_yticks([])
    above.set_title(f"the section, from {'the front' if axes.is_wall else 'above'}", fontsize=10, color=color)
    for axis in (along, above):
        axis.tick_params(colors=color)
        axis.xaxis.label.set_color(color)
        axis.yaxis.label.set_color(color)
        for spine in axis.spines.values():
            spine.set_color(color)
            spine.set_alpha(0.4)
    cmap = LinearSegmentedColormap.from_list("deviations", scale.table / 255)
    mappable = ScalarMappable(Normalize(scale.low, scale.high), cmap)
    bar = figure.colorbar(mappable, ax=along, extend="both" if scale.signed else "max", pad=0.01)
    bar.set_label(fill(label, max(18, int(11 * height) - 14)), color=color)
    bar.ax.tick_params(colors=color)
    description = f"section through the largest deviations, {section.thickness:.2g} {unit} thick; grey: reference"
    figure.suptitle(f"{printable(title)}: {description}", color=color, fontsize=13)
    save(figure, path)
    return True
