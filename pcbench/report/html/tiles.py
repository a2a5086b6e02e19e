"""Tiles of the page: how far each candidate deviates within the squares of a grid, as maps and as a table."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.voxels import robust_bounds
from pcbench.measure.results import Candidate
from pcbench.measure.tiles import MIN_TILE_POINTS, TileDeviations, TileGrid, deviations_by_tile
from pcbench.report.colors import Range, ranges
from pcbench.report.inputs import SourcedComparison
from pcbench.report.plot.views import round_length
from pcbench.report.words import length, printable

TILE = 30  # edge of a tile on a map, in SVG units
_MIN_TILES_ALONG = 5  # the longer side has 5 to 15 tiles of a round size
_MARGIN_SHARE = 0.03  # of the box around the inner 98 % of the points, which then includes nearly all
_QUANTITIES = {  # the preferred scalars, best first
    "plane_distance": "signed distances to the surface",
    "mesh_distance": "distances to the reference mesh",
    "distance": "distances to the closest point",
}
_MAX_CANDIDATES = 4  # further maps would make the page long
_MAX_RANKED = 9  # tiles with a number on the maps, which head the table
_KEY_COLORS = 9  # of the colour bar


@dataclass(frozen=True)
class Tile:
    """A tile of a candidate.

    Attributes:
        candidate: name of the candidate.
        found: its statistics.
        column, row: its place on the map, from the left and from the top.
        color: colour of the median.
        place: its centre along the axes of the grid, in words.
        median, nmad, p95: the statistics in words.
    """

    candidate: str
    found: TileDeviations
    column: int
    row: int
    color: str
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
        return f"{self.found.count:,} points, median {self.median}, NMAD {self.nmad}, 95th percentile {self.p95}"


@dataclass(frozen=True)
class TileMaps:
    """The tiles of a comparison.

    Attributes:
        grid: the grid, the same for all candidates.
        quantity: the distances that are summarised, in words.
        tiles: the tiles of all candidates, largest 95th percentile first.
        candidates: names of the candidates that have a map.
        omitted: number of candidates without a map.
        sparse: number of points in tiles with too few points, or outside the grid.
        scale: colour range of the medians.
        unit: unit of lengths, if known.
    """

    grid: TileGrid
    quantity: str
    tiles: list[Tile]
    candidates: list[str]
    omitted: int
    sparse: int
    scale: Range
    unit: str | None

    tile = TILE
    min_points = MIN_TILE_POINTS
    ranked = _MAX_RANKED

    @property
    def view_box(self) -> str:
        """The part of the grid that has tiles, in SVG units."""
        columns, rows = [tile.column for tile in self.tiles], [tile.row for tile in self.tiles]
        size = max(columns) + 1 - min(columns), max(rows) + 1 - min(rows)
        return " ".join(str(TILE * x) for x in (min(columns), min(rows), *size))

    @property
    def maps(self) -> dict[str, list[tuple[int, Tile]]]:
        """The tiles of each candidate, by its printed name, with their places in `tiles`."""
        numbered = list(enumerate(self.tiles))
        return {
            printable(name): [(k, tile) for k, tile in numbered if tile.candidate == name] for name in self.candidates
        }

    @property
    def axes(self) -> str:
        """Names of the two axes."""
        return "".join("xyz"[axis] for axis in self.grid.axes)

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
            "axes": self.grid.axes,
            "size": self.grid.size,
            "names": self.candidates,
            "of": [self.candidates.index(tile.candidate) for tile in self.tiles],
            "at": [float(f"{x:.9g}") for tile in self.tiles for x in tile.found.at],
        }


def tile_maps(comparison: SourcedComparison, given: float | None = None) -> TileMaps | None:
    """Return the tiles of a comparison; None if no tile has enough points.

    Args:
        comparison: the comparison.
        given: the end of the colour range, if the user sets it.
    """
    shown = [c for c in comparison if len(c.deviation.points)][:_MAX_CANDIDATES]
    grid = _grid(shown)
    if grid is None:
        return None
    key = next(key for key in _QUANTITIES if key == "distance" or all(_knows(c, key) for c in shown))
    found = {c.name: deviations_by_tile(grid, c.deviation.points, c.deviation.scalars[key]) for c in shown}
    if not any(found.values()):
        return None
    signed = any(bool((c.deviation.scalars[key] < 0).any()) for c in shown)
    largest = max(abs(tile.median) for tiles in found.values() for tile in tiles)
    spacing = comparison.reference.spacing_median
    scale = ranges({"": largest}, spacing=spacing, signed=signed, given=given)[""]
    unit = comparison.reference.unit
    tiles = [_tile(name, tile, grid, scale, unit) for name, tiles in found.items() for tile in tiles]
    known = sum(int(np.isfinite(c.deviation.scalars[key]).sum()) for c in shown)
    return TileMaps(
        grid,
        _QUANTITIES[key],
        sorted(tiles, key=lambda tile: -tile.found.p95),
        list(found),
        len(comparison) - len(shown),
        known - sum(tile.found.count for tile in tiles),
        scale,
        unit,
    )


def _knows(candidate: Candidate, key: str) -> bool:
    return key in candidate.deviation.scalars and bool(np.isfinite(candidate.deviation.scalars[key]).any())


def _grid(candidates: list[Candidate]) -> TileGrid | None:
    """Return a grid of a round tile size over the clouds; None if they have no extent."""
    if not candidates:
        return None
    corners = [robust_bounds(candidate.deviation.points) for candidate in candidates]
    low = np.min([corner for corner, _ in corners], axis=0)
    high = np.max([corner for _, corner in corners], axis=0)
    longest = float((high - low).max())
    if not longest > 0:
        return None
    margin = _MARGIN_SHARE * longest
    return TileGrid.covering(low - margin, high + margin, round_length(longest / _MIN_TILES_ALONG))


def _tile(name: str, found: TileDeviations, grid: TileGrid, scale: Range, unit: str | None) -> Tile:
    above, column = divmod(found.tile, grid.shape[0])
    decimals = max(0, 1 - math.floor(math.log10(grid.size)))  # centres lie at half the size
    first, second = (f"{found.at[axis]:,.{decimals}f}" for axis in grid.axes)
    return Tile(
        name,
        found,
        column,
        grid.shape[1] - 1 - above,
        _css(scale, np.array([found.median]))[0],
        (first, second),
        length(found.median, unit),
        length(found.nmad, unit),
        length(found.p95, unit),
    )


def _css(scale: Range, values: FloatArray) -> list[str]:
    return [f"#{red:02x}{green:02x}{blue:02x}" for red, green, blue in scale.colors(values).tolist()]
