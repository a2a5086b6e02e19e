"""Tiles of the page: how far each candidate deviates within the squares of a grid, as maps and as a table."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.voxels import robust_bounds
from pcbench.measure.results import Candidate
from pcbench.measure.tiles import MIN_TILE_POINTS, TileDeviations, TileGrid, deviations_by_tile
from pcbench.report.colors import Range, ranges
from pcbench.report.html.packing import rounded
from pcbench.report.inputs import FinishedComparison
from pcbench.report.plot.rounding import round_length
from pcbench.report.plot.views import COORDINATES, SceneAxes
from pcbench.report.scalars import SCALARS
from pcbench.report.words import length, printable, rounding_limit

TILE = 30  # edge of a tile on a map, in SVG units
_MIN_TILES_ALONG = 5  # the longer side has 5 to 15 tiles of a round size
_MARGIN_SHARE = 0.03  # of the box around the inner 98 % of the points, which then includes nearly all
_PREFERRED_SCALARS = ("plane_distance", "mesh_distance", "distance")
_MAX_CANDIDATES = 4  # further maps would make the page long
_MAX_RANKED = 9  # tiles with a number on the maps, which head the table
_KEY_COLORS = 9  # of the colour bar
_LUMINANCE = 0.299, 0.587, 0.114  # weights of red, green and blue
_LIGHT = 140  # luminance of a ground with dark numbers


@dataclass(frozen=True)
class Tile:
    """A tile of a candidate.

    Attributes:
        candidate: name of the candidate.
        statistics: its statistics.
        column, row: its place on the map, from the left and from the top.
        color: colour of the median.
        ink: colour of a number on it.
        place: its centre along the axes of the grid, in words.
        median, nmad, p95: the statistics in words.
    """

    candidate: str
    statistics: TileDeviations
    column: int
    row: int
    color: str
    ink: str
    place: tuple[str, str]
    median: str
    nmad: str
    p95: str

    @property
    def name(self) -> str:
        """Name of the candidate as it is printed."""
        return printable(self.candidate)

    @property
    def text(self) -> str:
        """The statistics as one line."""
        return f"{self.statistics.count:,} points, median {self.median}, NMAD {self.nmad}, 95th percentile {self.p95}"


@dataclass(frozen=True)
class TileMaps:
    """The tiles of a comparison.

    Attributes:
        scene: the axes of the scene.
        origin: (3,) position along these axes from which the grid counts.
        grid: the grid, the same for all candidates.
        quantity: the distances that are summarised, in words.
        tiles: the tiles of the candidates with a map, largest 95th percentile first.
        candidates: names of the candidates that have a map.
        omitted: number of candidates without a map.
        ranked: number of tiles with a number on the maps, which head the table.
        sparse: number of points in tiles with too few points, or outside the grid.
        scale: colour range of the medians.
        unit: unit of lengths, if known.
        is_sample: whether the points are a sample of those of a candidate.
    """

    scene: SceneAxes
    origin: FloatArray
    grid: TileGrid
    quantity: str
    tiles: list[Tile]
    candidates: list[str]
    omitted: int
    ranked: int
    sparse: int
    scale: Range
    unit: str | None
    is_sample: bool = False

    tile = TILE
    min_points = MIN_TILE_POINTS

    @property
    def view_box(self) -> str:
        """The part of the grid that has tiles, in SVG units."""
        columns, rows = [tile.column for tile in self.tiles], [tile.row for tile in self.tiles]
        size = max(columns) + 1 - min(columns), max(rows) + 1 - min(rows)
        return " ".join(str(TILE * x) for x in (min(columns), min(rows), *size))

    @property
    def maps(self) -> list[tuple[str, list[tuple[int, Tile]]]]:
        """The candidates' printed names, which need not differ, and their tiles with their places in `tiles`."""
        numbered = list(enumerate(self.tiles))
        return [
            (printable(name), [(k, tile) for k, tile in numbered if tile.candidate == name]) for name in self.candidates
        ]

    @property
    def axes(self) -> tuple[str, str]:
        """Names of the two axes."""
        first, second = self.grid.axes
        return self.scene.names[first], self.scene.names[second]

    @property
    def size(self) -> str:
        """Edge of a tile in words."""
        return length(self.grid.size, self.unit)

    @property
    def ends(self) -> tuple[str, str]:
        """Ends of the colour range in words."""
        return length(self.scale.low, self.unit), length(self.scale.high, self.unit)

    @property
    def key_colors(self) -> str:
        """The colours of the medians as CSS, from the lowest to the highest."""
        return ", ".join(_css(self.scale, np.linspace(self.scale.low, self.scale.high, _KEY_COLORS)))

    def data(self) -> dict[str, Any]:
        """Return what the 3D view reads: the centres of the tiles as [x, y, z, ...], and the candidate of each."""
        return {
            "sides": [self.scene.rows[axis].tolist() for axis in self.grid.axes],
            "size": self.grid.size,
            "names": self.candidates,
            "of": [self.candidates.index(tile.candidate) for tile in self.tiles],
            "at": rounded([self._position(tile) for tile in self.tiles]),
        }

    def _position(self, tile: Tile) -> FloatArray:
        """Return the centre (3,) of a tile in the coordinates of the clouds."""
        position: FloatArray = (self.origin + tile.statistics.at) @ self.scene.rows
        return position


