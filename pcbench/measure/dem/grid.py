"""Square cells in the plane, and the moments of the heights of points in each."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Self

import numpy as np
from numpy.typing import NDArray

from pcbench.errors import InputError
from pcbench.geometry.arrays import FloatArray, IntArray

POINTS_PER_CELL = 4
"""Mean number of points of the sparser cloud in a cell of the default size."""
LEAST_CELLS = 900
"""Number of cells up to which a small area has fewer points in each."""
MAX_CELLS = 400_000_000
BYTES_PER_CELL = 250
"""Largest memory that a comparison of two epochs needs per cell, in bytes."""
BYTES_PER_FURTHER_EPOCH = 100
"""Memory per cell that each further epoch needs, in bytes: its heights, its difference and its share of the trend."""


@dataclass(frozen=True)
class HeightGrid:
    """Square cells with rows from north to south and columns from west to east, aligned with multiples of their edge.

    Attributes:
        west: x of the west edge of the first column.
        north: y of the north edge of the first row.
        cell: edge of a cell, in the unit of x and y.
        shape: number of rows and columns.
    """

    west: float
    north: float
    cell: float
    shape: tuple[int, int]

    @classmethod
    def over(cls, low: FloatArray, high: FloatArray, cell: float) -> HeightGrid:
        """Return the grid of all cells that points between two corners can lie in.

        Args:
            low: smallest x and y.
            high: largest x and y.
            cell: edge of a cell.

        Raises:
            InputError: the grid would have more than `MAX_CELLS` cells.
        """
        first = [math.floor(value / cell) for value in low[:2]]
        last = [math.floor(value / cell) for value in high[:2]]
        columns, rows = (int(b - a) + 1 for a, b in zip(first, last, strict=True))
        if rows * columns > MAX_CELLS:
            raise InputError(
                f"expected at most {MAX_CELLS:,} cells, got {rows:,} x {columns:,}: choose larger cells (--cell)"
            )
        return cls(first[0] * cell, (last[1] + 1) * cell, cell, (rows, columns))

    @property
    def size(self) -> int:
        """Number of cells."""
        return self.shape[0] * self.shape[1]

    @property
    def cell_area(self) -> float:
        """Area of a cell, in squared units of x and y."""
        return self.cell**2

    def extent_text(self) -> str:
        """Return the extent in words, such as "x 0 to 60 and y 0 to 40"."""
        east, south = self.west + self.shape[1] * self.cell, self.north - self.shape[0] * self.cell
        return f"x {self.west:.10g} to {east:.10g} and y {south:.10g} to {self.north:.10g}"

    def numbers(self, points: FloatArray) -> IntArray:
        """Return the number of the cell (N,) of points (N, 2 or 3), row by row; -1 outside of the grid."""
        columns = np.floor((points[:, 0] - self.west) / self.cell)
        rows = np.ceil((self.north - points[:, 1]) / self.cell) - 1
        inside = (columns >= 0) & (columns < self.shape[1]) & (rows >= 0) & (rows < self.shape[0])
        return np.where(inside, rows * self.shape[1] + columns, -1).astype(np.int64)

    def surrounds(self, points: FloatArray) -> NDArray[np.bool_]:
        """Return the mask (N,) of points in the grid or within three cells of it, whose triangles may reach into it."""
        margin, (rows, columns) = 3 * self.cell, self.shape
        x, y = points[:, 0], points[:, 1]
        inside_x = (x >= self.west - margin) & (x <= self.west + columns * self.cell + margin)
        return inside_x & (y <= self.north + margin) & (y >= self.north - rows * self.cell - margin)

    @property
    def columns_x(self) -> FloatArray:
        """The x of the centres of the columns."""
        x: FloatArray = self.west + np.arange(0.5, self.shape[1]) * self.cell
        return x

    @property
    def rows_y(self) -> FloatArray:
        """The y of the centres of the rows."""
        y: FloatArray = self.north - np.arange(0.5, self.shape[0]) * self.cell
        return y

    def centres(self) -> FloatArray:
        """Return the centres (cells, 2) of all cells."""
        x, y = np.meshgrid(self.columns_x, self.rows_y)
        return np.column_stack([x.ravel(), y.ravel()])


def default_cell(area: float, density: float, max_cells: int = MAX_CELLS) -> float:
    """Return the edge of a cell: 1, 2 or 5 times a power of ten, with `POINTS_PER_CELL` points or more on average.

    Areas of few points have about `LEAST_CELLS` cells, or one point per cell: errors are estimated from many cells.

    Args:
        area: area of the grid.
        density: points of the sparsest cloud per squared unit.
        max_cells: largest number of cells.
    """
    wanted = min(POINTS_PER_CELL / density, max(area / LEAST_CELLS, 1 / density))
    least = math.sqrt(max(wanted, area / max_cells))
    exponent = math.floor(math.log10(least))
    return next(
        step * 10.0**power
        for power in (exponent, exponent + 1)
        for step in (1, 2, 5)
        if step * 10.0**power >= least * (1 - 1e-9)
    )


@dataclass(frozen=True, eq=False)
class CellMoments:
    """Number, sum, sum of squares and minimum of the heights in each cell, to which pieces of a cloud are added.

    Heights are relative to `base`, so that sums of squares keep their digits.
    """

    grid: HeightGrid
    base: float
    counts: NDArray[np.int32] = field(init=False)
    sums: FloatArray = field(init=False)
    squares: FloatArray = field(init=False)
    lowest: FloatArray = field(init=False)

    def __post_init__(self) -> None:
        size = self.grid.size
        object.__setattr__(self, "counts", np.zeros(size, np.int32))
        object.__setattr__(self, "sums", np.zeros(size))
        object.__setattr__(self, "squares", np.zeros(size))
        object.__setattr__(self, "lowest", np.full(size, np.inf))

    def add(self, points: FloatArray) -> Self:
        """Add points (N, 3); those outside of the grid are ignored. The result does not depend on how they are cut."""
        numbers = self.grid.numbers(points)
        order = np.argsort(numbers, kind="stable")
        order = order[np.searchsorted(numbers[order], 0) :]
        if not len(order):
            return self
        numbers, heights = numbers[order], points[order, 2] - self.base
        starts = np.flatnonzero(np.concatenate([[True], numbers[1:] != numbers[:-1]]))
        cells = numbers[starts]
        self.counts[cells] += np.diff(np.append(starts, len(numbers))).astype(np.int32)
        self.sums[cells] += np.add.reduceat(heights, starts)
        self.squares[cells] += np.add.reduceat(heights**2, starts)
        self.lowest[cells] = np.minimum(self.lowest[cells], np.minimum.reduceat(heights, starts))
        return self