def tile_maps(
    comparison: FinishedComparison, end: float | None = None, axes: SceneAxes = COORDINATES
) -> TileMaps | None:
    """Return the tiles of a comparison; None if no tile has enough points.

    Args:
        comparison: the comparison.
        end: the end of the colour range, if the user sets it.
        axes: the axes of the scene; a wall is mapped along its own.
    """
    candidates = [c for c in comparison if len(c.deviation.points)]
    places = {c.name: c.deviation.points[c.deviation.is_even] @ axes.rows.T for c in candidates}
    grid, origin = _grid(places, axes)
    if grid is None:
        return None
    key = next(key for key in _PREFERRED_SCALARS if key == "distance" or all(_knows(c, key) for c in candidates))
    values = {c.name: c.deviation.even_values(key) for c in candidates}
    by_name = {name: deviations_by_tile(grid, places[name] - origin, values[name]) for name in values}
    largest_first = sorted(filter(by_name.get, by_name), key=lambda name: -by_name[name][0].p95)
    if not largest_first:
        return None
    mapped = {name: tiles for name, tiles in by_name.items() if name in largest_first[:_MAX_CANDIDATES]}
    signed = any(bool((values[name] < 0).any()) for name in mapped)
    largest = max(abs(tile.median) for tiles in mapped.values() for tile in tiles)
    spacing = comparison.reference.spacing_median
    scale = ranges({"": largest}, spacing=spacing, signed=signed, end=end)[""]
    unit = comparison.reference.unit
    tiles = [_tile(name, tile, grid, scale, unit) for name, tiles in mapped.items() for tile in tiles]
    known_count = sum(int(np.isfinite(values[name]).sum()) for name in mapped)
    least = rounding_limit(comparison)
    return TileMaps(
        axes,
        origin,
        grid,
        SCALARS[key].plural,
        sorted(tiles, key=lambda tile: -tile.statistics.p95),
        list(mapped),
        len(largest_first) - len(mapped),
        min(_MAX_RANKED, sum(tile.statistics.p95 > least for tile in tiles)),
        known_count - sum(tile.statistics.count for tile in tiles),
        scale,
        unit,
        any(c.deviation.sampled_from is not None for c in candidates),
    )


def _knows(candidate: Candidate, key: str) -> bool:
    return key in candidate.deviation.scalars and bool(np.isfinite(candidate.deviation.scalars[key]).any())


def _grid(places: Mapping[str, FloatArray], axes: SceneAxes) -> tuple[TileGrid | None, FloatArray]:
    """Return a grid of a round tile size, and the origin (3,) from which it counts; no grid if there is no extent.

    Args:
        places: positions (N, 3) of the points of each cloud along the axes.
        axes: the axes.
    """
    origin = np.zeros(3)
    if not places:
        return None, origin
    corners = [robust_bounds(points) for points in places.values()]
    low = np.min([corner for corner, _ in corners], axis=0)
    high = np.max([corner for _, corner in corners], axis=0)
    longest = float((high - low).max())
    if not longest > 0:
        return None, origin
    low, high = low - _MARGIN_SHARE * longest, high + _MARGIN_SHARE * longest
    if axes.is_wall:  # counts from its left end, and has tiles along its length and its height
        origin[0] = low[0]
        high[2] = low[2]
    return TileGrid.covering(low - origin, high - origin, round_length(longest / _MIN_TILES_ALONG)), origin


def _tile(name: str, statistics: TileDeviations, grid: TileGrid, scale: Range, unit: str | None) -> Tile:
    above, column = divmod(statistics.tile, grid.shape[0])
    decimals = max(0, 1 - math.floor(math.log10(grid.size)))  # centres lie at half the size
    first, second = (f"{statistics.at[axis]:,.{decimals}f}" for axis in grid.axes)
    return Tile(
        name,
        statistics,
        column,
        grid.shape[1] - 1 - above,
        _css(scale, np.array([statistics.median]))[0],
        _ink(scale, statistics.median),
        (first, second),
        length(statistics.median, unit),
        length(statistics.nmad, unit),
        length(statistics.p95, unit),
    )


def _ink(scale: Range, value: float) -> str:
    """Return black or white, whichever is readable on the colour of a value."""
    return "#000" if scale.colors(np.array([value]))[0] @ np.array(_LUMINANCE) > _LIGHT else "#fff"


def _css(scale: Range, values: FloatArray) -> list[str]:
    return [f"#{red:02x}{green:02x}{blue:02x}" for red, green, blue in scale.colors(values).tolist()]
